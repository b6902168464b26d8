"""Golden rollouts (tests/golden.py): what methods, egos, training and search do is what
they did, bit for bit, and whoever drives moves as fast as it says.

On another processor than golden.json was written on, bits differ and rollouts part:
there most end where they did.
"""

import json

import pytest
import torch

from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import wrap
from tests.golden import CASES, FILE, processor, rollouts_of

STORED = json.loads(FILE.read_text())
SLACK = 0.03  # m a step: who stands is held where it is, whatever it says below 0.5 m/s
APART = 1.0  # m, in the sum of all places of a scene


def test_every_case_is_stored():
    assert list(STORED["cases"]) == list(CASES)


def deviations(rollouts):
    """Distance [n] m by which steps of vehicles differ from the mean speed along the
    mean heading, but of those on their recording, which begins at an estimate of it."""
    states = rollouts.states.double()
    logged = rollouts.logged.double()
    both = rollouts.valid[:, 1:] & rollouts.valid[:, :-1] & rollouts.simulated[:, None]
    both[..., 0] = False
    replays = (states - logged)[..., :2].norm(dim=-1) < 1e-3
    replays[:, 0] = True
    both &= ~(replays[:, 1:] & replays[:, :-1])
    turn = wrap(states[:, 1:, :, 2] - states[:, :-1, :, 2])
    heading = states[:, :-1, :, 2] + turn / 2
    speed = (states[:, 1:, :, 3] + states[:, :-1, :, 3]) / 2
    expected = DT * speed[..., None] * torch.stack([heading.cos(), heading.sin()], -1)
    return (states[..., :2].diff(dim=1) - expected).norm(dim=-1)[both]


# the longest first
@pytest.mark.slow
@pytest.mark.parametrize("name", list(reversed(CASES)))
def test_nothing_has_changed_and_vehicles_move_as_fast_as_they_say(name):
    """Both of the same rollouts: another process would drive them again."""
    record = CASES[name]()
    method, _, ego = name.partition(", ")
    if ego == "lane_graph" and method != "replay":
        distances = deviations(rollouts_of(method, ego))
        assert len(distances) > 100
        assert distances.max() < SLACK
    stored = STORED["cases"][name]
    if processor() == STORED["processor"]:
        assert record == stored
    elif name == "training":
        assert record["size"] == pytest.approx(stored["size"], rel=0.02)
    elif name == "search":
        hits = [
            torch.tensor(case["hits"]).double().mean().item()
            for case in (record, stored)
        ]
        assert hits[0] == pytest.approx(hits[1], abs=0.25)
    else:
        places = torch.tensor(record["places"]) - torch.tensor(stored["places"])
        assert (places.abs() < APART).sum() >= 5
