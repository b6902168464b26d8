"""The protocol: paired noise, rows and files of every rollout, and agreement with the
independent scorer."""

import pytest
import torch

from e2rl.driving.setup import Method, Setup, scene_seed
from e2rl.evaluation.modes import read_modes
from e2rl.evaluation.protocol import run_protocol
from e2rl.evaluation.rollout_files import (
    METRICS_FILE,
    MODES_FILE,
    TABLE,
    read_metrics,
    read_rows,
)
from e2rl.planners.idm_planner import IDMEgo
from e2rl.run.parts import Parts
from e2rl.sim.rollout_file import ROLLOUTS, Rollout
from e2rl.sim.settings import SimSettings
from e2rl.traffic.rule_based import ConstantVelocity
from tests.learning.small import Ambush, small_scenes
from tests.traffic.e2.traffic_scenes import scenes, synthesizer

SCENES = 2
SEEDS = [0, 1]


def setup_of(scene_set, batch=64):
    return Setup(scene_set, IDMEgo(), ego_name="idm", sim=SimSettings(), batch=batch)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """(rows, folder) of two methods on two scenes and seeds, in batches that do not
    divide them evenly."""
    folder = tmp_path_factory.mktemp("run")
    on = synthesizer()
    methods = [Method("nominal", on), Method("e2", on, eta=3.0)]
    rows = run_protocol(
        setup_of(scenes(SCENES, steps=10), 3),
        methods,
        seeds=SEEDS,
        folder=folder,
        stage="test",
    )
    return rows, folder


def test_a_row_for_each_method_and_a_line_and_a_file_for_each_rollout(run):
    rows, folder = run
    assert [(row["method"], row["eta"], row["stage"]) for row in rows] == [
        ("nominal", 0, "test"),
        ("e2", 3, "test"),
    ]
    assert all(
        (row["n_scenes"], row["n_seeds"], row["n_rollouts"]) == (2, 2, 4)
        for row in rows
    )
    assert [row["method"] for row in read_metrics(folder / METRICS_FILE)] == [
        "nominal",
        "e2",
    ]
    assert [group["method"] for group in read_modes(folder / MODES_FILE)["groups"]] == [
        "nominal",
        "e2",
    ]
    keys = {
        (line["method"], line["scene_id"], line["seed"])
        for line in read_rows(folder / TABLE)
    }
    files = [Rollout.read(path) for path in (folder / ROLLOUTS).glob("*.npz")]
    assert {(file.method, file.scene_id, file.seed) for file in files} == keys
    assert len(files) == len(keys) == 8
    for file in files:
        assert file.seed in SEEDS
        assert file.ego_policy == "idm"
        assert file.states.shape[0] == 11
        assert file.adversaries.any() == (file.method == "e2")
        assert not file.adversaries[0]


def test_methods_share_the_noise_of_a_scene_and_seed():
    assert scene_seed(3, 1) == scene_seed(3, 1)
    assert len({scene_seed(i, j) for i in range(50) for j in range(5)}) == 250
    methods = [Method("one", synthesizer()), Method("two", synthesizer())]
    twice = run_protocol(setup_of(scenes(SCENES, steps=10)), methods, seeds=[4])
    first, two = (row["metrics"] for row in twice)
    for name in first:
        if not name.startswith("seconds"):
            means = torch.tensor([first[name]["mean"], two[name]["mean"]])
            torch.testing.assert_close(means[0], means[1], equal_nan=True, msg=name)


def test_processes_change_nothing_but_the_time(tmp_path):
    """Two forked processes give the rows, tables and rollouts of one, bit for bit."""
    scene_set = scenes(2, steps=10)
    folders = (tmp_path / "one", tmp_path / "two")
    for processes, folder in enumerate(folders, 1):
        methods = [
            Method("nominal", synthesizer(), eta=0.0),
            Method("e2", synthesizer(), eta=3.0),
        ]
        run_protocol(
            setup_of(scene_set, 2),
            methods,
            seeds=SEEDS,
            folder=folder,
            processes=processes,
        )
    same_runs(*folders)


class Stopped(Setup):
    """A setup whose user presses Ctrl-C after so many batches; `done`: (method, scene,
    seed) that were rolled out."""

    left = 0
    done: list

    def score(self, method, tasks, folder=None, begins=False):
        if self.left == 0:
            raise KeyboardInterrupt
        self.left -= 1
        scored = super().score(method, tasks, folder, begins)
        self.done += [(method.name, task.scene, task.seed) for task in tasks]
        return scored


def stopping_run(folder, stops, scene_set):
    """A run that is interrupted after so many batches each time, and then ends; returns
    what was rolled out."""
    finished = []
    for left in (*stops, 100):
        setup = Stopped(
            scene_set,
            IDMEgo(),
            ego_name="idm",
            sim=SimSettings(),
            batch=2,
            evasions=False,
        )
        setup.left = left
        setup.done = finished
        methods = [
            Method("nominal", ConstantVelocity()),
            Method("ambush", Ambush(), eta=2.0),
        ]
        try:
            run_protocol(
                setup, methods, seeds=SEEDS, folder=folder, parts=Parts(folder)
            )
        except KeyboardInterrupt:
            assert left < 100
            assert not (folder / TABLE).exists(), "no table of half a run"
    return finished


def same_runs(one, other):
    """Whether two folders have the same rows, metrics and rollouts, bit for bit, wall
    times apart."""
    timed = {"seconds_per_rollout", "seconds", "evasion_seconds"}
    tables = [read_rows(folder / TABLE) for folder in (one, other)]
    rows = [
        [{k: str(v) for k, v in row.items() if k not in timed} for row in table]
        for table in tables
    ]
    assert rows[0] == rows[1]
    metrics = [read_metrics(folder / METRICS_FILE) for folder in (one, other)]
    for row, twin in zip(*metrics, strict=True):
        certain = [
            {k: str(v) for k, v in item["metrics"].items() if "seconds" not in k}
            for item in (row, twin)
        ]
        assert certain[0] == certain[1]
    files = [
        {path.name: path.read_bytes() for path in (f / ROLLOUTS).glob("*.npz")}
        for f in (one, other)
    ]
    assert files[0] == files[1]


def test_a_run_that_was_interrupted_equals_one_that_was_not(tmp_path):
    """However often it stops; no rollout is done twice, and none has two rows."""
    scene_set = small_scenes(3, steps=10)
    whole = stopping_run(tmp_path / "whole", (), scene_set=scene_set)
    finished = stopping_run(tmp_path / "parts", (3, 0, 1), scene_set=scene_set)
    assert sorted(finished) == sorted(set(finished)) == sorted(whole)
    same_runs(tmp_path / "whole", tmp_path / "parts")
