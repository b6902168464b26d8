"""Golden rollouts (tests/golden.py): what methods, egos, training and search do is what
they did, bit for bit.

On another processor than golden.json was written on, bits differ and rollouts part:
there most end where they did.
"""

import json

import pytest
import torch

from tests.golden import CASES, FILE, processor

STORED = json.loads(FILE.read_text())
APART = 1.0  # m, in the sum of all places of a scene


def test_every_case_is_stored():
    assert list(STORED["cases"]) == list(CASES)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_nothing_has_changed(name):
    record = CASES[name]()
    stored = STORED["cases"][name]
    if processor() == STORED["processor"]:
        assert record == stored
    elif name == "training":
        assert record["size"] == pytest.approx(stored["size"], rel=0.02)
    elif name == "search":
        hits = [
            torch.tensor(each["hits"]).double().mean().item()
            for each in (record, stored)
        ]
        assert hits[0] == pytest.approx(hits[1], abs=0.25)
    else:
        places = torch.tensor(record["places"]) - torch.tensor(stored["places"])
        assert (places.abs() < APART).sum() >= 5
