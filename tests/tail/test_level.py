"""Levels of rollouts made by hand: distance, what is predicted, contacts."""

import math

import pytest
import torch

from e2rl.metrics.score import score_rollouts
from e2rl.scenes.recording import AGENT_TYPES, PEDESTRIAN, VEHICLE
from e2rl.sim.rollouts import Rollouts
from e2rl.tail.level import (
    AHEAD,
    CONTACT,
    PREVENTED,
    clearance,
    contact_level,
    contacts,
)

STEPS = 20
LENGTH = 4.0
WIDTH = 2.0


def rollout(other, kind=VEHICLE):
    """One rollout of an ego at 10 m/s along x, and another at states [T+1, 4] beside
    it."""
    time = torch.arange(STEPS + 1) * 0.1
    zero = torch.zeros_like(time)
    ego = torch.stack([10 * time, zero, zero, zero + 10], -1)
    states = torch.stack([ego, other], 1)[None]
    valid = torch.ones(1, STEPS + 1, 2, dtype=torch.bool)
    agent_type = torch.full((1, 2), VEHICLE)
    agent_type[0, 1] = kind
    empty = torch.zeros(1, 0)
    return Rollouts(
        states=states,
        valid=valid,
        size=torch.tensor([LENGTH, WIDTH]).expand(1, 2, 2).clone(),
        agent_type=agent_type,
        simulated=torch.ones(1, 2, dtype=torch.bool),
        adversaries=torch.zeros(1, 2, dtype=torch.bool),
        logged=states,
        logged_valid=valid,
        lane_points=torch.zeros(1, 0, 2),
        lane_index=empty.long(),
        lane_width=empty,
        drivable_points=torch.zeros(1, 0, 2),
        drivable_index=empty.long(),
        seed=torch.zeros(1, dtype=torch.int64),
        eta=torch.zeros(1, dtype=torch.float64),
        scene_id=["scene"],
        location=[""],
        batch_size=[1],
    )


def moving(x, y, speed):
    """States [T+1, 4] from (x, y) on, along x."""
    time = torch.arange(STEPS + 1) * 0.1
    zero = torch.zeros_like(time)
    return torch.stack([x + speed * time, y + zero, zero, speed + zero], -1)


@pytest.mark.parametrize("lateral", [3.0, 5.5])
def test_beside_at_equal_speed_it_is_the_gap(lateral):
    assert clearance(rollout(moving(0.0, lateral, 10.0))) == pytest.approx(
        lateral - WIDTH
    )


@pytest.mark.parametrize("closing", [2.0, 3.3, 4.0])
def test_behind_a_slower_one_it_is_the_seconds_to_contact_where_these_are_less(closing):
    gap = 9.0
    ahead = rollout(moving(LENGTH + gap, 0.0, 10.0 - closing))
    left = gap - closing * STEPS * 0.1  # at the end, which is the nearest
    expected = min(left, AHEAD * left / closing)
    assert clearance(ahead) == pytest.approx(expected, rel=1e-4)


def test_who_stands_all_the_time_does_not_count():
    standing = rollout(moving(40.0, 0.0, 0.0))
    assert clearance(standing) > 50


def test_pedestrians_do_not_count():
    walking = rollout(moving(30.0, 1.0, 1.0), kind=PEDESTRIAN)
    assert AGENT_TYPES[PEDESTRIAN] == "pedestrian"
    assert clearance(walking) > 50


def test_who_is_replayed_does_not_count():
    replayed = rollout(moving(0.0, 3.0, 10.0))
    replayed.simulated[:, 1] = False
    assert clearance(replayed) > 50


def test_what_was_near_before_the_noise_acts_does_not_count():
    far = moving(0.0, 50.0, 10.0)
    near = far.clone()
    near[:4, 1] = 3.0
    torch.testing.assert_close(clearance(rollout(near)), clearance(rollout(far)))


def contact(**row):
    return {"cfr": 1.0, "cfr_preventable": 0.0, "margin": 0.0, "relvel": 5.0} | row


def test_contacts_rank_by_what_the_driver_prevents():
    assert contact_level(contact(cfr_preventable=1.0)) == PREVENTED
    assert contact_level(contact()) == pytest.approx(CONTACT + 0.25)
    assert contact_level(contact(margin=0.6)) > contact_level(contact(margin=0.2))
    assert contact_level(contact(relvel=2.0)) > contact_level(contact(relvel=9.0))
    assert contact_level(contact(margin=1.0, relvel=0.0)) < PREVENTED
    assert contact_level(contact(relvel=math.inf)) == CONTACT


@pytest.mark.parametrize("gap", [6.0, 60.0])
def test_contacts_and_km_are_those_of_the_metrics(gap):
    """The ego reaches a standing vehicle 6 m ahead, and none 60 m ahead."""
    rollouts = rollout(moving(gap, 0.0, 0.0))
    hit, km = contacts(rollouts)
    ((row,), _) = score_rollouts(rollouts)
    assert bool(hit) == (row["cfr"] == 1)
    assert km == [row["driven_km"]]
