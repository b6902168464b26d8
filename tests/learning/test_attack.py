"""The traffic of a round: whoever makes which part of it, it is the same; what cannot be made or driven costs its own
rows, the round goes on, and the reasons are counted."""

import pytest
import torch

from e2rl.learning.attack import ATTACK, NOMINAL, Order, counted, ended_of, make_traffic, unsearched
from e2rl.learning.evolution import Evolution, RoundSettings
from e2rl.learning.planner_tuning import PlannerImprovement
from e2rl.learning.schedules import AdaptiveCurriculum
from e2rl.planners.idm_planner import IDMEgo
from e2rl.report.rounds import round_line
from e2rl.run.errors import InputError
from e2rl.sim.env import SimSettings
from e2rl.traffic.rollout import synthesize_traffic
from e2rl.traffic.traffic import FULL
from tests.learning.small import Ambush, brake_check, small_run, small_scenes

SCENES = torch.tensor([3, 0, 4, 1, 2])
ETA = torch.tensor([0.5, 2.0, 0.0, 3.0, 1.5])


def odd_ones_left_out(traffic):
    solved = unsearched(traffic["states"])
    return solved._replace(kept=traffic["scene_index"] % 2 == 0, span=traffic["scene_index"][:, None].repeat(1, 2))


@pytest.mark.parametrize("nominal", [True, False])
@pytest.mark.parametrize("batch", [1, 2, 5])
def test_batches_are_joined_in_the_order_of_the_scenes(nominal, batch):
    order = Order(0, SCENES, ETA, torch.full_like(SCENES, FULL), 7, None)
    traffic = make_traffic(order, brake_check(small_scenes(5)), odd_ones_left_out, nominal, batch)
    kept = [0, 4, 2]
    every = kept + SCENES.tolist() * nominal
    assert traffic["scene_index"].tolist() == every and traffic["kept"].tolist() == (SCENES % 2 == 0).tolist()
    assert traffic["eta"].tolist() == [2.0, 0.0, 1.5] + [0.0] * (len(every) - 3)
    assert traffic["span"][:3, 0].tolist() == kept and not traffic["span"][3:].any()
    assert traffic["attacked"] == 4 / 5 and traffic["contact"] == 3 / 5  # of all that were attacked
    whole = make_traffic(order, brake_check(small_scenes(5)), odd_ones_left_out, nominal)
    assert all(torch.equal(traffic[name], whole[name]) for name in whole) and set(traffic) == set(whole)


def test_templates_are_given_by_scene_and_to_the_attack_alone():
    given = []

    def synthesize(ego, index, eta, seed, *template):
        given.append((index.tolist(), [part.tolist() for part in template]))
        return brake_check(small_scenes(5))(ego, index, eta, seed)

    order = Order(0, SCENES, ETA, torch.tensor([0, 0, 0, 1, 0]), 7, None)
    make_traffic(order, synthesize, batch=3)
    assert given == [([3, 0, 4], [[0, 0, 0]]), ([1, 2], [[1, 0]]), ([3, 0, 4], []), ([1, 2], [])]


class Stumbles(Ambush):
    """Raises in the scenes of `bad` where it attacks, or plans NaN in them."""

    def __init__(self, bad, raises=True):
        super().__init__()
        self.bad, self.raises = torch.tensor(bad), raises

    def replan(self, state, world, ego_plan):
        ill = torch.isin(world.scene["scene_index"], self.bad) & (state > 0)
        if self.raises and ill.any():
            raise ZeroDivisionError("no way out")
        state, plan = super().replan(state, world, ego_plan)
        plan.states[ill] = torch.nan
        return state, plan


def order_of(count, number=2):
    scenes, eta = torch.arange(count), torch.full((count,), 2.0)
    return Order(number, scenes, eta, torch.zeros(count, dtype=torch.int64), 7, IDMEgo())


@pytest.mark.parametrize(
    ("raises", "reason"), [(True, "raised ZeroDivisionError"), (False, "a state was NaN or infinite")]
)
def test_rows_that_raise_are_left_out_and_named_and_the_others_are_as_without_them(raises, reason):
    scenes = small_scenes(4)
    made = make_traffic(order_of(4), synthesize_traffic(scenes, Stumbles([2], raises), SimSettings(), batch=3))
    whole = make_traffic(order_of(4), synthesize_traffic(scenes, Ambush(), SimSettings(), batch=3))
    assert made["kept"].tolist() == [True, True, False, True] and whole["kept"].all() and not ended_of(whole)
    (entry,) = ended_of(made)
    assert (entry["round"], entry["during"], entry["scene"], entry["eta"]) == (2, ATTACK, 2, 2.0)
    assert entry["reason"] == reason and ("no way out" in entry["traceback"]) == raises
    assert made["scene_index"].tolist() == [0, 1, 3, 0, 1, 2, 3] and made["eta"].tolist() == [2.0] * 3 + [0.0] * 4
    rest = torch.tensor([0, 1, 3, 4, 5, 6, 7])
    torch.testing.assert_close(made["states"], whole["states"][rest], rtol=0, atol=1e-4)
    assert made["contact"] == 1.0, "the share of those that were made"


def test_where_nothing_can_be_made_the_message_says_why():
    synthesize = synthesize_traffic(small_scenes(2), Stumbles([0, 1]), SimSettings())
    with pytest.raises(InputError, match="no traffic could be made: 2 raised ZeroDivisionError .no way out."):
        make_traffic(order_of(2), synthesize)


@pytest.mark.parametrize("ahead", [False, True])
def test_the_round_goes_on_and_counts_them_apart_from_the_doomed(ahead):
    scenes = small_scenes(3)
    run = small_run(scenes=scenes, nominal="prior", ahead=ahead)
    run.synthesize = synthesize_traffic(scenes, Stumbles([1]), SimSettings())
    metrics = run.run_round()
    assert metrics["synthesizer/ended"] == 1.0 == metrics["synthesizer/ended_raised_ZeroDivisionError"]
    assert metrics["synthesizer/left_out"] == 0.0 and [entry["scene"] for entry in run.ended] == [1]
    assert "1 raised ZeroDivisionError" in round_line(metrics, 1, 4)
    assert 1 not in run.episodes.scene_index[run.episodes.adversarial].tolist()
    assert run.run_round()["synthesizer/ended"] == 1.0 and run.ended[0]["round"] == 1


class Fragile(IDMEgo):
    """Raises in the scene whose ego starts at `bad` m/s, or everywhere, while it desires more than 11 m/s."""

    def __init__(self, desired_speed: float = 10.0, headway: float = 1.0, bad: float = -1.0) -> None:
        super().__init__(desired_speed=desired_speed, headway=headway, use_limits=False)
        self.bad = bad

    def plan(self, world):
        ill = (world.scene["start"][:, 0, 3] - self.bad).abs() < 1e-6
        if self.desired_speed > 11 and (self.bad == 0 or ill.any()):
            raise KeyError("lost")
        return super().plan(world)


def tuned(present, space):
    scenes = small_scenes(3, steps=40)
    scenes.scenes["start"][:, 0, 3] = 6.0 + torch.arange(3)
    search = {"trials": 2, "startup": 10}
    improve = PlannerImprovement(Fragile(**present), present, scenes, SimSettings(), search, space, batch=2)
    return Evolution(AdaptiveCurriculum(3, 2), improve, brake_check(scenes), RoundSettings(scenes=3, nominal="log"))


def test_a_planner_that_raises_in_tuning_loses_these_episodes_and_does_not_win():
    run = tuned({"desired_speed": 10.0, "headway": 1.0, "bad": 7.0}, {"desired_speed": [10.0, 200.0]})
    metrics = run.run_round()
    assert [trial["metrics"]["ended"] for trial in run.improve.trials] == [0.0, 2.0], "attacked and recorded"
    assert not run.improve.trials[1]["admissible"] and run.ego.desired_speed == 10.0
    assert metrics["train/ended"] == 0.0 and run.ended == []


def test_a_planner_that_always_raised_there_is_tuned_on_the_rest():
    run = tuned({"desired_speed": 12.0, "headway": 1.0, "bad": 7.0}, {"headway": [1.0, 1.5]})
    metrics = run.run_round()
    assert metrics["train/ended"] == 2.0 == metrics["train/ended_raised_KeyError"] and metrics["train/episodes"] == 4.0
    assert {entry["during"] for entry in run.ended} == {"tuning"} and len(run.ended) == 2
    assert set(run.episodes.scene_index.tolist()) == {0, 2}


def test_a_trial_without_any_episode_is_refused_and_the_present_parameters_have_a_message():
    run = tuned({"desired_speed": 10.0, "headway": 1.0, "bad": 0.0}, {"desired_speed": [10.0, 200.0]})
    run.run_round()
    assert run.improve.trials[1]["metrics"]["ended"] == 6.0 and not run.improve.trials[1]["admissible"]
    with pytest.raises(InputError, match=r"NaN metrics .ended_raised_KeyError"):
        tuned({"desired_speed": 12.0, "headway": 1.0, "bad": 0.0}, {"headway": [1.0, 1.5]}).run_round()


def test_counts_are_metrics():
    assert counted([]) == {"ended": 0.0}
    assert counted([{"reason": "raised A"}] * 2) == {"ended": 2.0, "ended_raised_A": 2.0}
    assert NOMINAL != ATTACK
