"""The duty of care: who gives way to the ego, and that the law is what a competent driver survives."""

import math

import pytest
import torch

from e2rl.prior.lane_relative import HORIZON
from e2rl.synthesizer.margin import competent_margin
from e2rl.synthesizer.responsibility import CareSettings, duty_of, followed, lawful, leading
from e2rl.traffic.traffic import keep_velocity
from tests.synthesizer.crossing import make_world
from tests.synthesizer.traffic_scenes import drive, scenes, synthesizer

EGO = (0.0, 0.0, 0.0, 12.0)
SIZE = torch.tensor([[4.5, 2.0]])


def motion(x, y, heading, speed, braking=0.0):
    """States [1, HORIZON + 1, 4] of a vehicle that brakes at a constant rate to a halt."""
    time = 0.1 * torch.arange(HORIZON + 1)
    time = time if braking == 0 else time.clamp(max=speed / braking)
    way = speed * time - braking * time**2 / 2
    states = [x + way * math.cos(heading), y + way * math.sin(heading), heading + 0 * way, speed - braking * time]
    return torch.stack(states, -1)[None]


def test_the_margin_is_the_least_gap_behind_a_slower_vehicle():
    ego = motion(0, 0, 0, 12.0)
    far, near = (competent_margin(ego, SIZE, motion(x, 0, 0, 6.0), SIZE) for x in (40.0, 22.0))
    assert far > near > 0
    assert near < 22.0 - 4.5


def test_what_cannot_be_survived_has_no_margin_and_what_does_not_meet_has_an_infinite_one():
    ego = motion(0, 0, 0, 12.0)
    assert competent_margin(ego, SIZE, motion(8.0, 0, 0, 2.0), SIZE) <= 0
    assert competent_margin(ego, SIZE, motion(-10.0, 0, 0, 20.0), SIZE) <= 0  # from behind
    assert competent_margin(ego, SIZE, motion(30.0, 4.0, 0, 6.0), SIZE).isinf()


def test_harder_braking_ahead_leaves_less():
    ego = motion(0, 0, 0, 12.0)
    left = [competent_margin(ego, SIZE, motion(45.0, 0, 0, 12.0, braking), SIZE).item() for braking in (1.0, 2.0, 8.0)]
    assert left[0] > left[1] > left[2]


def world_of(*cars):
    world = make_world([EGO, *cars])
    vehicles = world.scene["route_log"].shape[1]
    coalition = torch.zeros(1, vehicles, dtype=torch.bool)
    coalition[0, 1 : len(cars) + 1] = True
    planned = keep_velocity(world.states[:, :vehicles])
    return world, coalition, planned, planned[:, 0]


def test_in_its_track_ahead_it_is_followed_and_beside_it_leads_only():
    world, *_ = world_of(
        (20.0, 0.0, 0.0, 10.0), (20.0, 3.5, 0.0, 10.0), (-20.0, 0.0, 0.0, 10.0), (20.0, 0, math.pi, 9.0)
    )
    assert followed(world, 5)[0].tolist() == [False, True, False, False, False]
    assert leading(world, 5)[0].tolist() == [False, True, True, False, False]


def test_only_lawful_adversaries_and_those_that_the_ego_follows_need_not_give_way():
    ahead, rammer, beside = (8.0, 0.0, 0.0, 2.0), (-12.0, 0.0, 0.0, 20.0), (0.0, 6.0, 0.0, 12.0)
    world, coalition, planned, ego_plan = world_of(ahead, rammer, beside)
    kept = lawful(world, coalition, planned, ego_plan)[0, 1:4].tolist()
    assert kept == [False, False, True]
    eta = torch.tensor([2.0])
    duty = duty_of("full", CareSettings(), world, coalition, eta, planned, ego_plan)
    assert duty.exempt[0, 1:4].tolist() == [True, False, True]
    assert torch.equal(duty.yields, coalition & ~duty.exempt)
    assert duty.patience[0, :4].tolist() == [0.0, 2.0, 0.0, 0.0], "who is not ahead of the ego brakes at once"


@pytest.mark.parametrize("responsibility, exempt", [("none", [True, True]), ("rear", [True, False])])
def test_less_responsibility_binds_only_those_behind_or_nobody(responsibility, exempt):
    world, coalition, planned, ego_plan = world_of((15.0, 4.0, 0.0, 10.0), (-15.0, 0.0, 0.0, 14.0))
    duty = duty_of(responsibility, CareSettings(), world, coalition, torch.tensor([2.0]), planned, ego_plan)
    assert duty.exempt[0, 1:3].tolist() == exempt
    assert not duty.yields.any() and not duty.patience.any()


def test_an_adversary_with_responsibility_never_comes_from_behind():
    """Closed loop, an ego that keeps its speed: whoever is behind it stays behind."""
    scene_set = scenes(3, steps=40)
    out = drive(scene_set, synthesizer(), 3.0)
    start = out["states"][:, :1, :, 0] - out["states"][:, :1, :1, 0]
    touching = out["states"][..., 0] - out["states"][..., :1, 0]
    same_lane = (out["states"][..., 1] - out["states"][..., :1, 1]).abs() < 1.5
    behind = (start < -4) & out["adversaries"][:, None]
    assert not (behind & same_lane & (touching.abs() < 4.0)).any()
