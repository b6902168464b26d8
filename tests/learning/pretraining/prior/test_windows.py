"""Training windows: constant motion is x near 0, mirrored scenes give mirrored windows,
what cannot teach weighs 0."""

import pytest
import torch

from e2rl.learning.pretraining.prior.windows import (
    OFFSETS,
    ROWS,
    derivative,
    make_windows,
)
from e2rl.prior.features import SIDED_EDGE, SIDED_NODE
from e2rl.prior.lane_relative import KNOTS, SIZE
from tests.prior.small import VEHICLES, curved_scenes, mirrored
from tests.synthetic import make_scenes

FIRST = len(VEHICLES)


def test_constant_velocity_along_the_lane_is_zero_x():
    windows = make_windows(make_scenes(2, num_vehicles=3).scenes)
    assert len(windows) == 2 * (len(OFFSETS) + 1)
    use = windows["weight"] > 0
    assert use[:, :3].all()
    assert not use[:, 3:].any()
    torch.testing.assert_close(
        windows["x0"][use], torch.zeros(int(use.sum()), SIZE), rtol=0, atol=2e-2
    )
    ahead = 10 * 0.5 * torch.arange(1, KNOTS + 1)
    torch.testing.assert_close(
        windows["ahead"][use], ahead.expand(int(use.sum()), KNOTS), rtol=0, atol=1e-2
    )


@pytest.mark.parametrize("free", [False, True])
def test_mirrored_scenes_give_mirrored_windows(free):
    scene = curved_scenes()
    scene["route_valid"][:, :FIRST] &= not free
    here = make_windows(scene)
    place = make_windows(mirrored(scene))
    assert len(here) == len(place)
    for key, sided in (
        ("nodes", SIDED_NODE),
        ("pairs", SIDED_EDGE),
        ("x0", (KNOTS, KNOTS + 1)),
    ):
        sign = torch.ones(here[key].shape[-1])
        sign[list(sided)] = -1
        real = [slice(None), slice(0, FIRST), slice(0, FIRST)][: here[key].ndim - 1]
        torch.testing.assert_close(
            place[key][real], (here[key] * sign)[real], rtol=0, atol=2e-2, msg=key
        )
    for key in ("d", "d1", "d2", "aside"):
        torch.testing.assert_close(
            place[key][:, :FIRST], -here[key][:, :FIRST], rtol=0, atol=2e-3, msg=key
        )
    for key in ("v", "a", "ahead", "weight"):
        torch.testing.assert_close(
            place[key],
            here[key],
            rtol=0,
            atol=2e-2,
            msg=key,
        )


def test_the_ego_leads_every_window_and_parked_or_lost_vehicles_teach_nothing():
    scene = make_scenes(
        1, vehicles=[(0, 0, 8), (20, 0, 8), (40, 1, 0), (60, 0, 8), (80, 0, 8)]
    ).scenes
    scene["logged_valid"][:, 3:, 3] = False  # seen too briefly
    scene["route_log"][:, 4] = -1  # no candidate is what it drove
    windows = make_windows(scene)
    assert windows["present"].shape[1] == ROWS
    torch.testing.assert_close(windows["d"][:, 0], torch.zeros(len(windows)))
    assert (windows["weight"] > 0).sum(1).tolist() == [2] * len(windows), (
        "the ego and one other"
    )


def test_free_space_windows_are_not_judged_by_their_offset_from_a_route():
    """Vehicles without a route candidate: the distance is the one driven, not one along
    a route."""
    scene = curved_scenes()
    scene["route_valid"][:, 2] = False
    mixed = make_windows(scene)
    lane = make_windows(curved_scenes())
    assert lane["on_lane"][:, :FIRST].all()
    free = ~mixed["on_lane"] & (mixed["weight"] > 0)
    assert (free[:, :FIRST].sum(1) == 1).all()
    time = 0.5 * torch.arange(1, KNOTS + 1)
    expected = (mixed["v"][..., None] * time)[free]
    torch.testing.assert_close(
        mixed["ahead"][free],
        expected,
        rtol=0.02,
        atol=0.1,
    )


def test_the_derivative_of_a_parabola_is_exact_inside_and_one_sided_at_gaps():
    time = 0.1 * torch.arange(12.0)
    values = (time**2)[None, :, None]
    valid = torch.ones(1, 12, 1, dtype=torch.bool)
    result = derivative(values, valid)[0, :, 0]
    torch.testing.assert_close(
        result[1:-1],
        2 * time[1:-1],
        rtol=0,
        atol=1e-5,
    )
    valid[:, 6] = False
    gap = derivative(values, valid)[0, :, 0]
    assert gap[6] == 0
    assert gap[5].item() == pytest.approx(2 * 0.45, abs=1e-4)
    assert gap[7].item() == pytest.approx(2 * 0.75, abs=1e-4)
