"""Features: the same wherever the scene lies, and the listed ones (and no others)
change sign in a mirror."""

import math

import pytest
import torch

from e2rl.prior.features import (
    SIDED_EDGE,
    SIDED_NODE,
    curve_speed,
    edge_features,
    leaders_ahead,
    node_features,
)
from e2rl.prior.lane_relative import locate
from e2rl.prior.routes import route_scene
from tests.prior.small import arc, curved_scenes, mirrored, moved


def features(scene, step=None):
    vehicles = scene["route_log"].shape[1]
    routed = route_scene(scene, scene["route_log"].clamp(min=0))
    state = locate(
        scene["start"][:, :vehicles],
        scene["start_accel"][:, :vehicles],
        yaw_rate=scene["start_yaw_rate"][:, :vehicles],
        points=routed.points,
    )
    step = torch.zeros(len(scene), dtype=torch.long) if step is None else step
    nodes = node_features(
        routed,
        state,
        leaders_ahead(
            routed,
            state.s,
            agents=scene["start"],
            present=scene["valid"],
        ),
        step,
        step == 0,
    )
    here = scene["valid"][0, :vehicles]
    return nodes[:, here], edge_features(routed, state)[:, here][:, :, here]


@pytest.mark.parametrize(
    ("kind", "sided"), [(0, SIDED_NODE), (1, SIDED_EDGE)], ids=["nodes", "edges"]
)
def test_a_mirror_flips_exactly_the_sided_features(kind, sided):
    scene = curved_scenes()
    here = features(scene)[kind]
    place = features(mirrored(scene))[kind]
    sign = torch.ones(here.shape[-1])
    sign[list(sided)] = -1
    torch.testing.assert_close(
        place,
        here * sign,
        rtol=0,
        atol=2e-3,
    )
    flipping = (
        ((here - place).abs() > 5e-3).flatten(0, -2).any(0).nonzero()[:, 0].tolist()
    )
    assert set(flipping) == set(sided), (
        "every listed feature is looked at by this scene"
    )


def test_features_do_not_know_where_the_scene_lies():
    scene = curved_scenes()
    for here, place in zip(
        features(scene),
        features(
            moved(
                scene,
                120.0,
                y=-40.0,
                angle=0.7,
            )
        ),
        strict=True,
    ):
        torch.testing.assert_close(
            place,
            here,
            rtol=0,
            atol=5e-3,
        )


def test_only_estimates_look_at_the_past():
    scene = curved_scenes()
    changed = scene.clone()
    changed["past"] = changed["past"] + 0.3 * torch.arange(1, 11)[:, None]
    first = torch.zeros(1, dtype=torch.long)
    current = torch.full((1,), 5)
    assert not torch.equal(features(scene)[0], features(changed)[0])
    assert torch.equal(features(scene, current)[0], features(changed, current)[0])
    alone = features(scene, first)[0][
        0, 0, 51:61
    ]  # 8 m/s now, 0.4 m/s^2 less and less before
    torch.testing.assert_close(
        alone,
        -0.2 * (0.2 * torch.arange(10) + 0.1) / 2 * torch.ones(10),
        rtol=0,
        atol=1e-4,
    )


def test_a_queue_a_light_and_a_limit_are_seen():
    nodes, _ = features(curved_scenes(limit=15.0))
    ego = nodes[0, 0]
    assert ego[0] == pytest.approx(0.8)
    assert ego[7] == pytest.approx(0.7)
    assert ego[8] == pytest.approx(1.0)
    gap = -20 * math.log(ego[25])
    assert gap == pytest.approx(18 - 4.5, abs=0.2)
    assert ego[32] == pytest.approx(1 - 30 / 120, abs=0.01)
    assert ego[33:36].tolist() == [
        1,
        0,
        0,
    ]


def test_the_curve_speed_of_a_circle_is_that_of_its_radius():
    points = arc(
        0,
        0,
        heading=0,
        curvature=0.02,
    )[None, None]
    state = locate(
        torch.tensor([[[0.0, 0.0, 0.0, 8.0]]]),
        torch.zeros(1, 1),
        yaw_rate=torch.zeros(1, 1),
        points=points,
    )
    assert curve_speed(
        state,
        points,
        lateral=2.5,
        brake=1.2,
    ).item() == pytest.approx(math.sqrt(2.5 / 0.02), rel=1e-2)


def spiral(rate):
    """Vertices [150, 2] every 2 m of a route whose curvature grows by `rate` a metre
    from 20 m on."""
    s = 0.02 * torch.arange(15_000, dtype=torch.float64) - 20.0
    heading = rate * s.clamp(min=0) ** 2 / 2
    step = 0.02 * torch.stack([heading.cos(), heading.sin()], -1)
    line = step.cumsum(0) - step[0] + torch.tensor([-20.0, 0.0])
    return line[::100].float()


def ego_nodes(points, **options):
    scene = curved_scenes(**options)
    scene["start"][:, 0] = torch.tensor([0.0, 0.0, 0.0, 8.0])
    scene["route_points"][:, 0] = points
    scene["start_yaw_rate"][:, 0] = 0.0
    return features(scene)[0][0, 0]


def test_curvature_is_seen_now_and_up_to_60_metres_ahead():
    """15 times the curvature."""
    nodes = ego_nodes(spiral(0.001))
    at = torch.tensor([5.0, 10.0, 20.0, 30.0, 45.0, 60.0])
    torch.testing.assert_close(
        nodes[10:16],
        15 * 0.001 * at,
        rtol=0,
        atol=2e-2,
    )


def test_turns_are_seen_10_to_80_metres_ahead():
    nodes = ego_nodes(
        arc(
            0.0,
            0.0,
            heading=0.0,
            curvature=0.01,
        )
    )
    expected = torch.tensor([0.1, 0.2, 0.4, 0.6, 0.8])
    torch.testing.assert_close(
        nodes[16:21],
        expected,
        rtol=0,
        atol=5e-3,
    )


def test_speed_to_spare_is_that_of_comfortable_curves():
    """2.5 m/s^2 of lateral acceleration in a circle of 50 m."""
    nodes = ego_nodes(
        arc(
            0.0,
            0.0,
            heading=0.0,
            curvature=0.02,
        )
    )
    assert nodes[22].item() == pytest.approx((math.sqrt(2.5 * 50) - 8) / 5, abs=0.01)


def test_speed_to_spare_before_a_curve_is_that_of_comfortable_braking():
    """Straight for 40 m, then a circle of 10 m, met after braking by 1.2 m/s^2; the
    vertices round where it begins."""
    bend = arc(
        40.0,
        0.0,
        heading=0.0,
        curvature=0.1,
        back=0.0,
    )
    straight = torch.stack([torch.arange(-20.0, 40.0, 2.0), torch.zeros(30)], -1)
    nodes = ego_nodes(torch.cat([straight, bend])[:150])
    expected = math.sqrt(2.5 * 10 + 2 * 1.2 * 40) - 8
    assert nodes[22].item() == pytest.approx(expected / 5, abs=0.08)


def test_leaders_are_seen_now_and_in_one_and_a_half_and_three_seconds():
    """At constant velocity, while the vehicle stays where it is."""
    scene = curved_scenes()
    scene["start"][:, 1] = torch.tensor([18.0, 0.0, 0.0, 6.0])
    routed = route_scene(scene, scene["route_log"].clamp(min=0))
    present = scene["valid"].clone()
    present[:, 2:] = False
    gap = leaders_ahead(
        routed,
        torch.full(scene["route_log"].shape, 20.0),
        agents=scene["start"],
        present=present,
    ).gap[0, 0]
    assert gap.diff().tolist() == pytest.approx([9.0, 9.0], abs=0.1)


def idm(
    v,
    limit,
    gap=None,
    leading=0.0,
):
    """Acceleration of a driver with 1 s of headway, 2 m at a standstill, 1.5 and 2
    m/s^2."""
    wanted = 2.0 + max(0, v + v * (v - leading) / (2 * math.sqrt(1.5 * 2.0)))
    interaction = 0.0 if gap is None else (wanted / gap) ** 2
    return 1.5 * (1 - (v / limit) ** 4 - interaction)


def test_what_a_driver_would_do_is_seen():
    nodes = ego_nodes(
        arc(
            0.0,
            0.0,
            heading=0.0,
            curvature=0.0,
        ),
        limit=15.0,
    )
    gap = -20 * math.log(nodes[25])
    expected = idm(
        8.0,
        15.0,
        gap=gap,
        leading=6.0,
    )
    assert nodes[31].item() == pytest.approx(expected / 2, abs=0.02)


def test_what_a_driver_would_do_on_a_free_road_is_seen():
    scene = curved_scenes(limit=15.0)
    scene["valid"][:, 1:] = False
    scene["route_points"][:, 0] = arc(0.0, 0.0, heading=0.0, curvature=0.0)
    assert features(scene)[0][0, 0, 31].item() == pytest.approx(
        idm(8.0, 15.0) / 2,
        abs=0.01,
    )
