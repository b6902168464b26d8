"""The memory of D': bounded, the oldest leave first, mapped from plain arrays, and
drawn less than what is fresh."""

import pytest
import torch

from e2rl.learning.attack import Order, Solved, make_traffic
from e2rl.learning.memory import Memory
from e2rl.traffic.traffic import FULL
from tests.learning.small import brake_check, small_scenes


def traffic(number, rows=4, eta=2.0, template=FULL):
    index = torch.arange(rows)
    made = brake_check(small_scenes(rows))(None, index, eta, 0)
    made["states"] = made["states"] + number
    return {
        **made,
        "eta": torch.full((rows,), eta),
        "template": torch.full((rows,), template),
    }


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
    assert [one.number for one in memory.rounds] == left and memory.rows == 4 * len(
        left
    )
    assert len(list(memory.folder.iterdir())) == 5, "a checkpoint may still name them"
    memory.prune(left[0])
    assert sorted(memory.folder.iterdir()) == [memory.path(number) for number in left]


def test_the_pool_holds_every_round_the_newest_first_and_heavier(tmp_path):
    pool = filled(tmp_path, 100, rounds=3).pool(3.0)
    assert pool.fresh.tolist() == [True] * 4 + [False] * 8
    probability = pool.probabilities(torch.full((4,), 0.25), 0.7)
    assert probability.tolist() == pytest.approx([3 / 20] * 4 + [1 / 20] * 8)
    states, _ = pool.tracks(pool.source)
    expected = torch.cat([traffic(number)["states"] for number in (2, 1, 0)])
    assert torch.equal(states, expected)


def test_evasions_make_the_round_trip(tmp_path):
    """Through make_traffic, the file and the pool; rows that are left out and nominal
    ones have none."""
    scenes = small_scenes(4)
    index = torch.arange(4)
    actions = torch.arange(4 * 20 * 2).reshape(4, 20, 2).float()
    span = torch.tensor([[3, 9], [0, 0], [2, 5], [1, 4]])
    solved = Solved(torch.tensor([True, True, False, True]), actions, span=span)
    memory = Memory(tmp_path, 100)
    for number in range(2):
        order = Order(
            number,
            index,
            eta=torch.full((4,), 2.0),
            template=torch.full((4,), FULL),
            seed=0,
            ego=None,
        )
        memory.write(
            number,
            *make_traffic(order, brake_check(scenes), solvable=lambda traffic: solved),
        )
        memory.take(number)
    memory.restore(memory.index())
    pool = memory.pool(3.0)
    for number, first in ((0, 0), (1, 7)):
        rows, found, acts = pool.evaded(number)
        assert rows.tolist() == [first, first + 2] and pool.scene_index[
            rows
        ].tolist() == [0, 3]
        assert torch.equal(found, actions[[0, 3]]) and torch.equal(acts, span[[0, 3]])
    assert not pool.parts[0].evasion[3:].any() and len(pool) == 14
