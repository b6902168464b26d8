"""Losses against closed forms and a pair by pair computation."""

import math
from itertools import permutations, product

import pytest
import torch

from e2rl.prior.lane_relative import LaneState
from e2rl.traffic.baselines.losses import (
    approach_term,
    comfort_term,
    discounts,
    disk_gap,
    disk_overlap,
    gaussian_overlap,
    off_road_term,
    pair_term,
)
from tests.traffic.baselines.attacks import baseline, first_replan
from tests.traffic.e2.traffic_scenes import scenes

SIZE = torch.tensor([[4.0, 2.0]])


def pose(x, y=0.0, heading=0.0, speed=5.0):
    return torch.tensor([[[x, y, heading, speed]]])


def test_disks_reach_from_bumper_to_bumper():
    distance, radii = disk_gap(pose(0.0), SIZE, other=pose(10.0), other_size=SIZE)
    assert (
        distance.item() == pytest.approx(8.0, abs=1e-3) and radii.item() == 2.0
    )  # centres 1 m inside both bumpers
    cost = disk_overlap(0.5)(pose(0.0), SIZE, pose(4.0), SIZE)
    assert cost.item() == pytest.approx(1 - 2.0 / 2.5, abs=1e-3)
    assert disk_overlap(0.5)(pose(0.0), SIZE, pose(6.0), SIZE).item() == 0


def test_the_gaussian_is_flat_inside_the_box_and_falls_outside():
    values = [
        gaussian_overlap(pose(0.0), SIZE, other=pose(x), other_size=SIZE).item()
        for x in (0.0, 1.9, 3.0, 4.0)
    ]
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
    found = pair_term(states, view, cost=disk_overlap(0.2), reach=0.2, weights=weights)
    expected = torch.zeros_like(found)
    for s, b in product(range(2), range(2)):
        for i, j in permutations(view.valid[b].nonzero()[:, 0].tolist(), 2):
            first, second = (
                (states[s, b, k][None], view.size[b, k][None]) for k in (i, j)
            )
            expected[s, b, i] += (disk_overlap(0.2)(*first, *second)[0] * weights).sum()
    assert expected.max() > 0.1
    torch.testing.assert_close(found, expected)
    none = torch.ones_like(view.routed.conflict)
    assert (
        pair_term(
            states,
            view,
            cost=disk_overlap(0.2),
            reach=0.2,
            weights=weights,
            left_out=none,
        )
        == 0
    ).all()


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
    value = comfort_term(motion, -3.5, high=2.0, jerk=2.0)[0, 0]
    assert value[0] == 0 and value[1].item() == pytest.approx(2.5**2)
