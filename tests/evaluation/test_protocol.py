"""The protocol: paired noise, rows and files of every rollout, and agreement with the independent scorer."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from e2rl.ego.idm import IDMEgo
from e2rl.evaluation.files import METRICS_FILE, ROLLOUTS, TABLE, read_metrics, read_rows
from e2rl.evaluation.protocol import Method, Setup, run_protocol, scene_seed
from e2rl.evaluation.rollout_reader import read_rollout
from e2rl.sim.env import SimSettings
from tests.synthesizer.traffic_scenes import scenes, synthesizer

SCORER = Path(__file__).parents[3] / "shared" / "tools" / "score_rollouts.py"
SCENES, SEEDS = 2, [0, 1]


def setup_of(scene_set, batch=64):
    return Setup(scene_set, IDMEgo(), "idm", SimSettings(), batch)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """(rows, folder) of two methods on two scenes and seeds, in batches that do not divide them evenly."""
    folder = tmp_path_factory.mktemp("run")
    on = synthesizer()
    methods = [Method("nominal", on), Method("e2", on, 3.0)]
    rows = run_protocol(setup_of(scenes(SCENES, steps=80), 3), methods, SEEDS, folder, stage="test")
    return rows, folder


def test_a_row_for_each_method_and_a_line_and_a_file_for_each_rollout(run):
    rows, folder = run
    assert [(row["method"], row["eta"]) for row in rows] == [("nominal", 0.0), ("e2", 3.0)]
    assert all(row["stage"] == "test" for row in rows)
    for row in rows:
        assert (row["n_scenes"], row["n_seeds"], row["n_rollouts"]) == (SCENES, len(SEEDS), SCENES * len(SEEDS))
    assert [row["method"] for row in read_metrics(folder / METRICS_FILE)] == ["nominal", "e2"]
    lines = read_rows(folder / TABLE)
    keys = {(line["method"], line["scene_id"], line["seed"]) for line in lines}
    assert len(lines) == len(keys) == 2 * SCENES * len(SEEDS)
    assert len(list((folder / ROLLOUTS).glob("*.npz"))) == len(lines)


def test_files_hold_the_seed_of_the_protocol_and_who_was_controlled(run):
    _, folder = run
    for path in (folder / ROLLOUTS).glob("*.npz"):
        data = read_rollout(path)
        assert data["seed"] in SEEDS and data["ego_policy"] == "idm" and data["dt"] == pytest.approx(0.1)
        assert data["adversaries"].any() == (data["method"] == "e2") and not data["adversaries"][0]
        assert data["states"].shape[0] == 81


def test_the_independent_scorer_agrees(run):
    if not SCORER.exists():
        pytest.skip(f"the independent scorer is not there: {SCORER}")
    pytest.importorskip("shapely")
    folder = run[1]
    done = subprocess.run(
        [sys.executable, SCORER, folder / ROLLOUTS, "--csv", folder / TABLE, "--bootstrap", "20"],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_methods_share_the_noise_of_a_scene_and_seed():
    assert scene_seed(3, 1) == scene_seed(3, 1) and len({scene_seed(i, j) for i in range(50) for j in range(5)}) == 250
    methods = [Method("one", synthesizer()), Method("two", synthesizer())]
    twice = run_protocol(setup_of(scenes(SCENES)), methods, [4])
    one, two = (row["metrics"] for row in twice)
    for name in one:
        if not name.startswith("seconds"):
            means = torch.tensor([one[name]["mean"], two[name]["mean"]])
            torch.testing.assert_close(means[0], means[1], equal_nan=True, msg=name)


def test_scenes_alone_have_the_noise_that_they_have_among_all(tmp_path):
    setup, methods = setup_of(scenes(3, steps=20)), [Method("e2", synthesizer(), 3.0)]
    for name, only in (("all", None), ("one", [2])):
        run_protocol(setup, methods, SEEDS, tmp_path / name, only=only)
    alone = sorted((tmp_path / "one" / ROLLOUTS).iterdir())
    assert len(alone) == len(SEEDS)
    for path in alone:
        one, other = np.load(path), np.load(tmp_path / "all" / ROLLOUTS / path.name)
        np.testing.assert_allclose(one["states"], other["states"], atol=5e-3)


def test_nothing_is_written_without_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rows = run_protocol(setup_of(scenes(1, steps=10)), [Method("nominal", synthesizer())], [0])
    assert len(rows) == 1 and not list(tmp_path.iterdir())


def test_processes_change_nothing_but_the_time(tmp_path):
    """Two forked processes give the rows, tables and rollouts of one, bit for bit."""
    scene_set, folders = scenes(3, steps=20), (tmp_path / "one", tmp_path / "two")
    for processes, folder in enumerate(folders, 1):
        methods = [Method("nominal", synthesizer(), 0.0), Method("e2", synthesizer(), 3.0)]
        run_protocol(setup_of(scene_set, 2), methods, SEEDS, folder, processes=processes)
    one, two = (read_rows(folder / TABLE) for folder in folders)
    timed = {"seconds_per_rollout", "seconds", "evasion_seconds"}
    for row, other in zip(one, two, strict=True):
        assert {k: str(v) for k, v in row.items() if k not in timed} == {
            k: str(v) for k, v in other.items() if k not in timed
        }
    for path in sorted((folders[0] / ROLLOUTS).iterdir()):
        first, second = np.load(path), np.load(folders[1] / ROLLOUTS / path.name)
        assert all(np.array_equal(first[key], second[key]) for key in first.files), path.name
