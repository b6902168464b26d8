"""Experts: evasions that avoid what hit the policy."""

import pytest
import torch

from e2rl.learning.attack import solvable
from e2rl.learning.driving import PoolDriver, episodes_of
from e2rl.learning.experts import Experts, GivenActions, evasion_pairs
from e2rl.learning.run_checkpoint import load_checkpoint, save_checkpoint
from e2rl.sim.env import SimSettings
from e2rl.traffic.pool import TrafficPool
from tests.learning.small import brake_check, small_run, small_scenes

SIM = SimSettings()


def attacked(scenes, eta=2.0):
    """The pool of an attack on every scene, with the evasions that the search finds."""
    index = torch.arange(len(scenes))
    traffic = brake_check(scenes)(None, index, eta, 0)
    return TrafficPool.stored(traffic | solvable(traffic, scenes, SIM)._asdict(), eta)


@pytest.mark.parametrize("hold", [1, 2, 3])
def test_pairs_of_an_evasion_avoid_the_contact_when_replayed(hold):
    """Its decisions, driven in the row's traffic; the logged drive there is hit."""
    scenes = small_scenes(3, steps=40)
    pool, rows = attacked(scenes), torch.arange(3)
    pool.parts[0].span[:] = torch.tensor([0, 40])  # all decisions
    driver = PoolDriver(scenes, SIM, 3, hold=hold)
    pairs = evasion_pairs(driver, pool, 0)
    actions = pairs["action"].view(3, -1, 2)
    assert actions.shape[1] == -(-40 // hold) and torch.equal(pairs["scene_index"].unique(), rows)
    again = driver.drive(GivenActions(actions.repeat_interleave(hold, 1), hold), pool, rows)
    assert not episodes_of(again, pool, rows).failed.any()
    assert torch.allclose(again["observation"].flatten(0, 1), pairs["observation"], atol=1e-2)
    straight = driver.drive(GivenActions(torch.zeros(3, 40, 2), hold), pool, rows)
    assert episodes_of(straight, pool, rows).contact.all()


def test_only_the_decisions_in_the_span_are_cloned_and_each_row_once():
    scenes = small_scenes(3, steps=40)
    pool, driver = attacked(scenes), PoolDriver(scenes, SIM, 8, hold=2)
    pool.parts[0].span[:] = torch.tensor([[10, 21], [0, 0], [3, 9]])
    pairs = evasion_pairs(driver, pool, 0)
    assert torch.bincount(pairs["scene_index"]).tolist() == [6, 0, 3], "steps 10..20 and 4..8"


def test_evasions_that_fail_by_decisions_are_left_out():
    scenes = small_scenes(2, steps=40)
    pool, driver = attacked(scenes), PoolDriver(scenes, SIM, 2, hold=2)
    pool.parts[0].evasion[0] = 0.0
    assert evasion_pairs(driver, pool, 0)["scene_index"].unique().tolist() == [1]


def test_rows_without_an_evasion_yield_no_pairs():
    scenes = small_scenes(2)
    index, driver = torch.arange(2), PoolDriver(scenes, SIM, 2)
    pool = TrafficPool.stored(brake_check(scenes)(None, index, 2.0, 0), 2.0) + TrafficPool.recorded(index)
    assert evasion_pairs(driver, pool, 0) is None
    experts = Experts(scenes, SIM, 2, evasions=True)
    assert experts.pairs(pool) == {} == experts.pairs(TrafficPool.recorded(index))


def test_pairs_of_remembered_evasions_are_made_once_and_leave_with_their_rows():
    scenes = small_scenes(2, steps=40)
    older, newer = attacked(scenes), attacked(scenes, 3.0)
    experts, made = Experts(scenes, SIM, 2, evasions=True), []
    drive = experts._driver.drive
    experts._driver.drive = lambda *given: made.append(1) or drive(*given)
    first = experts.pairs(older)["evasions"]
    both = experts.pairs(newer + older)["evasions"]
    assert len(made) == 2 and torch.equal(both[-len(first) :]["action"], first["action"])
    assert len(experts.pairs(newer)["evasions"]) == len(both) - len(first) and len(made) == 2


def test_a_round_clones_evasions_and_a_resumed_one_the_same(tmp_path):
    scenes = small_scenes(steps=40)

    def begun():
        expert = {"evasions": True}
        run = small_run(folder=tmp_path, scenes=scenes, expert=expert, cloning=0.5, collect={"hold": 2}, final_lr=1.0)
        attack = brake_check(scenes)
        run.synthesize = lambda ego, index, eta, seed: attack(ego, index, eta + 1.5 * (eta > 0), seed)
        run.solvable = lambda traffic: solvable(traffic, scenes, SIM)
        return run

    run = begun()
    one = run.run_round()
    save_checkpoint(tmp_path, run, {})
    two = run.run_round()
    assert two["train/evasions_pairs"] > one["train/evasions_pairs"] > 0
    again = begun()
    assert load_checkpoint(tmp_path, again) == 1
    resumed = again.run_round()
    assert {name: value for name, value in resumed.items() if not name.startswith("time/")} == {
        name: value for name, value in two.items() if not name.startswith("time/")
    }
