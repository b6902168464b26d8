"""A planner that raises or returns NaN loses its own rollouts, and these are counted; all others are scored."""

import json

import pytest
import torch

from e2rl.ego.idm import IDMEgo
from e2rl.errors import InputError
from e2rl.evaluation.ended import ENDED_FILE, NOT_FINITE, attempt
from e2rl.evaluation.files import METRICS_FILE, ROLLOUTS, TABLE, read_metrics, read_rows
from e2rl.evaluation.protocol import Method, Setup, run_protocol
from e2rl.report.score import main as score
from e2rl.report.tables import metric_tables
from e2rl.sim.env import SimSettings
from e2rl.traffic.replay import Replay
from tests.synthesizer.traffic_scenes import scenes

METHODS = [Method("replay", Replay())]


class Fails(IDMEgo):
    """Raises, or plans NaN, where the ego of a scene starts at the given speed."""

    def __init__(self, speed: float, raises: bool) -> None:
        super().__init__()
        self.speed, self.raises = speed, raises

    def plan(self, world):
        plan, bad = super().plan(world), (world.scene["start"][:, 0, 3] - self.speed).abs() < 1e-6
        if self.raises and bad.any():
            raise ZeroDivisionError("no way out")
        plan[bad] = torch.nan
        return plan


def scene_set(count: int = 4):
    found = scenes(count, steps=20)
    found.scenes["start"][:, 0, 3] = 6.0 + torch.arange(count)
    return found


def run(ego, folder=None, batch=64, processes=1, count=4):
    setup = Setup(scene_set(count), ego, "fails", SimSettings(), batch)
    return run_protocol(setup, METHODS, [0, 1], folder, processes=processes)


@pytest.mark.parametrize("processes", [1, 2])
@pytest.mark.parametrize(("raises", "reason"), [(True, "raised ZeroDivisionError"), (False, "raised NotFinite")])
def test_the_others_are_scored_and_the_count_stands_everywhere(tmp_path, raises, reason, processes):
    (row,) = run(Fails(8.0, raises), tmp_path, 4, processes)
    assert row["n_rollouts"] == 6 and row["ended"] == {reason: 2} and row["n_scenes"] == 3
    assert read_metrics(tmp_path / METRICS_FILE)[0]["ended"] == {reason: 2}
    assert f"2 without a score ({reason})" in metric_tables([row])[0].caption
    entries = json.loads((tmp_path / ENDED_FILE).read_text())
    assert {(entry["scene_id"], entry["seed"]) for entry in entries} == {(scene_set().scene_id[2], k) for k in (0, 1)}
    assert all(("no way out" if raises else "the ego's plan is NaN") in entry["traceback"] for entry in entries)
    assert len(read_rows(tmp_path / TABLE)) == 6 == len(list((tmp_path / ROLLOUTS).glob("*.npz")))
    (whole,) = run(IDMEgo(), tmp_path, 4, processes)
    assert whole["ended"] == {} and whole["n_rollouts"] == 8 and not (tmp_path / ENDED_FILE).exists()


def test_states_that_are_not_finite_count_as_ended():
    def roll_out(tasks):
        states = torch.zeros(len(tasks), 2, 3, 4)
        states[:, :, 2] = torch.nan  # of an agent that is not there
        states[1, 1, 0, 3] = torch.inf
        valid = torch.tensor([True, True, False]).expand(len(tasks), 2, 3)
        return {"states": states, "valid": valid, "scene_id": [f"s{task}" for task in tasks], "eta": 2.0}

    ((kept, rollouts),), ended = attempt(roll_out, [4, 5, 6])
    assert kept == [4, 6] and rollouts["scene_id"] == ["s4", "s6"] and len(rollouts["states"]) == 2
    assert rollouts["eta"] == 2.0 and [(task, why["reason"]) for task, why in ended] == [(5, NOT_FINITE)]


def test_where_all_end_the_message_says_why(tmp_path):
    with pytest.raises(
        InputError, match="no rollout could be scored: 2 raised ZeroDivisionError .no way out.*tracebacks"
    ):
        run(Fails(6.0, True), tmp_path, count=1)
    assert len(json.loads((tmp_path / ENDED_FILE).read_text())) == 2


@pytest.mark.parametrize("error", [InputError("bad"), OSError(28, "No space left on device"), MemoryError()])
def test_errors_of_the_whole_run_end_it(error):
    def roll_out(tasks):
        raise error

    with pytest.raises(type(error)):
        attempt(roll_out, [1, 2])


def test_a_batch_is_halved_until_the_one_that_raises_is_alone():
    asked = []

    def roll_out(tasks):
        asked.append(list(tasks))
        if 5 in tasks:
            raise KeyError(5)
        return {"states": torch.zeros(len(tasks), 1, 1, 4), "valid": torch.ones(len(tasks), 1, 1, dtype=torch.bool)}

    done, ended = attempt(roll_out, list(range(8)))
    assert [task for tasks, _ in done for task in tasks] == [0, 1, 2, 3, 4, 6, 7]
    assert [(task, why["reason"]) for task, why in ended] == [(5, "raised KeyError")] and len(asked) == 7


def test_rollouts_on_disk_are_scored_by_a_command(tmp_path, capsys):
    (first,) = run(IDMEgo(), tmp_path)
    rows = read_rows(tmp_path / TABLE)
    assert score([str(tmp_path)]) == 2 and "is there already" in capsys.readouterr().err
    for name in (TABLE, METRICS_FILE):
        (tmp_path / name).unlink()
    assert score([str(tmp_path)]) == 0
    found = {(row["scene_id"], row["seed"]): row for row in read_rows(tmp_path / TABLE)}
    assert len(found) == len(rows)
    for row in rows:
        again = found[row["scene_id"], row["seed"]]
        assert all(again[name] == pytest.approx(row[name], nan_ok=True) for name in ("cfr", "progress", "eta"))
    assert read_metrics(tmp_path / METRICS_FILE)[0]["metrics"]["cfr"] == pytest.approx(
        first["metrics"]["cfr"], nan_ok=True
    )
    path = sorted((tmp_path / ROLLOUTS).glob("*.npz"))[0]
    path.write_bytes(path.read_bytes()[:100])
    (tmp_path / TABLE).unlink()
    assert score([str(tmp_path)]) == 0 and f"left out {path.name}" in capsys.readouterr().err
    assert len(read_rows(tmp_path / TABLE)) == 7
    assert score([str(tmp_path / "none")]) == 2
