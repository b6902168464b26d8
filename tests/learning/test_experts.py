"""Experts: evasions that avoid what hit the policy."""

import pytest
import torch

from e2rl.learning.attack import solvable
from e2rl.learning.driving import PoolDriver, episodes_of
from e2rl.learning.experts import Experts, GivenActions, evasion_demonstrations
from e2rl.sim.env import SimSettings
from e2rl.traffic.pool import TrafficPool
from tests.learning.small import brake_check, small_scenes

SIM = SimSettings()


def attacked(scenes, eta=2.0):
    """The pool of an attack on every scene, with the evasions that the search finds."""
    index = torch.arange(len(scenes))
    traffic = brake_check(scenes)(None, index, eta, 0)
    return TrafficPool.stored(
        traffic | solvable(traffic, scenes, sim=SIM)._asdict(), eta
    )


@pytest.mark.parametrize("hold", [1, 2, 3])
def test_demonstrations_of_an_evasion_avoid_the_contact_when_replayed(hold):
    """Its decisions, driven in the row's traffic; the logged drive there is hit."""
    scenes = small_scenes(3, steps=40)
    pool = attacked(scenes)
    rows = torch.arange(3)
    pool.parts[0].span[:] = torch.tensor([0, 40])  # all decisions
    driver = PoolDriver(scenes, SIM, batch=3, hold=hold)
    shown = evasion_demonstrations(driver, pool, number=0)
    actions = shown["action"].view(3, -1, 2)
    assert actions.shape[1] == -(-40 // hold) and torch.equal(
        shown["scene_index"].unique(), rows
    )
    again = driver.drive(
        GivenActions(actions.repeat_interleave(hold, 1), hold), pool, rows
    )
    assert not episodes_of(again, pool, rows=rows).failed.any()
    assert torch.allclose(
        again["observation"].flatten(0, 1), shown["observation"], atol=1e-2
    )
    straight = driver.drive(GivenActions(torch.zeros(3, 40, 2), hold), pool, rows)
    assert episodes_of(straight, pool, rows=rows).contact.all()


def test_only_the_decisions_in_the_span_are_cloned_and_each_row_once():
    scenes = small_scenes(3, steps=40)
    pool = attacked(scenes)
    driver = PoolDriver(scenes, SIM, batch=8, hold=2)
    pool.parts[0].span[:] = torch.tensor([[10, 21], [0, 0], [3, 9]])
    shown = evasion_demonstrations(driver, pool, number=0)
    assert torch.bincount(shown["scene_index"]).tolist() == [6, 0, 3], (
        "steps 10..20 and 4..8"
    )


def test_evasions_that_fail_by_decisions_are_left_out():
    scenes = small_scenes(2, steps=40)
    pool = attacked(scenes)
    driver = PoolDriver(scenes, SIM, batch=2, hold=2)
    pool.parts[0].evasion[0] = 0.0
    assert evasion_demonstrations(driver, pool, number=0)[
        "scene_index"
    ].unique().tolist() == [1]


def test_demonstrations_of_remembered_evasions_are_made_once_and_leave_with_their_rows():
    scenes = small_scenes(2, steps=40)
    older = attacked(scenes)
    newer = attacked(scenes, 3.0)
    experts = Experts(scenes, SIM, hold=2, evasions=True)
    made = []
    drive = experts._driver.drive
    experts._driver.drive = lambda *given: made.append(1) or drive(*given)
    first = experts.demonstrations(older)["evasions"]
    both = experts.demonstrations(newer + older)["evasions"]
    assert len(made) == 2 and torch.equal(
        both[-len(first) :]["action"], first["action"]
    )
    assert (
        len(experts.demonstrations(newer)["evasions"]) == len(both) - len(first)
        and len(made) == 2
    )
