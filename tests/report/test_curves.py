"""Curves of failures over realism: which points are on them, from either kind of run,
and files that hold them all."""

import csv
import json
import math

import pytest
from PIL import Image

from e2rl.evaluation.rollout_files import write_json
from e2rl.report.curves import main, points_of_tuning

MEASURED = {"aor_step": 0.001, "cfr_bg": 0.02, "real": 0.9, "nfe": 640.0}


def trial(gain, step, cfr, realism=0.8):
    metrics = {
        "cfr": cfr,
        "cfr_low": cfr - 0.1,
        "cfr_high": cfr + 0.1,
        "real_adv": realism,
    }
    metrics |= {
        "cfr_counted": cfr / 2,
        "cfr_counted_low": math.nan,
        "cfr_counted_high": math.nan,
    }
    return {
        "parameters": {"gain": gain, "step_size": step},
        "metrics": metrics,
        "admissible": True,
    }


def tuning(best=None):
    """Trials at gains 0.5 (as it is), 2.0 and 0.1, and one with another step size, in
    12 rollouts' nominal traffic."""
    trials = [
        trial(0.5, 0.3, cfr=0.3),
        trial(2.0, 0.3, cfr=0.5),
        trial(0.1, 0.3, cfr=0.1, realism=math.nan),
        trial(1.0, 0.7, cfr=0.4),
    ]
    for each in trials:
        each["metrics"] |= MEASURED | {
            "cfr nominal": 0.05,
            "real nominal": 0.93,
            "real_adv nominal": math.nan,
        }
    return {"best": best and trials[best]["parameters"], "trials": trials}


def row(method, eta, cfr):
    metrics = {
        "cfr": cfr,
        "cfr_counted": cfr / 2,
        "real": 0.9 - cfr / 10,
        "aor_step": 0.001,
        "nfe": 144.0,
    }
    about = {
        "dataset": "d",
        "split": "s",
        "ego": "idm",
        "n_scenes": 12,
        "n_seeds": 1,
        "n_rollouts": 12,
        "paired": {},
    }
    about |= {"git": "", "command": ""}
    known = {name: interval(value) for name, value in metrics.items()}
    return {**about, "method": method, "eta": eta, "metrics": known}


def interval(value):
    return {"mean": value, "low": value - 0.01, "high": value + 0.01, "n": 12}


ROWS = [
    row("nominal", 0.0, cfr=0.05),
    row("cat", 4.0, cfr=0.2),
    row("cat", 1.0, cfr=0.1),
    row("e2", 2.0, cfr=0.4),
]


@pytest.mark.parametrize(
    ("best", "expected"), [(None, []), (1, [(2.0, True)]), (3, [(1.0, False)])]
)
def test_a_tuning_s_points_are_its_ladder_and_its_best_trial(best, expected):
    """A best trial that differs from the sweep in more than the gain is a dot beside
    the curve."""
    *points, nominal = points_of_tuning(tuning(best), "ctg_adv")
    assert sorted(point.value for point in points if point.on_curve) == [0.1, 0.5, 2.0]
    assert [
        (point.value, point.on_curve) for point in points if point.chosen
    ] == expected
    assert (
        nominal.method,
        nominal.metrics["cfr"]["mean"],
        nominal.metrics["real"]["mean"],
    ) == ("nominal", 0.05, 0.93)
    (least,) = (point for point in points if point.value == 0.1)
    assert least.metrics["cfr"] == {
        "mean": 0.1,
        "low": 0.0,
        "high": 0.2,
    } and math.isnan(least.metrics["real"]["low"])


def folders(tmp_path):
    """A run of several intensities, and a tuning."""
    write_json(tmp_path / "run" / "metrics.json", ROWS)
    found = tuning(1)
    for each in found["trials"]:
        each["metrics"] = {
            name: None if math.isnan(value) else value
            for name, value in each["metrics"].items()
        }
    (tmp_path / "tuned").mkdir()
    (tmp_path / "tuned" / "tuning.json").write_text(json.dumps(found))
    known = {
        "command": "",
        "cwd": "",
        "choices": {},
        "files": {},
        "inputs": {},
        "versions": [{"git": "0"}],
    }
    known |= {"settings": {"synthesizer": {"name": "ctg_adv"}}}
    (tmp_path / "tuned" / "provenance.json").write_text(json.dumps(known))
    return [tmp_path / "run", tmp_path / "tuned"]


def test_runs_of_both_kinds_are_drawn_together(tmp_path, capsys):
    main([*map(str, folders(tmp_path)), "--out", str(tmp_path / "out")])
    assert "curves.png" in capsys.readouterr().out
    with (tmp_path / "out" / "curves.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    found = [
        " ".join(line[name] for name in ("method", "value", "chosen")) for line in rows
    ]
    ours = ["nominal 0.0 1", "cat 1.0 0", "cat 4.0 0", "e2 2.0 1"]
    assert found == [*ours, "ctg_adv 0.1 0", "ctg_adv 0.5 0", "ctg_adv 2.0 1"]
    assert (
        float(rows[1]["cfr_high"]) == pytest.approx(0.11)
        and rows[1]["real_adv"] == "" == rows[4]["real_adv"]
    )
    with Image.open(tmp_path / "out" / "curves.png") as picture:
        assert picture.width > picture.height > 1000
