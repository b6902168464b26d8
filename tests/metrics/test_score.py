"""The rows agree with the independent scorer; the batch and the world's place,
direction and hand do not matter."""

import csv
import json
import math
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from e2rl.evaluation.rollout_files import write_rows
from e2rl.metrics.score import score_rollouts
from e2rl.metrics.statistics import summarise
from e2rl.sim.rollouts import Rollouts
from tests.metrics.random_rollouts import random_rollouts

SCORER = Path(__file__).resolve().parents[3] / "shared" / "tools" / "score_rollouts.py"


def test_rows_and_summary_agree_with_the_independent_scorer(tmp_path):
    if not SCORER.is_file():
        pytest.skip(
            f"needs the independent scorer at {SCORER.parent.name}/{SCORER.name} "
            "beside the repository"
        )
    pytest.importorskip(
        "pandas", reason="the independent scorer reads tables with pandas"
    )
    rollouts = random_rollouts(48, seed=3)
    rows, features = score_rollouts(rollouts)
    assert sum(row["cfr"] == 1 for row in rows) >= 12, (
        "the generator must produce contacts"
    )
    rollouts.to_npz(tmp_path / "rollouts")
    write_rows(tmp_path / "rollouts.csv", rows)
    tight = (
        "relvel=1e-5",
        "min_dtc=1e-5",
        "ttc_c=1e-6",
        "aor_step=1e-9",
        "macc=1e-6",
        "contact_time=1e-9",
    )
    into = ["--json", tmp_path / "theirs.json", "--out", tmp_path / "theirs.csv"]
    command = [
        sys.executable,
        SCORER,
        tmp_path / "rollouts",
        *into,
        "--tolerance",
        *tight,
    ]
    process = subprocess.run(command, capture_output=True, text=True)
    assert process.returncode == 0, process.stdout + process.stderr
    theirs = json.loads((tmp_path / "theirs.json").read_text())
    agreement = theirs["agreement"]
    assert agreement["joined"] == len(rows)
    assert not agreement["missing"]
    assert not any(part["disagree"] for part in agreement["metrics"].values())
    compare_columns(rows, tmp_path / "theirs.csv")
    compare_summary(summarise(rows, features), theirs["groups"][0]["metrics"])


def compare_columns(rows, table):
    """Columns that the scorer writes but does not compare by itself."""
    with table.open(newline="") as file:
        theirs = {
            (row["scene_id"], int(row["seed"])): row for row in csv.DictReader(file)
        }
    names = (
        "bg_pairs",
        "front",
        "side",
        "rear",
        "progress",
        "ttc_c_all",
        "aor_left_out",
    )
    names += (
        "aor_vehicle_steps",
        "start_overlap_ego",
        "start_overlap_bg",
        "contact_step",
        "partner",
    )
    for row in rows:
        other = theirs[row["scene_id"], row["seed"]]
        for name in names:
            expected = float(other[name] or "nan")
            assert row[name] == pytest.approx(expected, abs=1e-4, nan_ok=True), (
                row["scene_id"],
                name,
            )
        assert max(row["cfr_vru"], row["cfr_object"]) == float(
            other["cfr_vru"]
        )  # it takes objects for pedestrians


def compare_summary(ours, theirs):
    names = (
        "cfr",
        "cfr_bg",
        "side",
        "relvel",
        "progress",
        "aor_any",
        "real_norm",
        "w1_a_lon",
        "w1_a_lat",
        "w1_jerk",
    )
    for name, other in (
        *zip(names, names, strict=True),
        ("aor_step", "aor_pooled"),
        ("real", "real_sub"),
    ):
        assert ours[name]["mean"] == pytest.approx(theirs[other]["mean"], abs=1e-6), (
            name
        )
        if name in ("cfr", "cfr_bg", "side", "aor_any"):
            continue  # at few places with, or without, an event: exact intervals here, a bootstrap there
        width = theirs[other]["high"] - theirs[other]["low"]
        for end in (
            "low",
            "high",
        ):  # two bootstraps of a hundred clusters and more: the same to their own noise
            assert ours[name][end] == pytest.approx(
                theirs[other][end], abs=0.2 * width + 1e-9
            ), (name, end)
        assert ours[name]["n"] == theirs[other]["n"], name


def test_scores_survive_the_files(tmp_path):
    rollouts = random_rollouts(6, seed=8)
    read = Rollouts.from_npz(rollouts.to_npz(tmp_path))
    for row, other in zip(
        score_rollouts(rollouts)[0], score_rollouts(read)[0], strict=True
    ):
        for name in row.keys() - {"seconds", "nfe"}:
            assert row[name] == other[name] or (
                math.isnan(row[name]) and math.isnan(other[name])
            ), name


def test_rows_do_not_depend_on_the_batch_they_are_scored_in():
    rollouts = random_rollouts(5, seed=2)
    together, _ = score_rollouts(rollouts)
    for index in range(5):
        assert str(score_rollouts(rollouts[index : index + 1])[0][0]) == str(
            together[index]
        )


def changed(rollouts, matrix, shift, heading):
    """The rollouts with all positions mapped by a matrix and shifted [m], and all
    headings by a function."""
    result, (matrix, shift) = (
        {},
        (torch.tensor(inputs, dtype=torch.float64) for inputs in (matrix, shift)),
    )
    for name in ("lane_points", "drivable_points"):
        result[name] = rollouts.get(name).double() @ matrix.T + shift
    for name in ("states", "logged"):
        track = rollouts.get(name).double()
        xy = track[..., :2] @ matrix.T + shift
        result[name] = torch.cat([xy, heading(track[..., 2:3]), track[..., 3:]], -1)
    return rollouts.replace(**result)


def mirrored(text):
    return text.replace("left", "\0").replace("right", "left").replace("\0", "right")


TURN = [[math.cos(1.1), -math.sin(1.1)], [math.sin(1.1), math.cos(1.1)]]
WORLDS = {
    "moved and turned": (
        (TURN, [300.0, -80.0], lambda heading: heading + 1.1),
        lambda text: text,
    ),
    "mirrored": (
        ([[1.0, 0.0], [0.0, -1.0]], [0.0, 0.0], lambda heading: -heading),
        mirrored,
    ),
}


@pytest.mark.parametrize("world", WORLDS)
def test_the_world_s_place_direction_and_hand_do_not_matter(world):
    """Mirrored, left and right are the other way round, and so who gives way to whom."""
    rollouts, (change, word) = (
        random_rollouts(24, seed=5, vehicles=24, others=2, extent=30.0),
        WORLDS[world],
    )
    before = score_rollouts(rollouts)[0]
    after = score_rollouts(changed(rollouts, *change))[0]
    assert len({row["approach"] for row in before}) > 4
    assert len({row["preventable"] for row in before}) > 2
    for row, other in zip(before, after, strict=True):
        row = {
            name: word(value) if isinstance(value, str) else value
            for name, value in row.items()
        }
        if world == "mirrored":
            row |= {"duty": other["duty"]}
        assert other == pytest.approx(row, abs=1e-6, nan_ok=True)


def test_transport_is_the_control_s_energy_and_unknown_without_control():
    rollouts = random_rollouts(3)
    assert all(math.isnan(row["transport"]) for row in score_rollouts(rollouts)[0])
    rollouts.transport_adversary = torch.tensor([1.0, 2, 3])
    rollouts.transport_others = torch.tensor([0.5, 0, 1])
    rollouts.transport_anchor = torch.zeros(3)
    assert [row["transport"] for row in score_rollouts(rollouts)[0]] == [1.5, 2.0, 4.0]
