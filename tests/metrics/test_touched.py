"""The share of moving vehicles that another one touches."""

import torch

from e2rl.metrics.contact import touched_columns


def columns(speeds, touched, logged=None, valid=None):
    """touched and moving_vehicles of one rollout of vehicles at speeds [N] throughout; the ego is no traffic."""
    speed = torch.tensor(speeds, dtype=torch.float64)
    count = len(speeds)
    track = torch.zeros(1, 5, count, 4, dtype=torch.float64)
    log = track.clone()
    track[..., 3], log[..., 3] = speed, speed if logged is None else torch.tensor(logged, dtype=torch.float64)
    there = torch.ones(1, 5, count, dtype=torch.bool)
    known = there if valid is None else there & torch.tensor(valid)
    batch = {"states": track, "valid": known, "logged": log, "logged_valid": known}
    batch["traffic"] = torch.arange(count)[None] > 0
    found = touched_columns(batch, torch.tensor([touched]))
    return found["touched"].item(), found["moving_vehicles"].item()


def test_it_is_a_share_of_those_that_move():
    assert columns([9, 5, 5, 5, 0], [False, True, True, False, True]) == (2 / 3, 3)
    assert columns([9, 5, 5], [True, False, False]) == (0, 2), "the ego is no traffic"


def test_whoever_moves_in_the_log_alone_counts_but_not_while_absent():
    assert columns([9, 0, 5], [False, True, False], logged=[9, 5, 5]) == (0.5, 2)
    assert columns([9, 5, 5], [False, True, False], valid=[True, False, True]) == (0, 1)


def test_nobody_moving_is_unknown():
    share, number = columns([9, 0, 0.4], [False, True, True])
    assert share != share and number == 0
