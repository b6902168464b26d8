"""Runs are compared by all that they write, but for wall times."""

import json

import pytest
import torch

from e2rl.run.files import weight_bytes
from e2rl.run.parts import state_bytes
from tools import kills

FILES = {
    "metrics.json": json.dumps([{"metrics": {"cfr": {"mean": 0.5}, "seconds_per_rollout": {"mean": 1.0}}}]),
    "rollouts.csv": "scene_id,cfr,seconds\na,1,0.5\n",
    "tables.md": "| | nominal |\n| --- | ---: |\n| cfr | 1 |\n| seconds_per_rollout [s] | 0.5 |\n",
    "methods.tex": "method & cfr & seconds\\_per\\_rollout [s] & passes\n\\midrule\ne2 & 1 & 0.5 & 12\n\nx & 3\n",
    "logs/scalars/train/loss.csv": "0,0.5\n",
    "rollouts/a.npz": "bytes",
}


def run_of(folder, **changes):
    for name, text in (FILES | changes).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def test_wall_times_and_what_a_run_keeps_for_itself_are_no_difference(tmp_path):
    one = run_of(
        tmp_path / "one", **{"parts/a.pt": "1", ".hydra/config.yaml": "1", "logs/scalars/time/improve.csv": "0,1"}
    )
    times = {name: text.replace("0.5\n", "0.7\n").replace("0.5 |", "0.7 |") for name, text in FILES.items()}
    times["methods.tex"] = times["methods.tex"].replace("0.5 &", "0.7 &")
    times |= {"metrics.json": FILES["metrics.json"].replace("1.0", "2.0")} | {"logs/scalars/train/loss.csv": "0,0.5\n"}
    assert kills.differences(one, run_of(tmp_path / "other", **times)) == []


CHANGED = {
    "metrics.json": ("0.5", "0.6"),
    "rollouts.csv": ("a,1", "a,2"),
    "tables.md": ("| cfr | 1", "| cfr | 2"),
    "methods.tex": ("& 12", "& 13"),
    "logs/scalars/train/loss.csv": ("0.5", "0.6"),
    "rollouts/a.npz": ("bytes", "other"),
}


@pytest.mark.parametrize("name", FILES)
def test_everything_else_is_one(tmp_path, name):
    one, other = run_of(tmp_path / "one"), run_of(tmp_path / "other")
    (other / name).write_text(FILES[name].replace(*CHANGED[name]))
    assert kills.differences(one, other) == [name]
    (other / name).unlink()
    assert kills.differences(one, other) == [name]


def test_states_with_and_without_a_hash_are_read(tmp_path):
    """A prior's training.pt has one before its content, a checkpoint's state.pt has it in a file beside."""
    one, other, third = (tmp_path / name for name in ("one", "other", "third"))
    for folder, value in ((one, 1.0), (other, 1.0), (third, 2.0)):
        (folder / "checkpoints").mkdir(parents=True)
        (folder / "training.pt").write_bytes(state_bytes({"a": torch.tensor(value), "seconds": id(folder)}))
        torch.save({"a": torch.tensor(value)}, folder / "checkpoints" / "state.pt")
    assert kills.differences(one, other) == []
    assert kills.differences(one, third) == ["checkpoints/state.pt", "training.pt"]


def test_weights_are_compared_by_tensors_and_header_without_wall_times(tmp_path):
    """Their hash is of the header, too, and so of the times in it."""
    for name, value, seconds, step in (
        ("one", 1.0, 5, 60),
        ("timed", 1.0, 6, 60),
        ("other", 2.0, 5, 60),
        ("late", 1.0, 5, 61),
    ):
        header = {"origin": json.dumps({"seconds": {"total": seconds}, "step": step})}
        (tmp_path / name).mkdir()
        (tmp_path / name / "prior.safetensors").write_bytes(weight_bytes({"a": torch.tensor([value])}, header))
    assert kills.differences(tmp_path / "one", tmp_path / "timed") == []
    assert kills.differences(tmp_path / "one", tmp_path / "other") == ["prior.safetensors"]
    assert kills.differences(tmp_path / "one", tmp_path / "late") == ["prior.safetensors"]
