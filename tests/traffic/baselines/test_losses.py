"""Losses against closed forms and a pair by pair computation."""

import math
from itertools import permutations, product

import pytest
import torch

from e2rl.prior.lane_relative import LaneState
from e2rl.traffic.baselines.losses import (
    Pairs,
    approach_term,
    comfort_term,
    discounts,
    disk_gap,
    gaussian_overlap,
    off_road_term,
    overlap_term,
)
from tests.traffic.baselines.attacks import baseline, first_replan
from tests.traffic.e2.traffic_scenes import scenes

SIZE = torch.tensor([[4.0, 2.0]])


def pose(x, y=0.0, heading=0.0, speed=5.0):
    return torch.tensor([[[x, y, heading, speed]]])


def test_disks_reach_from_bumper_to_bumper():
    """Their centres lie 1 m inside both bumpers of a car of 4 x 2 m."""
    distance, radii = disk_gap(pair(10.0))
    assert distance.item() == pytest.approx(8.0, abs=1e-3)
    assert radii.item() == 2.0


def pair(x):
    """A vehicle, and another x m ahead of it."""
    return Pairs(pose(0.0), SIZE, other=pose(x), other_size=SIZE)


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
    assert sharp == pytest.approx(
        3.0 + 0.1 * math.log(4), abs=1e-3
    ) and soft == pytest.approx(6.5, abs=1e-2)


def test_pairs_cost_what_all_pairs_computed_one_by_one_cost():
    _, view = first_replan(baseline("ctg"), scenes(2).scenes)
    generator = torch.Generator().manual_seed(0)
    states = view.states[None, :, :, None].repeat(2, 1, 1, 3, 1)
    states[..., :2] = 0.3 * states[..., :2] + torch.rand(
        states[..., :2].shape, generator=generator
    )
    weights = torch.tensor([0.5, 0.3, 0.2])
    term = overlap_term(states, view, margin=0.2, weights=weights)
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
        states, view, margin=0.2, weights=weights, left_out=everybody
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
    (gradient,) = torch.autograd.grad(cost.sum(), states)
    assert (gradient[0, 0, 1:6, 0, 1] > 0).all()


def test_discounts_sum_to_one_and_comfort_is_free_within_its_bounds():
    assert discounts(torch.zeros(10, 4)).sum().item() == pytest.approx(1.0)
    accel = torch.tensor([[[[0.0, 1.0, 2.0], [-6.0, -6.0, -6.0]]]])
    motion = LaneState(*([torch.zeros_like(accel)] * 10))
    motion.a = accel
    value = comfort_term(motion, low=-3.5, high=2.0, jerk=2.0)[0, 0]
    assert value[0] == 0 and value[1].item() == pytest.approx(2.5**2)
