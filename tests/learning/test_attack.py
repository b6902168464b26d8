"""The traffic of a round: the same whoever makes which part of it; only what some
driver avoids enters; what cannot be made costs its own rows, the round goes on, and the
reasons are counted."""

from functools import partial

import pytest
import torch
from e2rl.scripts.train import train_round

from e2rl.learning.attack import (
    AFTER,
    ATTACK,
    LATE,
    Order,
    acting,
    drawn,
    make_traffic,
    mixture,
    solvable,
    unsearched,
)
from e2rl.planners.idm_planner import IDMEgo
from e2rl.scenes.boxes import separation
from e2rl.sim import dynamics
from e2rl.sim.env import SimSettings
from e2rl.traffic.rollout import synthesize_traffic
from e2rl.traffic.traffic import CHAIN, FULL, PAIR, SINGLE
from tests.learning.small import Ambush, brake_check, small_run, small_scenes

SCENES = torch.tensor([3, 0, 4, 1, 2])
ETA = torch.tensor([0.5, 2.0, 0.0, 3.0, 1.5])


def odd_ones_left_out(traffic):
    solved = unsearched(traffic["states"])
    return solved._replace(
        entered=traffic["scene_index"] % 2 == 0,
        span=traffic["scene_index"][:, None].repeat(1, 2),
    )


@pytest.mark.parametrize("nominal", [True, False])
@pytest.mark.parametrize("batch", [1, 2, 5])
def test_batches_are_joined_in_the_order_of_the_scenes(nominal, batch):
    attack = brake_check(small_scenes(5))
    template = torch.tensor([SINGLE, PAIR, FULL, CHAIN, SINGLE])

    def synthesize(ego, index, eta, seed, *limits):
        assert all(
            torch.equal(each, template[torch.isin(SCENES, index)]) for each in limits
        )
        return attack(ego, index, eta, seed)

    order = Order(0, SCENES, eta=ETA, template=template, seed=7, ego=None)
    traffic, _ = make_traffic(
        order, synthesize, solvable=odd_ones_left_out, nominal=nominal, batch=batch
    )
    kept = [0, 4, 2]
    every = kept + SCENES.tolist() * nominal
    assert (
        traffic["scene_index"].tolist() == every
        and traffic["entered"].tolist() == (SCENES % 2 == 0).tolist()
    )
    assert traffic["eta"].tolist() == [2.0, 0.0, 1.5] + [0.0] * (len(every) - 3)
    assert traffic["template"].tolist() == [PAIR, FULL, SINGLE] + [FULL] * (
        len(every) - 3
    )
    assert traffic["span"][:3, 0].tolist() == kept and not traffic["span"][3:].any()
    assert (
        traffic["attacked"] == 4 / 5 and traffic["contact"] == 3 / 5
    )  # of all that were attacked
    whole, _ = make_traffic(
        order, synthesize, solvable=odd_ones_left_out, nominal=nominal
    )
    assert all(torch.equal(traffic[name], whole[name]) for name in whole) and set(
        traffic
    ) == set(whole)


class Stumbles(Ambush):
    """Raises where it attacks scene 2."""

    def replan(self, state, world, ego_plan):
        if ((world.scene["scene_index"] == 2) & (state > 0)).any():
            raise ZeroDivisionError("no way out")
        return super().replan(state, world, ego_plan)


def test_rows_that_raise_are_left_out_and_named_and_the_others_are_as_without_them():
    scenes = small_scenes(4)
    index = torch.arange(4)
    order = Order(
        2,
        index,
        eta=torch.full((4,), 2.0),
        template=torch.zeros_like(index),
        seed=7,
        ego=IDMEgo(),
    )
    made, errored = make_traffic(
        order, synthesize_traffic(scenes, Stumbles(), sim=SimSettings(), batch=3)
    )
    whole, none = make_traffic(
        order, synthesize_traffic(scenes, Ambush(), sim=SimSettings(), batch=3)
    )
    assert (
        made["entered"].tolist() == [True, True, False, True]
        and whole["entered"].all()
        and not none
    )
    (entry,) = errored
    assert (entry["round"], entry["during"], entry["scene"], entry["eta"]) == (
        2,
        ATTACK,
        2,
        2.0,
    )
    assert (
        entry["reason"] == "raised ZeroDivisionError"
        and "no way out" in entry["traceback"]
    )
    assert (
        made["scene_index"].tolist() == [0, 1, 3, 0, 1, 2, 3]
        and made["eta"].tolist() == [2.0] * 3 + [0.0] * 4
    )
    rest = torch.tensor([0, 1, 3, 4, 5, 6, 7])
    torch.testing.assert_close(made["states"], whole["states"][rest], rtol=0, atol=1e-4)
    assert made["contact"] == 1.0, "the share of those that were made"


# --- what some driver avoids


def ambush(scenes):
    """Vehicle 1 is where the ego is from the first step on in odd scenes, else where
    `brake_check` puts it."""
    attack = brake_check(scenes)

    def synthesize(ego, index, eta, seed):
        traffic = attack(ego, index, eta, seed)
        doomed = (index % 2 == 1) & (eta > 0)
        traffic["states"][doomed, 1:, 1] = traffic["states"][doomed, 1:, 0]
        return traffic | {"contact": eta > 0}

    return synthesize


def test_the_doomed_are_left_out_and_reported():
    scenes = small_scenes(4)
    run = small_run(scenes=scenes)
    run.synthesize = ambush(scenes)
    run.solvable = partial(solvable, scenes=scenes, sim=SimSettings())
    run.settings = type(run.settings)(scenes=4, nominal="log")
    metrics = train_round(run)
    kept = run.memory.rounds[-1].traffic["scene_index"]
    assert sorted(kept.tolist()) == [0, 2] and metrics["synthesizer/left_out"] == 2.0
    assert metrics["synthesizer/contact"] == 1.0, "the intensity follows all of them"
    assert set(run.episodes.scene_index[run.episodes.adversarial].tolist()) <= {0, 2}


def test_a_round_goes_on_where_everything_is_left_out():
    scenes = small_scenes(4)
    run = small_run(scenes=scenes, nominal="none")
    run.solvable = lambda traffic: unsearched(traffic["states"])._replace(
        entered=torch.zeros_like(traffic["contact"])
    )
    metrics = train_round(run)
    assert metrics["synthesizer/left_out"] == 3.0 and not run.episodes.adversarial.any()


def test_evasions_are_kept_with_what_they_avoid():
    """Driven without contact by their actions; marked by the steps in which they act,
    around the contact."""
    scenes = small_scenes(3, steps=40)
    index = torch.arange(3)
    traffic = brake_check(scenes)(None, index, torch.tensor([1.2, 0.5, 3.0]), 0)
    solved = solvable(traffic, scenes, sim=SimSettings())
    assert (
        solved.entered.all()
        and not solved.span[1].any()
        and not solved.evasion[1].any()
    ), "not hit, so not searched"
    begin, end = solved.span[[0, 2]].unbind(1)
    assert (end - AFTER > 10).all() and (end[1] < end[0]), (
        "the nearer car is met earlier"
    )
    assert (begin < end - AFTER).all()
    found = dynamics.rollout(traffic["states"][:, 0, 0], solved.evasion)
    size = scenes.scenes["size"][index]
    other = traffic["states"][:, 1:, 1]
    clear = (
        separation(found, size[:, None, 0], second=other, second_size=size[:, None, 1])
        > 0
    )
    hit = (
        separation(
            traffic["states"][:, 1:, 0],
            size[:, None, 0],
            second=other,
            second_size=size[:, None, 1],
        )
        < 0
    )
    assert clear[[0, 2]].all() and hit[[0, 2]].any(1).all()
    stop = hit.int().argmax(1) + 1
    assert (
        torch.equal(end, stop[[0, 2]] + AFTER) and (begin >= stop[[0, 2]] - LATE).all()
    )
    late = int(stop[0]) - LATE
    torch.testing.assert_close(
        found[0, :late], traffic["states"][0, 1 : late + 1, 0], atol=1e-3, rtol=0
    )
    assert late > 2, "it drives as it did until then"


def test_an_evasion_acts_from_before_it_departs_until_after_the_contact():
    steps = torch.arange(1, 41)
    driven = torch.zeros(3, 40, 4)
    driven[..., 0] = steps.float()
    evasion = driven.clone()
    evasion[0, 19:, 1] = 1.0  # beside the drive from step 20 on
    evasion[1, 4:, 1] = 1.0
    begin = torch.tensor([0, 2, 0])
    stop = torch.tensor([30, 38, 15])
    assert acting(evasion, driven, begin=begin, stop=stop).tolist() == [
        [10, 35],
        [2, 40],
        [5, 20],
    ]


# --- two attackers


MIXED = torch.tensor([3, 0, 4, 1, 2, 9, 7])


def marked(mark, lost=()):
    """A method that marks its rows, and cannot make the scenes `lost`."""

    def synthesize(ego, scenes, eta, seed, *template):
        there = [row for row, scene in enumerate(scenes.tolist()) if scene not in lost]
        made = {
            "scene_index": scenes[there],
            "eta": eta[there],
            "mark": torch.full((len(there),), mark),
        }
        made |= {"template": template[0][there]} if template else {}
        return made | {
            "errored": {
                row: {"reason": mark} for row in range(len(scenes)) if row not in there
            }
        }

    return synthesize


def test_rows_come_in_the_order_of_the_scenes_each_by_its_own_method():
    eta = torch.arange(7.0)
    template = torch.arange(7)
    made = mixture(marked(1), marked(2), fraction=0.5)(None, MIXED, eta, 5, template)
    assert torch.equal(made["scene_index"], MIXED) and torch.equal(made["eta"], eta)
    assert torch.equal(made["template"], template) and not made["errored"]
    assert torch.equal(made["mark"] == 2, drawn(MIXED, 5, fraction=0.5)) and set(
        made["mark"].tolist()
    ) == {1, 2}


def test_who_attacks_a_scene_does_not_depend_on_its_batch():
    whole = drawn(MIXED, 5, fraction=0.5)
    assert torch.equal(
        whole, torch.cat([drawn(part, 5, fraction=0.5) for part in MIXED.split(2)])
    )
    assert any(
        not torch.equal(whole, drawn(MIXED, seed, fraction=0.5))
        for seed in range(6, 12)
    )


def test_the_fraction_is_that_of_the_scenes():
    scenes = torch.arange(4000)
    assert abs(drawn(scenes, 1, fraction=0.3).float().mean() - 0.3) < 0.03
    assert (
        not drawn(scenes, 1, fraction=0.0).any()
        and drawn(scenes, 1, fraction=1.0).all()
    )


def test_rows_that_a_method_cannot_make_are_named_by_their_place():
    made = mixture(marked(1, lost=[4]), marked(2, lost=[4]), fraction=0.5)(
        None, MIXED, torch.ones(7), 5
    )
    assert made["scene_index"].tolist() == [3, 0, 1, 2, 9, 7] and set(
        made["errored"]
    ) == {2}
