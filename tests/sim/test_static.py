"""Look-ups of a step: the same numbers as the general functions of routes, missions and
boxes give."""

import torch

from e2rl.scenes.boxes import separation, to_frame
from e2rl.scenes.route import SPACING, interpolate, project
from e2rl.sim.mission import Mission, limit_at, mission_of
from e2rl.sim.neighbours import neighbours_of, rotation_into
from e2rl.sim.static import follow, look_along, static_scene
from e2rl.sim.world import Agents
from tests.synthetic import make_scenes

BATCH = 64
COUNT = 60


def winding(seed=0):
    """A StaticScene whose missions bend at random, with its mission."""
    draw = torch.Generator().manual_seed(seed)
    heading = (0.15 * torch.randn(BATCH, COUNT, generator=draw)).cumsum(1)
    points = (SPACING * torch.stack([heading.cos(), heading.sin()], -1)).cumsum(1)
    limit = torch.randint(0, 30, (BATCH, COUNT), generator=draw).float()
    scene = make_scenes(BATCH, num_points=COUNT).scenes
    mission = mission_of(scene)
    mission = Mission(
        points,
        limit,
        end=mission.end,
        light=mission.light,
        light_s=mission.light_s,
    )
    return static_scene(scene, mission), mission, draw


def test_the_pose_is_the_projection_on_the_mission():
    static, mission, draw = winding()
    hint = 150 * torch.rand(BATCH, generator=draw) - 15
    near = mission.points[
        torch.arange(BATCH), (hint / SPACING).long().clamp(0, COUNT - 1)
    ]
    xy = near + 3 * torch.randn(BATCH, 2, generator=draw)
    expected = project(xy[:, None], mission.points, hint=hint[:, None])
    for result, value in zip(follow(static, xy, hint=hint), expected, strict=True):
        assert torch.equal(result, value[:, 0])


def test_the_way_ahead_is_interpolated_with_its_limit():
    static, mission, draw = winding()
    s = 160 * torch.rand(BATCH, 40, generator=draw) - 20
    ahead = look_along(static, s)
    xy, heading, curvature = interpolate(mission.points, s)
    torch.testing.assert_close(
        torch.stack([ahead.x, ahead.y], -1),
        xy,
        rtol=1e-5,
        atol=1e-5,
    )
    torch.testing.assert_close(
        ahead.heading,
        heading,
        rtol=1e-5,
        atol=1e-5,
    )
    torch.testing.assert_close(
        ahead.curvature,
        curvature,
        rtol=1e-5,
        atol=1e-5,
    )
    assert torch.equal(ahead.limit, limit_at(mission, s))


def test_others_are_seen_in_the_ego_frame_with_their_gap():
    scene = make_scenes(
        BATCH,
        num_vehicles=20,
        num_vrus=5,
    ).scenes
    static = static_scene(scene, mission_of(scene))
    draw = torch.Generator().manual_seed(1)
    scale = torch.tensor([6.0, 6.0, 3.0, 5.0])
    states = scale * torch.randn(BATCH, 48, 4, generator=draw)
    ego = states[:, 0]
    others = states[:, 1:]
    present = scene["valid"][:, 1:]
    observed = neighbours_of(
        ego,
        rotation_into(ego),
        static=static,
        agents=Agents(
            others,
            present,
            accel=others[..., 0],
            turn_rate=others[..., 1],
        ),
    )
    assert torch.allclose(
        observed.position.transpose(1, 2),
        to_frame(others[..., :2], ego[:, None]),
        atol=1e-5,
    )
    turned = others[..., 2] - ego[:, None, 2]
    assert torch.allclose(
        observed.direction, torch.stack([turned.cos(), turned.sin()], 1), atol=1e-5
    )
    size = scene["size"]
    assert torch.allclose(
        observed.gap,
        separation(
            ego[:, None],
            size[:, :1],
            second=others,
            second_size=size[:, 1:],
        ),
        atol=1e-5,
    )
