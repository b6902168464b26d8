"""Losses against closed forms and a pair by pair computation."""

import math
from dataclasses import replace
from itertools import permutations, product

import pytest
import torch

from e2rl.prior.lane_relative import LaneState
from e2rl.traffic.baselines.diffscene import corridor_term
from e2rl.traffic.baselines.losses import (
    Pairs,
    approach_term,
    comfort_term,
    discounts,
    disk_gap,
    gaussian_overlap,
    off_road_term,
    off_route_term,
    overlap_term,
)
from e2rl.traffic.baselines.safe_sim_opt import collision_term, gaussian_term
from tests.traffic.baselines.attacks import baseline, first_replan
from tests.traffic.e2.traffic_scenes import scenes

SIZE = torch.tensor([[4.0, 2.0]])


def pose(
    x,
    y=0.0,
    heading=0.0,
    speed=5.0,
):
    return torch.tensor([[[x, y, heading, speed]]])


def test_disks_reach_from_bumper_to_bumper():
    """Their centres lie 1 m inside both bumpers of a car of 4 x 2 m."""
    distance, radii = disk_gap(pair(10.0))
    assert distance.item() == pytest.approx(8.0, abs=1e-3)
    assert radii.item() == 2.0


def pair(x):
    """A vehicle, and another x m ahead of it."""
    return Pairs(
        pose(0.0),
        SIZE,
        other=pose(x),
        other_size=SIZE,
    )


def test_the_gaussian_is_flat_inside_the_box_and_falls_outside():
    values = [gaussian_overlap(pair(x)).item() for x in (0.0, 1.9, 3.0, 4.0)]
    assert values[0] == values[1] > values[2] > values[3]
    assert values[2] == pytest.approx(10 * math.exp(-0.5 * (1 - 2.25)), rel=1e-4)


def test_the_soft_minimum_lies_between_least_and_mean_distance():
    states = torch.zeros(1, 1, 2, 4, 4)
    states[0, 0, 1, :, 0] = torch.tensor([9.0, 6.0, 3.0, 8.0])
    sharp, soft = (
        approach_term(states, temperature)[0, 0, 1].item() for temperature in (0.1, 1e4)
    )
    assert sharp == pytest.approx(3.0 + 0.1 * math.log(4), abs=1e-3)
    assert soft == pytest.approx(6.5, abs=1e-2)


def test_pairs_cost_what_all_pairs_computed_one_by_one_cost():
    _, view = first_replan(baseline("ctg"), scenes(2).scenes)
    generator = torch.Generator().manual_seed(0)
    states = view.states[None, :, :, None].repeat(2, 1, 1, 3, 1)
    states[..., :2] = 0.3 * states[..., :2] + torch.rand(
        states[..., :2].shape, generator=generator
    )
    weights = torch.tensor([0.5, 0.3, 0.2])
    term = overlap_term(
        states,
        view,
        margin=0.2,
        weights=weights,
    )
    expected = torch.zeros_like(term)
    for s, b in product(range(2), range(2)):
        for i, j in permutations(view.valid[b].nonzero()[:, 0].tolist(), 2):
            distance, radii = disk_gap(
                Pairs(
                    states[s, b, i][None],
                    view.size[b, i][None],
                    other=states[s, b, j][None],
                    other_size=view.size[b, j][None],
                )
            )
            cost = (1 - distance / (radii + 0.2)).clamp(min=0)
            expected[s, b, i] += (cost[0] * weights).sum()
    assert expected.max() > 0.1
    torch.testing.assert_close(term, expected)
    everybody = torch.ones_like(view.routed.conflict)
    without = overlap_term(
        states,
        view,
        margin=0.2,
        weights=weights,
        left_out=everybody,
    )
    assert (without == 0).all()


def test_leaving_the_road_costs_and_the_gradient_leads_back():
    _, view = first_replan(baseline("ctg"), scenes(1).scenes)
    states = view.states[None, :, :, None].clone()
    weights = torch.ones(1)
    assert (off_road_term(states, view, weights=weights)[0, 0, :6] == 0).all()
    states[..., 1] = 9.0  # the road ends at 5.25 m
    states.requires_grad_(True)
    cost = off_road_term(states, view, weights=weights)
    assert (cost[0, 0, :6] > 0).all()
    far = states.detach() + torch.tensor([0.0, 500.0, 0.0, 0.0])
    most = off_road_term(far, view, weights=weights)[0, 0, :6]
    torch.testing.assert_close(most, 5.0 / view.size[0, :6].norm(dim=-1))
    (gradient,) = torch.autograd.grad(cost.sum(), states)
    assert (gradient[0, 0, 1:6, 0, 1] > 0).all()


def test_discounts_sum_to_one_and_comfort_is_free_within_its_bounds():
    assert discounts(torch.zeros(10, 4)).sum().item() == pytest.approx(1.0)
    accel = torch.tensor([[[[0.0, 1.0, 2.0], [-6.0, -6.0, -6.0]]]])
    motion = LaneState(*([torch.zeros_like(accel)] * 10))
    motion.a = accel
    value = comfort_term(
        motion,
        low=-3.5,
        high=2.0,
        jerk=2.0,
    )[0, 0]
    assert value[0] == 0
    assert value[1].item() == pytest.approx(2.5**2)


def test_a_discount_is_a_tenth_a_step():
    weights = discounts(torch.zeros(10, 4))
    assert (weights[1] / weights[0]).item() == pytest.approx(0.9**5)


def test_metres_off_the_route_cost_from_1_metre_and_fivefold_from_2_5_metres():
    _, view = first_replan(baseline("ctg"), scenes(1).scenes)
    offset = torch.tensor([0.9, 2.5, 3.5])[:, None, None, None].expand(
        -1, *view.valid.shape, 2
    )
    motion = LaneState(*([torch.zeros_like(offset)] * 10))
    motion.d = offset
    cost = off_route_term(motion, view)[:, view.routed.has_lane]
    expected = torch.tensor([0.0, 1.5, 2.5 + 4.0])[:, None].expand_as(cost)
    torch.testing.assert_close(cost, expected)


def test_a_far_adversary_costs_safe_sim_30_metres():
    states = torch.zeros(1, 1, 2, 4, 4)
    states[0, 0, 1, :, 0] = 1000.0
    assert collision_term(states)[0, 0, 1].item() == pytest.approx(30.0)


@pytest.mark.parametrize(("moment", "costs"), [(3, True), (4, False)])
def test_safe_sim_s_gaussian_counts_for_2_seconds(moment, costs):
    """Moments are half a second apart, the fourth 2 s ahead."""
    _, view = first_replan(baseline("safe_sim_opt"), scenes(1).scenes)
    states = view.states[None, :, :, None].repeat(1, 1, 1, 10, 1)
    states[..., 0] += 1000.0 * torch.arange(states.shape[2])[:, None]
    states[:, :, 2, moment, :2] = states[:, :, 1, moment, :2]
    assert bool(gaussian_term(states, view)[0, 0, 1] > 0) == costs


@pytest.mark.parametrize(("offset", "cost"), [(0.9, 0.0), (1.5, 0.5), (-2.0, 1.0)])
def test_diffscene_s_adversary_obstructs_the_ego_s_route_within_1_metre(offset, cost):
    _, view = first_replan(baseline("diffscene"), scenes(1).scenes)
    adversary = torch.zeros_like(view.active)
    adversary[:, 2] = True
    states = view.states[None, :, :, None].repeat(1, 1, 1, 10, 1)
    states[:, :, 2] = view.states[:, :1, None]
    states[:, :, 2, :, 1] += offset
    term = corridor_term(states, replace(view, adversary=adversary))
    assert term[0, 0, 2].item() == pytest.approx(cost, abs=1e-3)
    assert term[0, 0, 1].item() == 0


@pytest.mark.parametrize(
    ("name", "value", "free"),
    [
        ("low", -3.4, True),
        ("low", -3.6, False),
        ("high", 1.9, True),
        ("high", 2.1, False),
    ],
)
def test_diffscene_lets_accelerations_from_minus_3_5_to_2_pass(name, value, free):
    on = baseline(
        "diffscene",
        safety=0.0,
        functionality=0.0,
    )
    _, view = first_replan(on, scenes(1).scenes)
    adversary = torch.zeros_like(view.active)
    adversary[:, 2] = True
    view = replace(view, adversary=adversary)
    still = view.lane.map(lambda field: field[None, ..., None].repeat(1, 1, 1, 10))
    still.a = torch.zeros_like(still.a)
    rough = replace(still, a=torch.full_like(still.a, value))
    difference = (on.loss(rough, view) - on.loss(still, view)).sum()
    assert (difference.item() == 0) == free
