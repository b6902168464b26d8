"""Trials: what they are measured by, what refuses them, and small real runs of a
planner and an adversary."""

import math

import pytest
import torch

from e2rl.commands.tune import flat
from e2rl.driving.setup import Method, Setup
from e2rl.evaluation.build import build_traffic
from e2rl.evaluation.protocol import run_protocol
from e2rl.evaluation.trials import (
    DRIVING,
    MEASURED,
    SOUGHT,
    AttackObjective,
    AttackTrials,
    PlannerObjective,
    PlannerTrials,
    driving,
)
from e2rl.evaluation.tuning import SearchSettings, search
from e2rl.planners.ego import PLAN_STEPS, Ego
from e2rl.planners.path import MissionPath
from e2rl.run.config import load_choice, resolved, with_changes
from e2rl.sim.settings import SimSettings
from e2rl.traffic.baselines.ctg import CTGAdv
from e2rl.traffic.nominal import NominalTraffic
from tests.prior.small import small_prior
from tests.traffic.e2.traffic_scenes import EGO, scenes, synthesizer

ATTACKS = (
    "e2",
    "e2_unbound",
    "e2_pursuit",
    "ctg_adv",
    "safe_sim_opt",
    "ccdiff",
    "diffscene",
    "cat",
    "strive",
)


class Cruise(Ego):
    """Holds a fraction of its speed."""

    def __init__(self, gain: float = 1.0) -> None:
        super().__init__()
        self.gain = gain

    def plan(self, world):
        speed = self.gain * world.states[:, 0, 3:]
        return MissionPath(world).drive(speed.expand(-1, PLAN_STEPS + 1))


def test_a_planner_s_objective_is_collisions_comfort_and_lost_progress_within_guards():
    objective = PlannerObjective(
        comfort=0.2, progress=0.4, progress_floor=0.9, comfort_ceiling=1.5
    )
    reference = {"collision": 0.5, "comfort": 1.0, "progress": 80.0, "errored": 0.1}
    trial = {"collision": 0.25, "comfort": 2.0, "progress": 60.0, "errored": 0.3}
    value, excess = objective.judge(trial, reference)
    assert value == pytest.approx(0.25 + 0.2 * 2.0 + 0.4 * 0.25)
    assert excess == pytest.approx((0.9 - 0.75) + (2.0 - 1.5) + (0.3 - 0.1))
    assert (
        objective.judge(
            trial | {"comfort": 1.5, "progress": 72.0, "errored": 0.1}, reference
        )[1]
        == 0
    )
    faster = objective.judge(trial | {"progress": 100.0}, reference)[0]
    assert faster == pytest.approx(0.25 + 0.2 * 2.0), "more progress earns nothing"


def test_every_trial_meets_traffic_made_against_it():
    """Real rollouts: the present planner, then others; an ego that stands is refused,
    and no attack is replayed."""
    built = []

    class Watched(type(synthesizer())):
        def replan(self, state, world, ego_plan):
            built.append(ego_plan[:, -1, :2].clone())
            return super().replan(state, world, ego_plan)

    on = Watched(synthesizer().prior)
    setup = Setup(
        scenes(2, steps=10), Cruise(), ego_name="cruise", sim=SimSettings(), batch=4
    )
    methods = [Method("nominal", on), Method("e2", on, eta=2.0)]
    trials = PlannerTrials(
        setup, methods, seeds=[0], make=lambda parameters: Cruise(**parameters)
    )
    settings = SearchSettings(trials=3, startup=1, sweep=0)
    first, *others = search(
        trials,
        {"gain": 1.0},
        space={"gain": [0.0, 1.0]},
        settings=settings,
        objective=PlannerObjective(),
    )
    assert {*DRIVING, "collision nominal@0", "collision e2@2", "errored"} <= set(
        first["metrics"]
    )
    assert first["admissible"]
    assert first["metrics"]["progress"] > 7
    both = [first["metrics"][f"progress {label}"] for label in ("nominal@0", "e2@2")]
    assert first["metrics"]["progress"] == pytest.approx(sum(both) / 2)
    assert not any(
        trial["admissible"] for trial in others if trial["parameters"]["gain"] < 0.5
    )
    assert len(built) >= 3 * 2
    assert not torch.allclose(built[0], built[-1])


def test_contacts_with_anybody_and_leaving_the_road_count_as_collisions():
    quiet = {
        "cfr": 0.0,
        "cfr_vru": 0.0,
        "ego_off_road": math.nan,
        "macc": 1.0,
        "progress": 50.0,
    }
    rows = [
        quiet,
        quiet | {"cfr": 1.0},
        quiet | {"cfr_vru": 1.0, "macc": math.nan},
        quiet | {"ego_off_road": 1.0},
    ]
    rows.append(quiet | {"cfr": 1.0, "ego_off_road": 1.0, "macc": 3.0, "progress": 0.0})
    assert driving(rows) == {"collision": 0.8, "comfort": 1.5, "progress": 40.0}
    assert all(map(math.isnan, driving([]).values()))


class Stumbles(Cruise):
    """Raises in scenes whose ego starts beyond 50 m."""

    def plan(self, world):
        if bool(((world.states[:, 0, 0] > 50) & (world.step == 0)).any()):
            raise ValueError("it stumbles")
        return super().plan(world)


class Loses(NominalTraffic):
    """Raises in scenes whose ego starts before -50 m."""

    def replan(self, state, world, ego_plan, react=None):
        if bool((world.states[:, 0, 0] < -50).any()):
            raise ValueError("it is lost")
        return super().replan(state, world, ego_plan, react)


@pytest.fixture(scope="module")
def stumbling():
    """Five scenes: the planner raises in the first, the traffic in the next two."""
    scene_set = scenes(5, steps=20)
    for name in ("start", "logged"):
        scene_set.scenes[name][0, ..., 0] += 100.0
        scene_set.scenes[name][1:3, ..., 0] -= 100.0
    return Setup(scene_set, Stumbles(), ego_name="stumbles", sim=SimSettings(), batch=5)


def test_a_planner_s_trial_counts_what_it_raised_itself(stumbling):
    """One of the three that the traffic did not lose."""
    methods = [Method("nominal", Loses(small_prior(0), "plan"))]
    metrics = PlannerTrials(
        stumbling, methods, seeds=[0], make=lambda parameters: Stumbles()
    )({})
    assert metrics["errored"] == pytest.approx(1 / 3)
    assert metrics["errored: raised ValueError"] == 3 / 5
    assert metrics["progress"] > 7, "of the two that were driven"


def test_an_attack_s_trial_counts_what_its_traffic_lost_and_what_the_planner_raised_as_failed(
    stumbling,
):
    nominal = Method("nominal", NominalTraffic(small_prior(0), "plan"))
    trials = AttackTrials(
        stumbling,
        nominal,
        eta=2.0,
        seeds=[0],
        make=lambda parameters: Loses(small_prior(0), "plan"),
    )
    metrics = trials({})
    assert metrics["errored"] == pytest.approx(2 / 5)
    assert metrics["errored nominal"] == 0
    (row,) = run_protocol(
        stumbling, [Method("same", trials.make({}), eta=2.0)], seeds=[0]
    )
    for name in SOUGHT:
        assert metrics[name] == pytest.approx(row["metrics"][name]["mean"])
        assert metrics[name] >= 1 / 3
        assert metrics[f"{name} nominal"] >= 1 / 5


def attack(parameters):
    """More gain finds more failures, leaves the road more often (1 point a unit, 0.2
    nominal) and is less real."""
    gain = parameters["gain"]
    result = dict.fromkeys(MEASURED, 0.0) | {
        "cfr": gain / 10,
        "cfr_counted": gain / 20,
        "real_adv": 1 - gain / 10,
    }
    nominal = {f"{name} nominal": 0.0 for name in MEASURED} | {
        "aor_step nominal": 0.002
    }
    return result | {"aor_step": 0.01 * gain + 0.002} | nominal


def test_the_limits_of_an_attack_belong_to_it():
    metrics = attack({"gain": 3.0})
    assert AttackObjective(off_road=0.031).judge(metrics, {})[1] == 0
    assert AttackObjective(off_road=0.01).judge(metrics, {})[1] == pytest.approx(0.02)
    assert AttackObjective(off_road=0.01).judge(
        metrics | {"aor_step nominal": 0.022}, {}
    )[1] == pytest.approx(0)
    wide = AttackObjective(off_road=1.0)
    assert wide.judge(metrics | {"errored": 0.035, "errored nominal": 0.025}, {})[
        1
    ] == pytest.approx(0)
    assert wide.judge(metrics | {"errored": 0.045, "errored nominal": 0.025}, {})[
        1
    ] == pytest.approx(0.01)
    assert AttackObjective(realism=0.9, off_road=1.0).judge(metrics, {})[
        1
    ] == pytest.approx(0.2)
    assert (
        AttackObjective(realism=0.9, off_road=1.0).judge(
            metrics | {"real_adv": math.nan}, {}
        )[1]
        == 0
    )
    assert math.isinf(
        AttackObjective().judge(metrics | {"cfr_preventable": math.nan}, {})[1]
    )
    assert [
        AttackObjective(seek).judge(metrics, {})[0] for seek in SOUGHT
    ] == pytest.approx([0.0, 0.0, -0.15, -0.3])


@pytest.fixture(scope="module")
def trials():
    """Real rollouts of a dense attack on a small random prior."""
    prior = small_prior(0)
    setup = Setup(scenes(2, steps=10), EGO, ego_name="idm", sim=SimSettings(), batch=4)
    nominal = Method("nominal", NominalTraffic(prior, "plan"))
    make = lambda own: CTGAdv(prior, samples=2, **own)  # noqa: E731
    return AttackTrials(setup, nominal, eta=2.0, seeds=[0, 1], make=make)


def test_a_trial_is_measured_as_the_protocol_measures_the_method(trials):
    result = trials({"gain": 0.5})
    (row,) = run_protocol(
        trials.setup,
        [Method("same", trials.make({"gain": 0.5}), eta=2.0)],
        seeds=trials.seeds,
    )
    for name in MEASURED:
        assert result[name] == pytest.approx(row["metrics"][name]["mean"], nan_ok=True)
    for name in SOUGHT:
        assert result[f"{name}_high"] == pytest.approx(
            row["metrics"][name]["high"], nan_ok=True
        )
    quiet = trials({"gain": 0.0})
    for name in ("cfr", "aor_step", "cfr_bg", "real"):
        assert quiet[name] == pytest.approx(quiet[f"{name} nominal"], nan_ok=True), (
            "of the same knowledge of the ego"
        )


@pytest.mark.parametrize("name", ATTACKS)
def test_every_attack_has_ranges_round_its_present_values(name):
    """Its first parameter is the gain; a trial of the present parameters is the method
    of conf/synthesizer."""
    group = load_choice("synthesizer", name)
    present = flat(resolved(group))
    ranges = build_traffic(group, small_prior(0)).tuned
    assert ranges
    assert all(
        low <= present[parameter] <= high
        for parameter, (low, high, *_) in ranges.items()
    )
    assert (
        with_changes(
            group,
            {parameter: present[parameter] for parameter in ranges},
            where="",
            group="",
        )
        == group
    )
