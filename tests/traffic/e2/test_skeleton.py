"""Algorithm 2: near agents by cost, who can act on whom when, and the shortest causal
chain, against plain Python."""

import math
from itertools import permutations

import pytest
import torch

from e2rl.traffic.e2 import skeleton
from e2rl.traffic.e2.skeleton import (
    STEP,
    SkeletonSettings,
    influence,
    lane_of,
)
from e2rl.traffic.motion import constant_speed_states
from tests.traffic.e2.crossing import add_route, make_world, mask, skeleton_of

UP = math.pi / 2
EGO = (0.0, 0.0, 0.0, 10.0)
COLUMN = [
    (30.0, -20.0 - 18 * k, UP, 8.0) for k in range(3)
]  # one behind the other, towards the ego's path
LENGTH = 4.5


def members(result):
    return result.coalition.nonzero().tolist()


def test_the_near_agents_are_those_of_least_cost_and_act_on_the_ego():
    world = make_world(
        [EGO, (12.0, 3.5, 0.0, 10.0), (-14.0, 0.0, 0.0, 10.0), (60.0, 3.5, 0.0, 10.0)]
    )
    cost = torch.tensor([[0.0, 3.0, 2.0, 1.0, torch.inf, 0.0, 0.0, 0.0]])
    result = skeleton_of(world, mask(world, 1, 2, 3), near=2, cost=cost)
    assert members(result) == [[0, 2], [0, 3]]
    assert torch.equal(result.near, result.coalition)
    assert result.target[0, :4].tolist() == [-1, -1, 0, 0]
    assert result.depth[0, :4].tolist() == [0, 0, 1, 1]
    assert not result.far.any()
    assert members(skeleton_of(world, mask(world, 1), near=3, far=2)) == [[0, 1]], (
        "a small support is used whole"
    )


def test_a_column_forms_a_chain_and_its_intermediate_is_controlled():
    world = make_world([EGO, *COLUMN])
    result = skeleton_of(world, mask(world, 1, 2, 3), near=1)
    assert result.target[0, :4].tolist() == [-1, 0, 1, 2]
    assert result.depth[0, :4].tolist() == [0, 1, 2, 3]
    assert result.near[0].nonzero().tolist() == [[1]]
    assert result.far[0].nonzero().tolist() == [[3]]
    assert members(skeleton_of(world, mask(world, 1, 3), near=1)) == [[0, 1]], (
        "it must be in the support"
    )


@pytest.mark.parametrize(
    ("change", "near", "linked"),
    [
        ({}, 1, True),
        ({"max_chain": 3}, 1, True),
        ({"max_chain": 2}, 1, False),
        ({"tau_long": 10.0}, 1, False),
        ({"horizon": 1.0}, 1, False),
        ({"far": 0}, 1, False),
        ({"tau_dist": 63.0}, 1, True),  # the last of the column is 63.5 m away
        ({"tau_dist": 64.0}, 1, False),
    ],
)
def test_chains_beyond_the_limits_are_pruned_to_the_near(change, near, linked):
    world = make_world([EGO, *COLUMN])
    result = skeleton_of(world, mask(world, 1, 2, 3), near=near, **change)
    assert members(result) == ([[0, 1], [0, 2], [0, 3]] if linked else [[0, 1]])
    assert bool(result.far.any()) == linked


@pytest.mark.parametrize(("limit", "far"), [(64.0, 3), (63.0, 2)])
def test_the_far_agent_is_the_farthest_within_reach(limit, far, monkeypatch):
    monkeypatch.setattr(skeleton, "MAX_DIST", limit)
    world = make_world([EGO, *COLUMN])
    assert skeleton_of(world, mask(world, 1, 2, 3), near=1).far.nonzero().tolist() == [
        [0, far]
    ]


def test_the_ego_s_own_neighbour_and_following_lanes_hold_no_initiator():
    world = make_world(
        [EGO, (12.0, -10.0, UP, 8.0), (-30.0, 3.5, 0.0, 12.0), (-20.0, 0.0, 0.0, 12.0)]
    )
    result = skeleton_of(world, mask(world, 1, 2, 3), near=1)
    assert members(result) == [[0, 1]]
    assert not result.far.any()
    assert lane_of(world.states[:, :4], world.scene).tolist() == [[0, -1, 1, 0]]
    turned = world.states[:, :4].clone()
    turned[0, :, 2] += torch.tensor([1.0, -1.0, 1.1, -1.1])  # 60 degrees are 1.047
    assert lane_of(turned, world.scene).tolist() == [[0, 0, -1, -1]]
    chain = [
        EGO,
        (20.0, -10.0, UP, 8.0),
        (-2.0, 3.5, 0.0, 0.0),
        (-25.0, -10.0, 0.0, 10.0),
    ]
    for lane, counts in (
        (None, True),
        ("lane_left", False),
        ("lane_right", False),
        ("lane_exits", False),
    ):
        world = make_world(chain)
        world.scene["lane_left"][:] = world.scene["lane_right"][:] = -1
        world.scene["lane_exits"][:] = -1
        if lane is not None:
            world.scene[lane][:, 0] = 1
        states = world.states[:, [0, 2]]
        requests = torch.tensor([[True]])
        assert (
            skeleton._on_ego_lanes(states, requests, scene=world.scene).item() != counts
        ), lane


def test_pursuit_takes_the_nearest_of_the_support_where_nobody_can_meet_the_ego():
    """Of S, or of F where S is empty, by distance; scenes in which somebody can are as
    without it."""
    world = make_world(
        [EGO, (40.0, -30.0, UP, 8.0), (12.0, 3.5, 0.0, 10.0), (20.0, 3.5, 0.0, 9.0)],
        copies=3,
    )
    support = mask(world, 1, 2)
    feasible = mask(world, 1, 2, 3)
    support[1] = False
    cost = torch.full(support.shape, torch.inf)
    cost[2, 1] = 1.0
    chosen = [
        members(
            skeleton_of(
                world,
                support,
                feasible=feasible,
                cost=cost,
                near=1,
                far=0,
                pursuit=pursuit,
            )
        )
        for pursuit in (False, True)
    ]
    assert chosen == [[[2, 1]], [[0, 2], [1, 2], [2, 1]]]


def random_world(seed, count=7):
    """Two loose columns of vehicles that drive towards the ego's path, each on one
    straight route."""
    x, y, heading, speed = torch.rand(
        4, count, generator=torch.Generator().manual_seed(seed)
    )
    x = torch.where(torch.arange(count) < 4, 25.0, 32.0) + 4 * x - 2
    return make_world(
        [
            EGO,
            *torch.stack(
                [x, -15 - 45 * y, UP + 0.2 * heading - 0.1, 5 + 6 * speed], -1
            ).tolist(),
        ]
    )


def acts(own, other, time, tau_long):
    """Whether vehicle `own` can act on `other` in `time` s, both states [4], on
    straight routes (Sec. IV-A3)."""
    place = other[:2] + other[3] * time * torch.stack([other[2].cos(), other[2].sin()])
    gap = place - own[:2]
    v = own[3].item()
    along = (own[2].cos() * gap[0] + own[2].sin() * gap[1]).item()
    across = (own[2].cos() * gap[1] - own[2].sin() * gap[0]).item()
    braking = min(time, v / 5.0)
    ramp = min(time, (25.0 - v) / 4.0)
    least = v * braking - 2.5 * braking**2
    most = v * ramp + 2.0 * ramp**2 + 25.0 * (time - ramp)
    reachable = least - LENGTH <= along <= most + LENGTH and along > -LENGTH
    return reachable and abs(across) <= 2.5 and abs(along - v * time) <= tau_long


@pytest.mark.parametrize("seed", range(4))
def test_influence_is_that_of_the_equations_of_motion(seed):
    world = random_world(seed)
    settings = SkeletonSettings(tau_long=12.0)
    times = STEP * torch.arange(1, 11)
    expected = constant_speed_states(world.scene, world, times=times)
    result = influence(
        world,
        index=torch.arange(1, 8)[None],
        present=torch.ones(1, 7, dtype=torch.bool),
        expected=expected,
        settings=settings,
    )[0]
    states = world.states[0]
    wanted = torch.zeros_like(result)
    for i in range(7):
        for j in range(8):
            if i != j:
                other = states[0] if j == 7 else states[j + 1]
                wanted[i, j] = torch.tensor(
                    [
                        acts(states[i + 1], other, time=t, tau_long=12.0)
                        for t in times.tolist()
                    ]
                )
    assert wanted.any()
    assert torch.equal(result, wanted)


def earliest(link, path):
    """The step at which the last link of a path of slots is over, each no earlier than
    the one before; None: never."""
    step = 0
    for single, next_one in zip(path, path[1:], strict=False):
        later = link[single, next_one, step:].nonzero()
        if not len(later):
            return None
        step += int(later[0, 0])
    return step


@pytest.mark.parametrize(
    "seed", [*range(10), 339, 343]
)  # in the last two a near one could act through another
def test_a_chain_is_a_shortest_one_whose_effects_never_precede_their_causes(seed):
    """Against all orders of all vehicles between the far agent and a near one."""
    world = random_world(seed)
    settings = {"near": 2, "far": 1, "tau_long": 25.0, "max_chain": 4}
    result = skeleton_of(world, mask(world, *range(1, 8)), **settings)
    expected = constant_speed_states(
        world.scene, world, times=STEP * torch.arange(1, 11)
    )
    link = influence(
        world,
        index=torch.arange(1, 8)[None],
        present=torch.ones(1, 7, dtype=torch.bool),
        expected=expected,
        settings=SkeletonSettings(**settings),
    )[0]
    near = (result.near[0, 1:].nonzero()[:, 0]).tolist()
    distance = (world.states[0, 1:8, :2] - world.states[0, :1, :2]).norm(dim=-1)
    others = [i for i in range(7) if i not in near]
    far = max(
        (i for i in others if 15.0 < distance[i] <= 80.0), key=lambda i: distance[i]
    )
    between = [i for i in others if i != far]
    paths = [
        (far, *some, last, 7)
        for n in range(3)
        for some in permutations(between, n)
        for last in near
    ]
    viable = [path for path in paths if earliest(link, path) is not None]
    target = result.target[0].tolist()
    if not viable:
        assert not result.far.any()
        assert torch.equal(result.coalition, result.near)
        return
    way = [far + 1]
    while way[-1] != 0:
        way.append(target[way[-1]])
    path = tuple(7 if i == 0 else i - 1 for i in way)
    assert path in viable
    assert len(path) == min(map(len, viable))
    assert result.far.nonzero().tolist() == [[0, far + 1]]
    assert set(result.coalition[0].nonzero()[:, 0].tolist()) == {
        i + 1 for i in near
    } | set(way[:-1])


def test_any_candidate_route_may_lead_to_the_target():
    world = make_world([EGO, COLUMN[0], (10.0, -40.0, UP, 20.0)])
    assert not skeleton_of(world, mask(world, 1, 2), near=1).far.any()
    add_route(
        world, 2, candidate=3, heading=math.atan2(32.0, 20.0)
    )  # towards where the first will be
    assert skeleton_of(world, mask(world, 1, 2), near=1, tau_long=60.0).far.any()


@pytest.mark.parametrize(("last", "far"), [(-74.0, 4), (-74.4, 3)])
def test_a_chain_begins_no_farther_than_80_m_from_the_ego(last, far):
    world = make_world([EGO, *COLUMN, (30.0, last, UP, 8.0)])
    support = mask(world, 1, 2, 3, 4)
    result = skeleton_of(world, support, near=1, max_chain=5, tau_long=25.0)
    assert result.far.nonzero().tolist() == [[0, far]]


def test_by_default_three_act_on_the_ego():
    row = [(30.0, -20.0 - 18 * k, UP, 8.0) for k in range(5)]
    world = make_world([EGO, *row])
    result = skeleton_of(world, mask(world, *range(1, 6)), far=0)
    assert result.near.nonzero()[:, 1].tolist() == [1, 2, 3]


@pytest.mark.parametrize(("distance", "far"), [(14.5, False), (15.5, True)])
def test_by_default_a_vehicle_is_distant_from_15_m_on(distance, far):
    """It follows the near one, which crosses 8 m ahead of the ego."""
    behind = -math.sqrt(distance**2 - 8.0**2)
    vehicles = [(0.0, 0.0, 0.0, 4.0), (8.0, -4.0, UP, 8.0), (8.0, behind, UP, 8.0)]
    world = make_world(vehicles)
    result = skeleton_of(world, mask(world, 1, 2), near=1)
    assert bool(result.far.any()) is far


def column(gap, count):
    """So many vehicles at 8 m/s one behind the other, towards the ego's path."""
    return [(30.0, -20.0 - gap * k, UP, 8.0) for k in range(count)]


@pytest.mark.parametrize(("gap", "linked"), [(19.5, True), (20.5, False)])
def test_by_default_a_vehicle_acts_on_another_up_to_20_m_ahead(gap, linked):
    world = make_world([EGO, *column(gap, 2)])
    result = skeleton_of(world, mask(world, 1, 2), near=1)
    assert bool(result.far.any()) is linked


@pytest.mark.parametrize(("count", "linked"), [(4, True), (5, False)])
def test_by_default_a_chain_has_four_vehicles(count, linked):
    """12 m apart, so that each acts on the one ahead of it alone."""
    world = make_world([EGO, *column(12.0, count)])
    result = skeleton_of(world, mask(world, *range(1, 1 + count)), near=1)
    assert bool(result.far.any()) is linked
