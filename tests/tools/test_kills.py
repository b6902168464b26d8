"""Runs are compared by all that they write, but for wall times."""

import json

import pytest
import torch

from e2rl.run.parts import state_bytes
from e2rl.run.weights import weight_bytes
from tools import kills

FILES = {
    "metrics.json": json.dumps(
        [{"metrics": {"cfr": {"mean": 0.5}, "seconds_per_rollout": {"mean": 1.0}}}]
    ),
    "rollouts.csv": "scene_id,cfr,seconds\na,1,0.5\n",
    "logs/scalars/train/loss.csv": "0,0.5\n",
    "rollouts/a.npz": "bytes",
}
CHANGED = {
    "metrics.json": ("0.5", "0.6"),
    "rollouts.csv": ("a,1", "a,2"),
    "rollouts/a.npz": ("bytes", "other"),
}
CHANGED |= {"logs/scalars/train/loss.csv": ("0.5", "0.6")}


def run_of(folder, **changes):
    for name, text in (FILES | changes).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def test_wall_times_and_what_a_run_keeps_for_itself_are_no_difference(tmp_path):
    single = run_of(
        tmp_path / "one",
        **{"parts/a.pt": "1", "logs/scalars/time/improve.csv": "0,1", "tables.md": "1"},
    )
    times = {
        "metrics.json": FILES["metrics.json"].replace("1.0", "2.0"),
        "rollouts.csv": "scene_id,cfr,seconds\na,1,7\n",
    }
    assert kills.differences(single, run_of(tmp_path / "other", **times)) == []


@pytest.mark.parametrize("name", FILES)
def test_everything_else_is_one(tmp_path, name):
    first = run_of(tmp_path / "one")
    other = run_of(tmp_path / "other")
    (other / name).write_text(FILES[name].replace(*CHANGED[name]))
    assert kills.differences(first, other) == [name]
    (other / name).unlink()
    assert kills.differences(first, other) == [name]


def test_states_and_weights_are_compared_by_their_tensors(tmp_path):
    for folder, value in (("one", 1.0), ("other", 1.0), ("third", 2.0)):
        path = tmp_path / folder
        about = {"origin": json.dumps({"seconds": len(folder)})}
        path.mkdir()
        (path / "training.pt").write_bytes(
            state_bytes({"a": torch.tensor(value), "seconds": len(folder)})
        )
        torch.save({"a": torch.tensor(value)}, path / "state.pt")
        (path / "prior.safetensors").write_bytes(
            weight_bytes({"a": torch.tensor([value])}, about)
        )
    assert kills.differences(tmp_path / "one", tmp_path / "other") == []
    everything = ["prior.safetensors", "state.pt", "training.pt"]
    assert kills.differences(tmp_path / "one", tmp_path / "third") == everything
