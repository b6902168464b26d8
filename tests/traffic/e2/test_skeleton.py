import math

import pytest
import torch

from e2rl.run.errors import InputError
from e2rl.traffic.e2.anchoring import AnchorSettings, propose
from e2rl.traffic.e2.feasibility import FeasibilitySettings, feasible_vehicles
from e2rl.traffic.e2.interception import InterceptionSettings
from e2rl.traffic.e2.skeleton import (
    NEAREST_FEASIBLE,
    NOBODY,
    SUPPORTED,
    SkeletonSettings,
    chain_depth,
    lane_of,
    limits_of,
)
from e2rl.traffic.e2.topology import TopologySettings, topological_candidates
from e2rl.traffic.traffic import CHAIN, FULL, PAIR, SINGLE
from tests.traffic.e2.crossing import make_world, mask, skeleton_of

UP = math.pi / 2
EGO = (0.0, 0.0, 0.0, 10.0)
COLUMN = [(30.0, -20.0 - 18 * k, UP, 8.0) for k in range(3)]  # one behind the other, towards the ego's way


def test_near_vehicles_act_on_the_ego():
    world = make_world([EGO, (12.0, 3.5, 0.0, 10.0), (-14.0, 0.0, 0.0, 10.0), (60.0, 3.5, 0.0, 10.0)])
    result = skeleton_of(world, mask(world, 1, 2, 3), near=2)
    assert result.coalition.nonzero().tolist() == [[0, 1], [0, 2]]
    assert result.target[0, :4].tolist() == [-1, 0, 0, -1] and result.depth[0, :4].tolist() == [0, 1, 1, 0]
    assert result.source.tolist() == [SUPPORTED] and result.chains.tolist() == [0]


def test_a_support_smaller_than_its_capacity_is_used_whole():
    world = make_world([EGO, (12.0, 3.5, 0.0, 10.0)])
    result = skeleton_of(world, mask(world, 1), near=3, far=2)
    assert result.coalition.nonzero().tolist() == [[0, 1]]


def test_a_column_forms_a_chain_and_its_intermediate_is_controlled():
    world = make_world([EGO, *COLUMN])
    result = skeleton_of(world, mask(world, 1, 2, 3), near=1)
    assert result.target[0, :4].tolist() == [-1, 0, 1, 2]
    assert result.depth[0, :4].tolist() == [0, 1, 2, 3]
    assert result.near[0].nonzero().tolist() == [[1]] and result.far[0].nonzero().tolist() == [[3]]
    assert result.chains.tolist() == [1]


@pytest.mark.parametrize(
    "change",
    [{"max_chain": 2}, {"tau_long": 10.0}, {"horizon": 1.0}, {"max_dist": 40.0}, {"far": 0}, {"tau_dist": 90.0}],
)
def test_chains_beyond_the_limits_are_pruned_to_the_near(change):
    world = make_world([EGO, *COLUMN])
    result = skeleton_of(world, mask(world, 1, 2, 3), near=1, **change)
    assert result.coalition.nonzero().tolist() == [[0, 1]] and result.chains.tolist() == [0]


def test_without_the_intermediate_in_the_support_there_is_no_chain():
    world = make_world([EGO, *COLUMN])
    assert skeleton_of(world, mask(world, 1, 3), near=1).coalition.nonzero().tolist() == [[0, 1]]


def test_a_vehicle_that_drives_away_starts_no_chain():
    world = make_world([EGO, COLUMN[0], (30.0, -38.0, -UP, 8.0)])
    assert skeleton_of(world, mask(world, 1, 2), near=1).chains.tolist() == [0]


def test_effects_may_not_precede_their_causes():
    # 2 can act on 1 only once 1 has passed the ego's corridor: the link to the ego is over by then.
    world = make_world([EGO, (30.0, -20.0, UP, 12.0), (75.0, 30.0, math.pi, 9.0)])
    late = skeleton_of(world, mask(world, 1, 2), near=1)
    assert late.chains.tolist() == [0]


def test_the_ego_s_own_and_neighbour_lanes_hold_no_initiator():
    world = make_world([EGO, (12.0, -10.0, UP, 8.0), (-30.0, 3.5, 0.0, 12.0), (-20.0, 0.0, 0.0, 12.0)])
    result = skeleton_of(world, mask(world, 1, 2, 3), near=1)
    assert result.coalition.nonzero().tolist() == [[0, 1]] and not result.far.any()
    assert lane_of(world.states[:, :4], world.scene).tolist() == [[0, -1, 1, 0]]


def test_an_empty_support_falls_back_to_the_nearest_feasible_then_to_nobody():
    world = make_world([EGO, (40.0, -30.0, UP, 8.0), (12.0, 3.5, 0.0, 10.0), (20.0, 3.5, 0.0, 9.0)], copies=3)
    support, feasible = mask(world, 1), mask(world, 1, 2, 3)
    support[1:], feasible[2] = False, False
    result = skeleton_of(world, support, feasible, near=2)
    assert result.source.tolist() == [SUPPORTED, NEAREST_FEASIBLE, NOBODY]
    assert result.coalition.nonzero().tolist() == [[0, 1], [1, 2], [1, 3]]
    assert result.counts() == {"supported": 1, "nearest_feasible": 1, "nobody": 1, "chains": 0}


def test_pursuit_takes_the_nearest_of_the_support_where_nobody_can_meet_the_ego():
    """Of S, or of F where S is empty, by distance; scenes in which somebody can are as without it."""
    world = make_world([EGO, (40.0, -30.0, UP, 8.0), (12.0, 3.5, 0.0, 10.0), (20.0, 3.5, 0.0, 9.0)], copies=3)
    support, feasible = mask(world, 1, 2), mask(world, 1, 2, 3)
    support[1] = False
    cost = torch.full(support.shape, torch.inf)
    cost[2, 1] = 1.0
    chosen = [
        skeleton_of(world, support, feasible, cost=cost, near=1, far=0, pursuit=pursuit).coalition.nonzero().tolist()
        for pursuit in (False, True)
    ]
    assert chosen == [[[2, 1]], [[0, 2], [1, 2], [2, 1]]]


def test_every_link_leads_to_the_ego_and_absent_vehicles_take_no_part():
    generator = torch.Generator().manual_seed(0)
    chains = 0
    for _ in range(8):
        spots = torch.rand(4, 4, generator=generator) * torch.tensor([80.0, 80, 6.28, 12])
        spots[:, :2] -= 40
        world = make_world([EGO, *COLUMN, *spots.tolist()], copies=4)
        world.valid[:, 1:8] &= torch.rand(4, 7, generator=generator) < 0.9
        support = torch.rand(4, 8, generator=generator) < 0.8
        result = skeleton_of(world, support, near=1, far=2, tau_long=40.0)
        chains += int(result.chains.sum())
        assert not (result.coalition & ~(support & world.valid[:, :8])).any() and not result.coalition[:, 0].any()
        assert torch.equal(result.coalition, result.target >= 0) and torch.equal(result.coalition, result.depth > 0)
        assert torch.equal(chain_depth(result.target), result.depth)
        for b, i in result.coalition.nonzero().tolist():
            way = [i]
            while way[-1] != 0:
                way.append(int(result.target[b, way[-1]]))
                assert len(way) <= 5
            assert len(way) - 1 == result.depth[b, i]
    assert chains > 0


def test_causal_templates_limit_each_scene_by_itself():
    """A scene for each template, all alike: three vehicles in a column and one beside the ego."""
    world = make_world([EGO, *COLUMN, (12.0, 3.5, 0.0, 10.0)], copies=4)
    support, settings = mask(world, 1, 2, 3, 4), SkeletonSettings(near=3)
    limits = limits_of(torch.tensor([SINGLE, PAIR, CHAIN, FULL]), settings)
    result = skeleton_of(world, support, near=3, limits=limits)
    assert result.near.sum(1).tolist() == [1, 2, 1, 3]
    assert not result.far[:2].any() and (result.far.sum(1) <= 1).all()
    assert torch.equal(result.coalition[:2], result.near[:2]) and (result.target[:3] == 0).sum(1).tolist() == [1, 2, 1]
    alone = skeleton_of(world, support, near=3)
    assert all(torch.equal(getattr(result, name)[3], getattr(alone, name)[3]) for name in vars(alone))


def test_the_template_chain_finds_the_column_and_single_does_not():
    world = make_world([EGO, *COLUMN], copies=2)
    limits = limits_of(torch.tensor([CHAIN, SINGLE]), SkeletonSettings(far=0))
    result = skeleton_of(world, mask(world, 1, 2, 3), near=3, far=0, limits=limits)
    assert result.target[:, :4].tolist() == [[-1, 0, 1, 2], [-1, 0, -1, -1]]


def test_bad_settings_are_refused():
    with pytest.raises(InputError, match="near"):
        SkeletonSettings(near=0)


def test_an_ego_alone_passes_through_every_room():
    world = make_world([EGO], copies=2)
    scene, plan = world.scene, world.scene["logged"][:, 1:51, 0]
    found = topological_candidates(
        scene["logged"][:, :, :8], scene["logged_valid"][:, :, :8], scene["size"][:, :8], TopologySettings()
    )
    feasible = feasible_vehicles(scene, world, FeasibilitySettings()).mask
    result = skeleton_of(world, found.candidates & feasible, feasible)
    anchor = propose(scene, world, result, plan, AnchorSettings(), InterceptionSettings(), torch.full((2,), 2.0))
    assert not (found.candidates | feasible | result.coalition | anchor.feasible).any()
    assert result.source.tolist() == [NOBODY, NOBODY]
