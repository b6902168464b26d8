"""The next round made beside learning: the same D' as here, whenever it is ready; a
death has one message."""

import os
import signal

import pytest
import torch
from e2rl.scripts.train import train_round

from e2rl.learning.rounds.attack import make_traffic
from e2rl.learning.rounds.checkpoint import load_checkpoint, save_checkpoint
from e2rl.run.errors import InputError
from e2rl.sim.settings import SimSettings
from e2rl.traffic.rollout import synthesize_traffic
from tests.learning.small import Ambush, brake_check, small_run, small_scenes


def real(run, scenes):
    """Closed-loop synthesis, in which the ego's weights matter."""
    run.attacks = [synthesize_traffic(scenes, Ambush(), sim=SimSettings())]
    return run


def test_the_traffic_is_that_of_the_same_order_here():
    """Made against the policy before learning, whatever the policy has become
    meanwhile."""
    scenes = small_scenes()
    run = real(
        small_run(
            scenes=scenes,
            nominal="prior",
            spread=0.5,
            prefetch=True,
        ),
        scenes,
    )
    train_round(run)
    order = run._next
    rest = {name: value.clone() for name, value in order.ego.network.weights().items()}
    current = run.ego.network.weights()
    assert any(not torch.equal(value, current[name]) for name, value in rest.items())
    expected, _ = make_traffic(order, run.attacks)
    metrics = train_round(run)
    result = run.memory.rounds[-1].traffic
    assert set(result) == set(expected)
    assert order.number == run.memory.rounds[-1].number == 1
    assert all(torch.equal(result[name], expected[name]) for name in expected)
    assert metrics["time/waiting"] >= 0
    assert metrics["synthesizer/eta"] == pytest.approx(order.eta.mean().item())
    assert all(
        torch.equal(value, order.ego.network.weights()[name])
        for name, value in rest.items()
    )
    against_now = run.attacks[0](run.ego, order.scenes, order.eta, order.seed)["states"]
    assert not torch.equal(against_now, result["states"][: len(order.scenes)])


def test_a_process_that_dies_is_named_and_the_run_goes_on_from_its_checkpoint(tmp_path):
    def begun():
        return small_run(folder=tmp_path, prefetch=True)

    run = begun()
    attack = brake_check(small_scenes())
    run.attacks = [
        lambda ego, index, eta, seed: (
            os.kill(os.getpid(), signal.SIGKILL)
            if seed == 1
            else attack(ego, index, eta, seed)
        )
    ]
    train_round(run)
    save_checkpoint(tmp_path, run)
    with pytest.raises(InputError, match=r"round 2: .*killed"):
        train_round(run)
    again = begun()
    whole = small_run(prefetch=True)
    assert load_checkpoint(tmp_path, again) == 1
    train_round(again)
    train_round(whole), train_round(whole)
    assert whole.memory.index() == again.memory.index()
