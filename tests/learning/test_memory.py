"""The memory of D': bounded, the oldest leave first, mapped from plain arrays, and drawn less than what is fresh."""

import pickle
from pathlib import Path

import pytest
import torch
from safetensors import safe_open

from e2rl.learning.attack import Order, Solved, make_traffic
from e2rl.learning.memory import Memory
from e2rl.run.errors import InputError
from e2rl.traffic.traffic import CHAIN, FULL, PAIR, SINGLE
from tests.learning.small import brake_check, small_run, small_scenes

STATUS = Path("/proc/self/status")


def traffic(number, rows=4, eta=2.0, template=FULL):
    index = torch.arange(rows)
    made = brake_check(small_scenes(rows))(None, index, eta, 0)
    made["states"] = made["states"] + number
    return {**made, "eta": torch.full((rows,), eta), "template": torch.full((rows,), template)}


def filled(folder, bound, rounds=5):
    memory = Memory(folder, bound)
    for number in range(rounds):
        memory.write(number, traffic(number))
        memory.take(number)
    return memory


@pytest.mark.parametrize(("bound", "left"), [(0, [4]), (7, [4]), (8, [3, 4]), (11, [3, 4]), (100, [0, 1, 2, 3, 4])])
def test_the_oldest_rounds_leave_and_the_newest_stays(tmp_path, bound, left):
    memory = filled(tmp_path, bound)
    assert [one.number for one in memory.rounds] == left and memory.rows == 4 * len(left)
    assert len(list(memory.folder.iterdir())) == 5, "a checkpoint may still name them"
    memory.prune(left[0])
    assert sorted(memory.folder.iterdir()) == [memory.path(number) for number in left]
    with pytest.raises(InputError, match=r"learner\.round\.memory"):
        Memory(tmp_path, -1)


def test_the_pool_holds_every_round_the_newest_first_and_heavier(tmp_path):
    pool = filled(tmp_path, 100, rounds=3).pool(3.0)
    assert pool.fresh.tolist() == [True] * 4 + [False] * 8
    probability = pool.probabilities(torch.full((4,), 0.25), 0.7)
    assert probability.tolist() == pytest.approx([3 / 20] * 4 + [1 / 20] * 8)
    states, _ = pool.tracks(pool.source)
    expected = torch.cat([traffic(number)["states"] for number in (2, 1, 0)])
    assert torch.equal(states, expected)


def test_remembered_rows_keep_their_intensity_and_template(tmp_path):
    memory = Memory(tmp_path, 100)
    for number, template in enumerate((SINGLE, CHAIN, PAIR)):
        memory.write(number, traffic(number, eta=1.0 + number, template=template))
        memory.take(number)
    index = memory.index()
    memory.restore(index)
    pool = memory.pool(3.0)
    assert pool.template.tolist() == [PAIR] * 4 + [CHAIN] * 4 + [SINGLE] * 4
    assert pool.eta.tolist() == [3.0] * 4 + [2.0] * 4 + [1.0] * 4


def test_evasions_make_the_round_trip(tmp_path):
    """Through make_traffic, the file and the pool; rows that are left out and nominal ones have none."""
    scenes, index = small_scenes(4), torch.arange(4)
    actions = torch.arange(4 * 20 * 2).reshape(4, 20, 2).float()
    span = torch.tensor([[3, 9], [0, 0], [2, 5], [1, 4]])
    solved = Solved(torch.tensor([True, True, False, True]), actions, span)
    memory = Memory(tmp_path, 100)
    for number in range(2):
        order = Order(number, index, torch.full((4,), 2.0), torch.full((4,), FULL), 0, None)
        memory.write(number, make_traffic(order, brake_check(scenes), lambda traffic: solved))
        memory.take(number)
    memory.restore(memory.index())
    pool = memory.pool(3.0)
    for number, first in ((0, 0), (1, 7)):
        rows, found, acts = pool.evaded(number)
        assert rows.tolist() == [first, first + 2] and pool.scene_index[rows].tolist() == [0, 3]
        assert torch.equal(found, actions[[0, 3]]) and torch.equal(acts, span[[0, 3]])
    assert not pool.parts[0].evasion[3:].any() and len(pool) == 14


def test_files_hold_plain_arrays(tmp_path):
    path = filled(tmp_path, 100, rounds=1).path(0)
    with safe_open(path, "pt") as file:
        assert {"states", "valid", "adversaries", "eta", "template", "scene_index"} <= set(file.keys())
    with path.open("rb") as file, pytest.raises(pickle.UnpicklingError):
        pickle.load(file)
    assert not list(tmp_path.rglob("*.part"))


@pytest.mark.skipif(not STATUS.exists(), reason="reads Linux's account of memory")
def test_only_the_rows_drawn_are_read(tmp_path):
    """Of 64 MiB on disk, some rows make at most some MiB resident."""

    def resident():
        lines = STATUS.read_text().splitlines()
        return sum(int(line.split()[1]) for line in lines if line.startswith(("RssAnon", "RssFile"))) / 1024

    rows = 256
    states = torch.zeros(rows, 64, 256, 4)
    few = {"adversaries": torch.zeros(rows, 256, dtype=torch.bool), "eta": torch.ones(rows)}
    few |= {"template": torch.full((rows,), FULL)}
    given = {"scene_index": torch.arange(rows), "states": states, "valid": torch.ones(rows, 64, 256).bool(), **few}
    memory = Memory(tmp_path, rows)
    memory.write(0, given)
    del given, states
    memory.take(0)
    before = resident()
    pool = memory.pool(3.0)
    pool.tracks(torch.tensor([3, 77]))
    assert resident() - before < 16


def test_rounds_are_remembered_and_reported():
    run = small_run(memory=9, rounds=6, collect={"batch": 16, "iterations": 4})  # enough episodes to meet every row
    reports = [run.run_round() for _ in range(5)]
    assert [report["synthesizer/memory_rows"] for report in reports] == [3.0, 6.0, 9.0, 9.0, 9.0]
    assert reports[0]["synthesizer/fresh_draws"] == 1.0
    assert all(0 < report["synthesizer/fresh_draws"] < 1.0 for report in reports[1:])
