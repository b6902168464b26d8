"""Standing vehicles: parked ones that move, others that start, counted in the rollout and in its log."""

import torch

from e2rl.metrics.proximity import MOVED, moved, standing_columns
from e2rl.metrics.score import score_rollouts
from tests.metrics.random_rollouts import random_rollouts

PARKED_STAYS, PARKED_MOVES, STANDS, STARTS, STARTS_IN_LOG, DRIVES, LATE = range(1, 8)
ROWS = 8


def rollouts():
    """One rollout of eight vehicles, named above; whoever moves goes 5 m in x."""
    states = torch.zeros(1, 11, ROWS, 4, dtype=torch.float64)
    states[..., 0] = 20.0 * torch.arange(ROWS)
    logged = states.clone()
    way = torch.linspace(0, 5, 11)
    for row in (PARKED_MOVES, STARTS, DRIVES, LATE):
        states[0, :, row, 0] += way
    for row in (STARTS_IN_LOG, DRIVES):
        logged[0, :, row, 0] += way
    states[0, :, DRIVES, 3] = logged[0, :, DRIVES, 3] = 5.0
    valid, logged_valid = (torch.ones(1, 11, ROWS, dtype=torch.bool) for _ in range(2))
    logged_valid[0, 8:, LATE] = False  # not recorded throughout
    parked = torch.zeros(1, ROWS, dtype=torch.bool)
    parked[0, [PARKED_STAYS, PARKED_MOVES]] = True
    return {"states": states, "valid": valid, "logged": logged, "logged_valid": logged_valid, "parked": parked}


def traffic():
    return torch.arange(ROWS)[None] > 0


def values(batch, who=None):
    found = standing_columns(batch | {"traffic": traffic() if who is None else who})
    return {name: value[0].item() for name, value in found.items()}


def test_everybody_is_counted_once_and_where_it_belongs():
    assert values(rollouts()) == {"parked_moved": 0.5, "parked_vehicles": 2, "starters": 1, "starters_log": 1}


def test_the_log_as_a_rollout_starts_as_many_as_the_log_and_moves_no_parked_vehicle():
    batch = rollouts()
    found = values(batch | {"states": batch["logged"]})
    assert found["parked_moved"] == 0 and found["starters"] == found["starters_log"] == 1


def test_who_is_no_traffic_is_not_counted():
    who = traffic()
    who[0, [PARKED_MOVES, STARTS]] = False
    assert values(rollouts(), who) == {"parked_moved": 0, "parked_vehicles": 1, "starters": 0, "starters_log": 1}


def test_it_does_not_depend_on_place_or_order():
    batch = rollouts()
    turn, order = torch.tensor([[0.6, 0.8], [-0.8, 0.6]], dtype=torch.float64), torch.randperm(ROWS)
    other = {name: value[..., order, :] if value.dim() == 4 else value[..., order] for name, value in batch.items()}
    for key in ("states", "logged"):
        other[key] = torch.cat([other[key][..., :2] @ turn + 50.0, other[key][..., 2:]], -1)
    assert values(other, traffic()[:, order]) == values(batch)


def test_moved_means_farther_than_the_limit_at_a_step_where_it_is_there():
    states = torch.zeros(1, 3, 4, 4)
    valid = torch.ones(1, 3, 4, dtype=torch.bool)
    states[0, 1, 0, 1] = MOVED + 0.01  # and back
    states[0, 2, 1, 0] = MOVED
    states[0, 2, 2, 0], valid[0, 2, 2] = 9.0, False
    assert moved(states, valid)[0].tolist() == [True, False, False, False]


def test_without_parked_vehicles_the_share_is_unknown_and_without_the_key_everything_is():
    batch = rollouts()
    none = values(batch | {"parked": torch.zeros_like(batch["parked"])})
    assert none["parked_moved"] != none["parked_moved"] and none["parked_vehicles"] == 0
    row = score_rollouts(random_rollouts(1))[0][0]  # its dict has no `parked`
    assert all(row[name] != row[name] for name in none)
