"""Constant velocity: straight lines from the start at the start's speed, parked vehicles where they are."""

import torch

from e2rl.scenes.recording import DT
from e2rl.traffic.rule_based import ConstantVelocity
from e2rl.traffic.traffic import keep_velocity
from tests.prior.small import VEHICLES, curved_scenes, moved
from tests.traffic.e2.traffic_scenes import drive, replanned, scenes


def test_everybody_goes_straight_on_for_the_whole_rollout_and_nobody_leaves():
    scene_set = scenes(2, steps=40)
    scene_set.scenes["start"][:, 1:5, 2] = torch.tensor([0.3, -2.0, 3.0, 1.0])
    scene_set.scenes["logged"][:, 0] = scene_set.scenes["start"]
    scene_set.scenes["logged_valid"][:, 5:, 2] = False  # what is recorded later is not known
    rollouts = drive(scene_set, ConstantVelocity(), 0.0)
    start = scene_set.scenes["start"][:, None, 1:6]
    velocity = start[..., 3:] * torch.stack([start[..., 2].cos(), start[..., 2].sin()], -1)
    track = rollouts.states[:, :, 1:6]
    expected = start[..., :2] + velocity * DT * torch.arange(41)[:, None, None]
    torch.testing.assert_close(track[..., :2], expected, rtol=0, atol=1e-4)
    assert torch.equal(track[..., 2:], start[..., 2:].expand_as(track[..., 2:]))
    assert rollouts.valid[:, :, 1:6].all() and (rollouts.states[:, :, 5, 3] == 0).all()


def test_parked_vehicles_stay_whatever_speed_was_estimated():
    scene = curved_scenes()
    scene["parked"][:, 2] = True
    states = replanned(ConstantVelocity(), scene)[1].states[0]
    assert torch.equal(states[2, :, :3], scene["start"][0, 2, :3].expand(50, 3)) and (states[2, :, 3] == 0).all()
    assert (states[1, -1, :2] - states[1, 0, :2]).norm().item() > 0.9 * 4.9 * VEHICLES[1][3]


def test_it_turns_and_shifts_with_the_scene():
    start, there = (scene["start"][:, :6] for scene in (curved_scenes(), moved(curved_scenes(), 40.0, -7.0, 0.6)))
    steps = torch.tensor([1, 10, 50])
    one, other = keep_velocity(start, steps), keep_velocity(there, steps)
    distance = lambda track: torch.cdist(track[..., :2].flatten(1, 2), track[..., :2].flatten(1, 2))  # noqa: E731
    torch.testing.assert_close(distance(other), distance(one), rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(other[..., 2:], one[..., 2:] + torch.tensor([0.6, 0.0]))
