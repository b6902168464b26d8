"""The four drivers in concrete cut-ins against the verdicts of the public reference study's own program."""

import csv
from pathlib import Path

import pytest
import torch

from e2rl.metrics.drivers import DRIVERS, FRONT, LENGTH, NO_CRASH, SIDE, CutIn, lateral_motion, simulate_cut_ins

ORACLE = Path(__file__).parents[2] / ".." / "shared" / "reference" / "r157_cut_in.csv"
MODELS = {"human": "CC_human_driver", "regulation": "Reg157", "rss": "RSS", "fsm": "FSM"}
CRASHES = {"human": 246, "regulation": 173, "rss": 83, "fsm": 89}
FIELDS = ("ego_kmh", "cut_in_kmh", "gap_m", "lateral_mps")


def oracle(model):
    """The oracle's (cut-ins, crash types) of one model, in its own codes: 1 the ego's front has passed the other's."""
    if not ORACLE.exists():
        pytest.skip(f"the oracle {ORACLE} is not there")
    with open(ORACLE, newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["model"] == model]
    ego, other, gap, lateral = torch.tensor([[float(row[f]) for f in FIELDS] for row in rows], dtype=torch.float64).T
    return CutIn(ego / 3.6, other / 3.6, gap, lateral), torch.tensor([int(row["crash_type"]) for row in rows])


def cut_ins(*values):
    return CutIn(*torch.tensor(values, dtype=torch.float64).T)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("name", MODELS)
def test_verdicts_and_kinds_of_crash_are_the_oracle_s(name, dtype):
    scenarios, expected = oracle(MODELS[name])
    kind = simulate_cut_ins(DRIVERS[name], CutIn(*(field.to(dtype) for field in scenarios)))
    assert len(kind) == 792
    assert (kind != NO_CRASH).sum() == CRASHES[name]
    different = kind != torch.tensor([NO_CRASH, SIDE, FRONT])[expected]
    assert not different.any(), [tuple(field[different].tolist()) for field in scenarios]


def test_more_gap_is_never_worse_for_the_human_driver_unless_it_would_have_passed_before():
    scenarios, _ = oracle(MODELS["human"])
    crash = simulate_cut_ins(DRIVERS["human"], scenarios) != NO_CRASH
    _, lateral_gap, start = lateral_motion(scenarios)
    contact = 0.1 * ((lateral_gap > 0).sum(0) - start)
    passed = (scenarios.speed - scenarios.other_speed) * contact > scenarios.gap + 2 * LENGTH
    assert not crash[passed].any()
    same = torch.stack([scenarios.speed, scenarios.other_speed, scenarios.lateral_speed], -1)
    pair = (same[:, None] == same).all(-1) & (scenarios.gap[:, None] < scenarios.gap) & ~passed[:, None]
    assert pair.any() and not (pair & ~crash[:, None] & crash).any()


def test_the_other_is_beside_the_ego_at_time_zero_and_ends_centred_before_it():
    speed, gap, start = lateral_motion(cut_ins((10, 5, 20, 0.3), (10, 5, 20, 1.8)))
    assert gap[start].tolist() == pytest.approx([1.6, 1.6])
    assert speed[start].tolist() == pytest.approx([0.3, 1.8])
    assert speed[0].tolist() == [0, 0] and (speed.diff(dim=0).abs() <= 1.8 + 1e-9).all()
    assert gap[-1].tolist() == pytest.approx([-1.9, -1.9]) and not speed[-1].any()


def test_a_crash_is_at_the_side_once_the_ego_s_front_has_passed_the_other_s():
    blind = DRIVERS["human"]._replace(time_to_collision=-1.0)
    kind = simulate_cut_ins(blind, cut_ins((10, 0, 5, 1.6), (10, 0, 8, 1.6), (10, 0, 1, 1.6), (10, 10, 1, 1.6)))
    assert kind.tolist() == [SIDE, FRONT, NO_CRASH, NO_CRASH]
