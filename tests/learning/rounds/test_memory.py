"""The memory of D': bounded, the oldest leave first, mapped from plain arrays, and
joined as one pool."""

import pytest
import torch

from e2rl.learning.rounds.memory import Memory
from tests.learning.small import brake_check, small_scenes


def traffic(number, rows=4, eta=2.0):
    index = torch.arange(rows)
    built = brake_check(small_scenes(rows))(None, index, eta, 0)
    built["states"] = built["states"] + number
    return {**built, "eta": torch.full((rows,), eta)}


def filled(folder, bound, rounds=5):
    memory = Memory(folder, bound)
    for number in range(rounds):
        memory.write(number, traffic(number))
        memory.take(number)
    return memory


@pytest.mark.parametrize(
    ("bound", "left"),
    [(0, [4]), (7, [4]), (8, [3, 4]), (11, [3, 4]), (100, [0, 1, 2, 3, 4])],
)
def test_the_oldest_rounds_leave_and_the_newest_stays(tmp_path, bound, left):
    memory = filled(tmp_path, bound)
    assert [single.number for single in memory.rounds] == left
    assert memory.rows == 4 * len(left)
    assert len(list(memory.folder.iterdir())) == 5, "a checkpoint may still name them"
    memory.prune(left[0])
    assert sorted(memory.folder.iterdir()) == [memory.path(number) for number in left]


def test_the_pool_holds_every_round_the_newest_first(tmp_path):
    pool = filled(tmp_path, 100, rounds=3).pool()
    states, _ = pool.tracks(pool.source)
    expected = torch.cat([traffic(number)["states"] for number in (2, 1, 0)])
    assert torch.equal(states, expected)
    assert pool.eta.tolist() == [2.0] * 12
