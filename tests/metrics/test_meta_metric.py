"""The meta-metric: closed forms of likelihoods and features, an oracle for distances,
and invariances."""

import math

import pytest
import torch

from e2rl.metrics.meta_metric import (
    FAR,
    FEATURES,
    HISTOGRAMS,
    INDICATIONS,
    SMOOTHING,
    TTC_CAP,
    Feature,
    beyond_road,
    bin_index,
    central,
    kinematics,
    likelihood,
    log_bernoulli,
    log_probability,
    meta_metric,
    nearest_object,
    runs_red_light,
    time_to_collision,
)
from e2rl.scenes.boxes import signed_distance
from e2rl.scenes.recording import DT, LIGHT_RED


def test_weights_sum_to_one_so_that_a_certain_log_has_one():
    assert sum(feature.weight for feature in FEATURES.values()) == pytest.approx(1)
    assert meta_metric(
        dict.fromkeys(FEATURES, torch.ones(3))
    ).tolist() == pytest.approx([1] * 3)
    for name, feature in FEATURES.items():
        alone = {other: torch.tensor(float(other == name)) for other in FEATURES}
        assert meta_metric(alone).item() == pytest.approx(feature.weight)
    assert set(HISTOGRAMS) | set(INDICATIONS) == set(FEATURES) and not set(
        HISTOGRAMS
    ) & set(INDICATIONS)


def test_bins_are_equal_parts_of_the_range_and_the_outer_ones_take_the_rest():
    feature = Feature(1.0, -2.0, high=6.0, bins=4)
    values = torch.tensor([-100.0, -2.0, -0.01, 0.0, 1.9, 2.0, 5.9, 6.0, 1e6])
    assert bin_index(values, feature).tolist() == [0, 0, 0, 1, 1, 2, 3, 3, 3]


def test_probabilities_of_all_bins_sum_to_one():
    counts = (
        torch.rand(
            4, 7, generator=torch.Generator().manual_seed(1), dtype=torch.float64
        )
        * 30
    )
    every = torch.arange(7).expand(4, -1)
    assert log_probability(counts, every).exp().sum(1).tolist() == pytest.approx(
        [1] * 4
    )


def test_an_indication_has_the_share_of_rollouts_smoothed():
    hits = torch.tensor([0.0, 8.0, 2.0, 2.0])
    happened = torch.tensor([False, True, True, False])
    p = log_bernoulli(hits, 8, happened=happened).exp()
    sure = (8 + SMOOTHING) / (8 + 2 * SMOOTHING)
    assert p.tolist() == pytest.approx([sure, sure, 2.1 / 8.2, 6.1 / 8.2])
    assert torch.allclose(
        log_bernoulli(hits, 8, happened=~happened).exp() + p, torch.ones(4)
    )


def test_a_scene_s_likelihood_is_the_geometric_mean_over_its_known_values():
    p = torch.tensor([[0.5, 0.25], [0.125, 0.9], [0.3, 0.3]], dtype=torch.float64)
    known = torch.tensor([[True, True], [True, False], [True, True]])
    scene = torch.tensor([2, 2, 0])
    found = likelihood(p.log(), known, scene=scene, scenes=3)
    assert found[0].item() == pytest.approx(0.3) and found[1].isnan()
    assert found[2].item() == pytest.approx((0.5 * 0.25 * 0.125) ** (1 / 3))
    order = torch.tensor([1, 2, 0])
    assert torch.allclose(
        likelihood(p.log()[order], known[order], scene=scene[order], scenes=3),
        found,
        equal_nan=True,
    )


CAR = (4.0, 2.0)
GREEN = LIGHT_RED + 2


def cars(*states):
    """Arguments of the pairwise features for one step: the first car against the
    others."""
    track = torch.tensor(states[:1], dtype=torch.float64)[:, None]
    others = torch.tensor([[states[1:]]], dtype=torch.float64)
    size = torch.tensor(CAR, dtype=torch.float64)
    return [
        track,
        size[None],
        others,
        size.expand(1, len(states) - 1, 2),
        torch.ones(1, 1, len(states) - 1, dtype=torch.bool),
    ]


def ttc(*states):
    """Time to collision of the first car, the same wherever the world is turned."""
    found = []
    for turn in (0.0, 2.0):
        cos = math.cos(turn)
        sin = math.sin(turn)
        turned = [
            (cos * x - sin * y, sin * x + cos * y, heading + turn, speed)
            for x, y, heading, speed in states
        ]
        found.append(time_to_collision(*cars(*turned)).item())
    assert found[0] == pytest.approx(found[1])
    return found[0]


def test_a_steady_turn_has_its_speed_and_yaw_rate_and_edges_are_unknown():
    time = DT * torch.arange(20, dtype=torch.float64)
    heading = 3.0 + 0.3 * time  # over pi on the way: headings wrap
    xy = 10 / 0.3 * torch.stack([heading.sin(), -heading.cos()], -1)
    track = torch.cat(
        [
            xy,
            ((heading + math.pi) % (2 * math.pi) - math.pi)[:, None],
            torch.zeros(20, 1),
        ],
        -1,
    )[None]
    found = kinematics(track, torch.ones(1, 20, dtype=torch.bool))
    expected = {
        "linear_speed": 10,
        "linear_accel": 0,
        "angular_speed": 0.3,
        "angular_accel": 0,
    }
    for name, (values, known) in found.items():
        edge = 1 if name.endswith("speed") else 2
        assert (
            known[0].tolist()
            == [False] * edge + [True] * (20 - 2 * edge) + [False] * edge
        ), name
        torch.testing.assert_close(
            values[0, edge:-edge],
            torch.full((20 - 2 * edge,), expected[name] + 0.0).double(),
            rtol=1e-3,
            atol=1e-6,
        )


def test_central_differences_are_exact_for_parabolas_and_need_both_neighbours():
    time = DT * torch.arange(12, dtype=torch.float64)
    known = torch.ones(1, 12, dtype=torch.bool)
    known[0, 6] = False
    change, both = central((3 * time - 2 * time**2)[None], known)
    assert (~both[0]).nonzero()[:, 0].tolist() == [0, 5, 7, 11]
    torch.testing.assert_close(change[0], (3 - 4 * time) * both[0])


def test_the_nearest_object_is_the_smallest_signed_distance():
    generator = torch.Generator().manual_seed(0)
    draw = lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    track = draw(25, 2, 4) * 8
    others = draw(25, 2, 5, 4) * torch.tensor([30, 30, 7, 9]).double()
    size = 1 + 5 * draw(25, 2)
    other_size = 0.5 + 11 * draw(25, 5, 2)
    seen = draw(25, 2, 5) < 0.8
    found = nearest_object(track, size, others=others, other_size=other_size, seen=seen)
    gaps = signed_distance(
        track[:, :, None],
        size[:, None, None],
        second=others,
        second_size=other_size[:, None],
    )
    torch.testing.assert_close(found, gaps.masked_fill(~seen, FAR).amin(-1))
    assert 5 < (found < 0).sum() < 45, (
        "the draw must hold boxes apart and overlapping ones"
    )


def test_nobody_is_far():
    arguments = cars((0, 0, 0, 5), (3, 0, 0, 5))
    arguments[-1] = torch.zeros_like(arguments[-1])
    assert (
        nearest_object(*arguments).item() == FAR
        and time_to_collision(*arguments).item() == TTC_CAP
    )


@pytest.mark.parametrize(
    ("gap", "fast", "slow"), [(6.0, 10.0, 4.0), (1.0, 3.0, 0.0), (20.0, 15.0, 10.5)]
)
def test_two_in_line_meet_after_gap_over_closing_speed(gap, fast, slow):
    assert ttc((0, 0, 0, fast), (gap + 4, 0, 0, slow)) == pytest.approx(
        gap / (fast - slow)
    )
    assert ttc((0, 0, 0, slow), (gap + 4, 0, 0, fast)) == TTC_CAP, "it gets away"
    assert ttc((gap + 4, 0, 0, fast), (0, 0, 0, slow)) == TTC_CAP, "it is behind"


def test_only_the_nearest_in_one_s_own_width_and_about_one_s_own_heading_is_ahead():
    slow = (16, 0, 0, 4)
    assert ttc((0, 0, 0, 10), slow, (26, 0, 0, 0)) == pytest.approx(2)
    assert ttc((0, 0, 0, 10), (16, 2.01, 0, 4)) == TTC_CAP, "beside"
    assert ttc((0, 0, 0, 10), (16, 1.99, 0, 4)) == pytest.approx(2), (
        "a parallel one counts at the least overlap"
    )
    assert ttc((0, 0, 0, 10), (16, 2.2, 0.3, 4)) == TTC_CAP, (
        "a slanting one at half a metre"
    )
    assert ttc((0, 0, 0, 10), (16, 0, 1.4, 4)) == TTC_CAP, "crossing"
    assert ttc((0, 0, 0, 10), (16, 0, math.pi, 4)) == TTC_CAP, "oncoming"


def test_metres_beyond_the_road_are_those_of_the_worst_corner():
    x = torch.arange(60.0)
    field = x[None, :, None].expand(
        1, 60, 60
    )  # metres beyond the line x = 30, exact under bilinear look-up
    origin = torch.tensor([[-30.0, -30.0]])
    for heading, reach in (
        (0.0, 2.0),
        (math.pi / 2, 1.0),
        (math.atan2(2, 4), math.hypot(2, 1) * math.cos(0)),
    ):
        state = torch.tensor([[[[5.0, 3.0, heading, 0.0]]]])
        found = beyond_road(
            state, torch.tensor([[CAR]]), field=field, origin=origin
        ).item()
        assert found == pytest.approx(30 + 5 + reach, abs=1e-4)


def crossing_of(light_state, known=None, light=(0, -1), speed=10.0):
    """Whether a 4 m car that drives at `speed` from x = 0 runs one of its lights, stop
    line at 8 m."""
    steps = light_state.shape[0]
    track = torch.zeros(1, steps, 4)
    track[0, :, 0] = speed * DT * torch.arange(steps)
    known = torch.ones(1, steps, dtype=torch.bool) if known is None else known
    route = torch.stack([2.0 * torch.arange(-5, 40), torch.zeros(45)], -1)[None]
    return runs_red_light(
        track,
        known,
        size=torch.tensor([CAR]),
        route=route,
        light=torch.tensor([light]),
        light_s=torch.tensor([[18.0, 0.0]]),
        state=light_state[None],
    ).item()  # 18 m from the route's begin


def test_a_red_light_is_run_when_the_front_passes_its_line_while_it_is_red():
    """The front is at 2 m at the start and passes 8 m between steps 6 and 7."""
    red = torch.full((20, 1), LIGHT_RED)
    green = torch.full((20, 1), GREEN)
    early = red.clone()
    late = red.clone()
    early[5:], late[:9] = GREEN, GREEN
    assert crossing_of(red) and not crossing_of(green)
    assert not crossing_of(early) and not crossing_of(late), "red before or after only"
    only = green.clone()
    but = red.clone()
    only[7], but[7] = LIGHT_RED, GREEN
    assert crossing_of(only) and not crossing_of(but), (
        "the colour once it is across counts"
    )
    assert not crossing_of(red, light=(-1, -1)), "no light of its route"
    assert not crossing_of(red, speed=2.0), "it does not get there"
    known = torch.ones(1, 20, dtype=torch.bool)
    known[0, 5:9] = False
    assert not crossing_of(red, known), "it was not there"
    assert not crossing_of(red[:, :0]), "no light in the scene"
