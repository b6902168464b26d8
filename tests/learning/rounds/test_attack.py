"""The traffic of a round: the same whoever makes which part of it; only what some
driver avoids enters; what cannot be made costs its own rows, the round goes on, and the
reasons are counted."""

from functools import partial

import pytest
import torch
from e2rl.scripts.train import train_round

from e2rl.learning.rounds.attack import ATTACK, Order, make_traffic, solvable
from e2rl.planners.idm_planner import IDMEgo
from e2rl.sim.settings import SimSettings
from e2rl.traffic.rollout import synthesize_traffic
from tests.learning.small import Ambush, brake_check, small_run, small_scenes

SCENES = torch.tensor([3, 0, 4, 1, 2])
ETA = torch.tensor([0.5, 2.0, 0.0, 3.0, 1.5])


def even_scenes(traffic):
    """Who enters D': scenes of an even number."""
    return traffic["scene_index"] % 2 == 0


@pytest.mark.parametrize("nominal", [True, False])
@pytest.mark.parametrize("batch", [1, 2, 5])
def test_batches_are_joined_in_the_order_of_the_scenes(nominal, batch):
    attack = brake_check(small_scenes(5))
    order = Order(
        0,
        SCENES,
        attack=torch.tensor([0, 0, 0, 1, 1]),
        eta=ETA,
        seed=7,
        ego=None,
    )
    traffic, _ = make_traffic(
        order, [attack] * 2, solvable=even_scenes, nominal=nominal, batch=batch
    )
    entered = [0, 4, 2]
    scenes = entered + SCENES.tolist() * nominal
    assert traffic["scene_index"].tolist() == scenes
    assert traffic["entered"].tolist() == (SCENES % 2 == 0).tolist()
    assert traffic["eta"].tolist() == [2.0, 0.0, 1.5] + [0.0] * (len(scenes) - 3)
    assert traffic["attacked"].tolist() == [1, 1, 0, 1, 1], "also of what is left out"
    assert traffic["contact"].sum() == 3
    whole, _ = make_traffic(
        order,
        [attack] * 2,
        solvable=even_scenes,
        nominal=nominal,
    )
    assert set(traffic) == set(whole)
    assert all(torch.equal(traffic[name], whole[name]) for name in whole)


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
        attack=torch.zeros_like(index),
        eta=torch.full((4,), 2.0),
        seed=7,
        ego=IDMEgo(),
    )
    built, errored = make_traffic(
        order,
        [
            synthesize_traffic(
                scenes,
                Stumbles(),
                sim=SimSettings(),
                batch=3,
            )
        ],
    )
    whole, none = make_traffic(
        order,
        [
            synthesize_traffic(
                scenes,
                Ambush(),
                sim=SimSettings(),
                batch=3,
            )
        ],
    )
    assert built["entered"].tolist() == [True, True, False, True]
    assert whole["entered"].all()
    assert not none
    (entry,) = errored
    assert (entry["round"], entry["during"], entry["scene"], entry["eta"]) == (
        2,
        ATTACK,
        2,
        2.0,
    )
    assert entry["reason"] == "raised ZeroDivisionError"
    assert "no way out" in entry["traceback"]
    assert built["scene_index"].tolist() == [0, 1, 3, 0, 1, 2, 3]
    assert built["eta"].tolist() == [2.0] * 3 + [0.0] * 4
    rest = torch.tensor([0, 1, 3, 4, 5, 6, 7])
    torch.testing.assert_close(
        built["states"],
        whole["states"][rest],
        rtol=0,
        atol=1e-4,
    )
    torch.testing.assert_close(
        built["contact"], torch.tensor([1.0, 1.0, torch.nan, 1.0]), equal_nan=True
    )


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


def test_each_scene_is_attacked_as_ordered():
    """By the first attack or the second, whose adversaries differ."""
    calm = brake_check(small_scenes(5))

    def other(ego, index, eta, seed):
        return (traffic := calm(ego, index, eta, seed)) | {
            "adversaries": ~traffic["adversaries"]
        }

    order = Order(
        0,
        SCENES,
        attack=torch.tensor([0, 0, 0, 1, 1]),
        eta=torch.ones(5),
        seed=7,
        ego=None,
    )
    traffic, _ = make_traffic(order, [calm, other], batch=2)
    assert traffic["adversaries"][:5, 1].tolist() == [True] * 3 + [False] * 2
    assert traffic["adversaries"][5:, 1].tolist() == [False] * 5, "nominal by the first"


def test_the_doomed_are_left_out_and_reported():
    scenes = small_scenes(4)
    run = small_run(scenes=scenes)
    run.attacks = [ambush(scenes)]
    run.solvable = partial(solvable, scenes=scenes, sim=SimSettings())
    run.settings = type(run.settings)(scenes=4, nominal="log")
    metrics = train_round(run)
    rest = run.memory.rounds[-1].traffic["scene_index"]
    assert sorted(rest.tolist()) == [0, 2]
    assert metrics["synthesizer/left_out"] == 2.0
    assert metrics["synthesizer/contact"] == 1.0, "the intensity follows all of them"
    assert set(run.episodes.scene_index[run.episodes.adversarial].tolist()) <= {0, 2}


def test_a_round_goes_on_where_everything_is_left_out():
    scenes = small_scenes(4)
    run = small_run(scenes=scenes, nominal="none")
    run.solvable = lambda traffic: torch.zeros_like(traffic["contact"])
    metrics = train_round(run)
    assert metrics["synthesizer/left_out"] == 3.0
    assert not run.episodes.adversarial.any()
