import math

import pytest
import torch

from e2rl.traffic.e2.feasibility import (
    EGO_ACCELERATION,
    FeasibilitySettings,
    feasible_vehicles,
)
from e2rl.traffic.motion import MAX_BRAKING, arrival_window, reachable_distance
from tests.traffic.e2.crossing import add_route, make_world

UP = math.pi / 2
LEFT = math.pi
EGO = (0.0, 0.0, 0.0, 10.0)
SETTINGS = FeasibilitySettings()


def judge(*vehicles, settings=SETTINGS):
    world = make_world([EGO, *vehicles])
    return feasible_vehicles(world.scene, world, settings=settings), world


def test_routes_that_cross_meet_where_the_lines_do():
    oblique = judge((20.0, -30.0, 0.7, 12.0))[0].conflicts
    assert oblique.s[0, 1, 0] == pytest.approx(20 + 30 / math.sin(0.7), abs=0.1)
    result, _ = judge((50.3, -41.7, UP, 10.0))
    table = result.conflicts
    assert result.mask[0].tolist() == [False, True] + [False] * 6
    assert table.s[0, 1, 0] == pytest.approx(20 + 41.7, abs=0.05)
    assert table.exists[0, 1].tolist() == [True] + [False] * 5
    assert not table.exists[0, 2].any()


def test_windows_hold_what_both_can_reach():
    table = judge((50.0, -40.0, UP, 10.0))[0].conflicts
    earliest = table.earliest[0, 1, 0]
    latest = table.latest[0, 1, 0]
    push = EGO_ACCELERATION
    alone = (
        math.sqrt(100 + 2 * push * (50 - 4.5 / 2)) - 10
    ) / push  # the ego flat out, to its front bumper
    assert earliest == pytest.approx(alone, abs=0.15)
    assert latest == SETTINGS.horizon


@pytest.mark.parametrize(
    "vehicle, conflicting",
    [
        ((-20.0, 0.0, 0.0, 12.0), True),  # behind in the same lane
        ((25.0, 0.0, 0.0, 8.0), True),  # ahead in the same lane
        ((0.0, 5.9, 0.0, 10.0), True),  # parallel, and could come over
        ((0.0, 6.1, 0.0, 10.0), False),  # parallel, too far
        ((30.0, 20.0, UP, 10.0), False),  # has crossed already
        ((110.0, -100.0, UP, 2.0), False),  # cannot be there in time
        ((60.0, 0.0, LEFT, 10.0), True),  # head-on
    ],
)
def test_who_can_meet_the_ego(vehicle, conflicting):
    assert judge(vehicle)[0].conflicting[0, 1] == conflicting


def test_only_the_candidate_that_crosses_is_listed():
    world = make_world([EGO, (40.0, 20.0, 0.0, 8.0)])
    add_route(world, 1, candidate=3, heading=-UP)
    table = feasible_vehicles(world.scene, world, settings=SETTINGS).conflicts
    assert table.exists[0, 1].nonzero().tolist() == [[3]]


@pytest.mark.parametrize(
    ("aside", "turn", "depth", "associated"),
    [
        (1.9, 0.0, -1.0, True),
        (2.1, 0.0, -1.0, False),
        (-2.1, 0.0, -1.0, False),
        (0.0, 0.75, -1.0, True),
        (0.0, 0.85, -1.0, False),
        (0.0, -0.85, -1.0, False),
        (0.0, 0.0, 0.5, False),
    ],
)
def test_whoever_is_on_the_road_near_a_centreline_and_along_it_is_associated(
    aside, turn, depth, associated
):
    world = make_world([EGO, (30.0, -20.0, UP, 5.0)])
    world.states[:, 1, 0] += aside
    world.states[:, 1, 2] += turn
    world.scene["field"].fill_(depth)
    result = feasible_vehicles(world.scene, world, settings=SETTINGS)
    assert result.associated[0, 1] == associated
    assert associated or not result.mask.any()


@pytest.mark.parametrize(
    ("gap", "aside", "speed", "relevant"),
    [
        (14.9, 0.0, 0.0, True),
        (15.1, 0.0, 0.0, False),
        (10.0, 0.25, 0.0, True),
        (10.0, 0.35, 0.0, False),
        (40.0, 0.0, 0.55, True),
        (40.0, 0.0, 0.45, False),
        (-14.0, 0.0, 0.0, False),
    ],
)
def test_whoever_moves_or_stands_closely_ahead_is_relevant(gap, aside, speed, relevant):
    """gap: bumper to bumper; aside: beyond where the boxes would touch."""
    world = make_world([EGO, (0.0, 0.0, 0.0, speed)])
    length, width = (world.scene["size"][0, :2].sum(0) / 2).tolist()
    world.states[:, 1, 0] = gap + math.copysign(length, gap)
    world.states[:, 1, 1] = width + aside if aside else 0.0
    assert (
        feasible_vehicles(world.scene, world, settings=SETTINGS).relevant[0, 1]
        == relevant
    )
    world.scene["parked"][:, 1] = True
    assert not feasible_vehicles(world.scene, world, settings=SETTINGS).relevant[0, 1]


def test_absent_vehicles_and_the_ego_are_never_feasible_and_scenes_do_not_mix():
    alone = judge((50.0, -40.0, UP, 10.0))[0]
    world = make_world([EGO, (50.0, -40.0, UP, 10.0)], copies=3)
    world.valid[1, 1] = False
    result = feasible_vehicles(world.scene, world, settings=SETTINGS)
    assert result.mask[:, 1].tolist() == [True, False, True]
    assert not result.mask[:, 0].any()
    torch.testing.assert_close(result.conflicts.s[2], alone.conflicts.s[0])


def test_arrival_windows_solve_the_equations_of_motion():
    speed = torch.tensor([0.0, 5.0, 10.0, 30.0])
    x = torch.tensor([10.0, 40.0, 9.0, 60.0])
    earliest, latest = arrival_window(x, speed)
    for e, way, v in zip(earliest.tolist(), x.tolist(), speed.tolist(), strict=True):
        most = reachable_distance(torch.tensor(v), torch.tensor(e))[1]
        assert most == pytest.approx(way, abs=1e-3)
    assert latest.tolist()[:2] == [torch.inf, torch.inf]
    assert 10 * latest[2] - MAX_BRAKING / 2 * latest[2] ** 2 == pytest.approx(
        9.0, abs=1e-4
    )
    assert arrival_window(torch.tensor(-3.0), torch.tensor(7.0))[1] == 0


@pytest.mark.parametrize(("x", "conflicting"), [(79.0, True), (83.0, False)])
def test_by_default_routes_meet_within_five_seconds(x, conflicting):
    """The ego, flat out at 2 m/s^2 from 10 m/s, drives 75 m; both have a length."""
    result = judge((x, -30.0, UP, 10.0))[0]
    assert result.conflicting[0, 1].item() is conflicting
