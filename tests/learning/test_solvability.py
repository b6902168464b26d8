"""Only what some driver survives enters the curriculum, and what is left out is said."""

from functools import partial

import torch

from e2rl.learning.solvability import solvable
from e2rl.sim.env import SimSettings
from tests.learning.small import brake_check, small_run, small_scenes


def ambush(scenes):
    """Vehicle 1 stands on the ego from the second step on in odd scenes; in even ones it is where `brake_check` puts
    it."""
    attack = brake_check(scenes)

    def synthesize(ego, index, eta, seed):
        traffic = attack(ego, index, eta, seed)
        doomed = (index % 2 == 1) & (eta > 0)
        at = scenes.batch(index)["start"][:, None, 0, :2].expand(-1, traffic["states"].shape[1], 2)
        spread = 1.0 + torch.arange(traffic["states"].shape[1])[:, None]  # wherever the ego gets to
        traffic["states"][doomed, :, 1, :2] = (at + spread * torch.tensor([1.0, 0.0]))[doomed]
        return traffic | {"contact": eta > 0}

    return synthesize


def test_the_doomed_are_left_out_and_reported():
    scenes = small_scenes(4)
    run = small_run(scenes=scenes)
    run.synthesize, run.solvable = ambush(scenes), partial(solvable, scenes=scenes, sim=SimSettings())
    run.settings = type(run.settings)(scenes=4, nominal="log")
    metrics = run.run_round()
    kept = run.memory.rounds[-1].traffic["scene_index"]
    assert sorted(kept.tolist()) == [0, 2] and metrics["synthesizer/left_out"] == 2.0
    assert metrics["synthesizer/contact"] == 1.0, "the intensity follows all of them"
    assert set(run.episodes.scene_index[run.episodes.adversarial].tolist()) <= {0, 2}


def test_a_round_goes_on_where_everything_is_left_out():
    scenes = small_scenes(4)
    run = small_run(scenes=scenes, nominal="none")
    run.solvable = lambda traffic: torch.zeros_like(traffic["contact"])
    metrics = run.run_round()
    assert metrics["synthesizer/left_out"] == 3.0 and not run.episodes.adversarial.any()


def test_without_contact_nothing_is_searched():
    scenes = small_scenes(2)
    traffic = brake_check(scenes)(None, torch.arange(2), 0.0, 0)
    assert solvable(traffic, scenes, SimSettings()).all()
