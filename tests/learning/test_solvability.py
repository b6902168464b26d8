"""Only what some driver survives enters the curriculum, and what is left out is said."""

from functools import partial

import torch

from e2rl.learning.attack import AFTER, LATE, acting, solvable, unsearched
from e2rl.scenes.boxes import separation
from e2rl.sim import dynamics
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
    run.solvable = lambda traffic: unsearched(traffic["states"])._replace(kept=torch.zeros_like(traffic["contact"]))
    metrics = run.run_round()
    assert metrics["synthesizer/left_out"] == 3.0 and not run.episodes.adversarial.any()


def test_without_contact_nothing_is_searched():
    scenes = small_scenes(2)
    traffic = brake_check(scenes)(None, torch.arange(2), 0.0, 0)
    solved = solvable(traffic, scenes, SimSettings())
    assert solved.kept.all() and not solved.span.any()


def test_evasions_are_kept_with_what_they_avoid():
    """Driven without contact by their actions; marked by the steps in which they act, around the contact."""
    scenes, index = small_scenes(3, steps=40), torch.arange(3)
    traffic = brake_check(scenes)(None, index, torch.tensor([1.2, 0.5, 3.0]), 0)
    solved = solvable(traffic, scenes, SimSettings())
    assert solved.kept.all() and not solved.span[1].any() and not solved.evasion[1].any(), "not hit, so not searched"
    begin, end = solved.span[[0, 2]].unbind(1)
    assert (end - AFTER > 10).all() and (end[1] < end[0]), "the nearer car is met earlier"
    assert (begin < end - AFTER).all()
    found = dynamics.rollout(traffic["states"][:, 0, 0], solved.evasion)
    size, other = scenes.scenes["size"][index], traffic["states"][:, 1:, 1]
    clear = separation(found, size[:, None, 0], other, size[:, None, 1]) > 0
    hit = separation(traffic["states"][:, 1:, 0], size[:, None, 0], other, size[:, None, 1]) < 0
    assert clear[[0, 2]].all() and hit[[0, 2]].any(1).all()
    stop = hit.int().argmax(1) + 1
    assert torch.equal(end, stop[[0, 2]] + AFTER) and (begin >= stop[[0, 2]] - LATE).all()
    late = int(stop[0]) - LATE
    torch.testing.assert_close(found[0, :late], traffic["states"][0, 1 : late + 1, 0], atol=1e-3, rtol=0)
    assert late > 2, "it drives as it did until then"


def test_an_evasion_acts_from_before_it_departs_until_after_the_contact():
    steps = torch.arange(1, 41)
    driven = torch.zeros(3, 40, 4)
    driven[..., 0] = steps.float()
    evasion = driven.clone()
    evasion[0, 19:, 1] = 1.0  # beside the drive from step 20 on
    evasion[1, 4:, 1] = 1.0
    begin, stop = torch.tensor([0, 2, 0]), torch.tensor([30, 38, 15])
    assert acting(evasion, driven, begin, stop).tolist() == [[10, 35], [2, 40], [5, 20]]
