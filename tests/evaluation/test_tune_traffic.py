"""Tuning an adversary: the budget that refuses trials, what a trial is measured by, and a small real run."""

import json
import math

import pytest
from omegaconf import OmegaConf

from e2rl.evaluation.protocol import Method, Setup, run_protocol
from e2rl.evaluation.tune_traffic import MEASURED, SOUGHT, AttackObjective, AttackTrials
from e2rl.evaluation.tuning import TuneSettings, tune
from e2rl.evaluation.tuning_run import changed, flat, run_tuning, tuning_of
from e2rl.run import config as build_config
from e2rl.run.errors import InputError
from e2rl.sim.env import SimSettings
from e2rl.traffic.baselines.ctg import CTGAdv
from e2rl.traffic.nominal import NominalTraffic
from tests.prior.small import small_prior
from tests.traffic.e2.traffic_scenes import EGO, scenes

ATTACKS = ("e2", "e2_unbound", "e2_pursuit", "ctg_adv", "safe_sim_opt", "ccdiff", "diffscene", "cat", "strive")


def attack(parameters):
    """More gain finds more failures, leaves the road more often (1 point a unit, 0.2 nominal) and is less real."""
    gain = parameters["gain"]
    found = dict.fromkeys(MEASURED, 0.0) | {
        "cfr": gain / 10,
        "aor_step": 0.01 * gain + 0.002,
        "real_adv": 1 - gain / 10,
    }
    return (
        found | {"cfr_counted": gain / 20} | {f"{name} nominal": 0.0 for name in MEASURED} | {"aor_step nominal": 0.002}
    )


def best_gain(folder, **limits):
    settings = TuneSettings(trials=30, startup=10, ladder=9)
    present, space = {"gain": 0.1, "step_size": 1.0}, {"gain": [0.1, 8.0, "log"]}
    result = tune(attack, present, space, settings, AttackObjective(**limits), folder, say=lambda line: None)
    assert all(
        trial["admissible"] == (trial["parameters"]["gain"] <= result["best"]["gain"]) for trial in result["trials"]
    )
    return result["best"]["gain"]


def test_the_most_failures_within_the_budget_are_kept(tmp_path):
    """Failures and the price both rise with the gain: the best trial is the largest gain that the limits allow."""
    assert 2.0 < best_gain(tmp_path, off_road=0.03) <= 3.0
    assert best_gain(tmp_path, off_road=1.0) == pytest.approx(8.0)
    assert 1.4 < best_gain(tmp_path, off_road=0.03, realism=0.8) <= 2.0


def test_the_budget_is_above_nominal_traffic_and_its_bound_belongs_to_it():
    metrics = attack({"gain": 3.0})
    _, excess = AttackObjective(off_road=0.031).judge(metrics, {})
    assert excess == 0
    _, excess = AttackObjective(off_road=0.01).judge(metrics, {})
    assert excess == pytest.approx(0.02)
    _, excess = AttackObjective(off_road=0.01).judge(metrics | {"aor_step nominal": 0.022}, {})
    assert excess == pytest.approx(0)


def test_what_is_sought_is_maximised():
    metrics = attack({"gain": 2.0})
    assert [AttackObjective(seek).judge(metrics, {})[0] for seek in SOUGHT] == pytest.approx([-0.2, -0.1, 0.0])
    with pytest.raises(InputError, match=r"tuning.objective.seek=real: choose one of"):
        AttackObjective("real")
    with pytest.raises(InputError, match=r"tuning.objective.off_road=2"):
        AttackObjective(off_road=2)


def test_without_an_adversary_there_is_no_realism_to_miss_but_unknown_failures_stop():
    metrics = attack({"gain": 0.0}) | {"real_adv": math.nan}
    assert AttackObjective(realism=0.9).judge(metrics, {})[1] == 0
    assert math.isinf(AttackObjective().judge(metrics | {"cfr": math.nan}, {})[1])


@pytest.fixture(scope="module")
def trials():
    """Real rollouts of a dense attack on a small random prior."""
    prior = small_prior(0)
    setup = Setup(scenes(2, steps=20), EGO, "idm", SimSettings(), batch=4)
    return AttackTrials(
        setup,
        Method("nominal", NominalTraffic(prior, "plan")),
        2.0,
        [0, 1],
        lambda own: CTGAdv(prior, samples=2, **own),
    )


def test_a_trial_is_measured_as_the_protocol_measures_the_method(trials):
    found = trials({"gain": 0.5})
    (row,) = run_protocol(trials.setup, [Method("same", trials.make({"gain": 0.5}), 2.0)], trials.seeds)
    for name in MEASURED:
        assert found[name] == pytest.approx(row["metrics"][name]["mean"], nan_ok=True)
    for name in SOUGHT:
        assert found[f"{name}_high"] == pytest.approx(row["metrics"][name]["high"], nan_ok=True)


def test_at_no_gain_a_trial_is_nominal_traffic(trials):
    """Of the same knowledge of the ego."""
    found = trials({"gain": 0.0})
    for name in ("cfr", "aor_step", "cfr_bg", "real"):
        assert found[name] == pytest.approx(found[f"{name} nominal"], nan_ok=True)


def test_rollouts_without_a_score_are_counted_and_only_their_whole_stops_the_tuning(trials, capsys):
    class Broken(type(EGO)):
        def plan(self, world):
            if (world.scene["scene_index"] >= first).any():
                raise RuntimeError("lost")
            return super().plan(world)

    setup = Setup(trials.setup.scenes, Broken(), "broken", SimSettings(), batch=4)
    attack, first = AttackTrials(setup, trials.nominal, 2.0, [0, 1], trials.make), 1
    found = attack({"gain": 0.5})
    assert found["ended"] == found["ended nominal"] == 0.5
    assert "2 rollouts ended without a score: 2 raised RuntimeError (lost)" in capsys.readouterr().err
    first = 0
    with pytest.raises(InputError, match=r"no rollout could be scored: 4 raised RuntimeError"):
        AttackTrials(setup, trials.nominal, 2.0, [0, 1], trials.make)({"gain": 0.5})


def test_a_trial_that_loses_more_rollouts_than_nominal_traffic_is_refused():
    metrics = attack({"gain": 1.0}) | {"ended": 0.03, "ended nominal": 0.025}
    assert AttackObjective(off_road=1.0).judge(metrics, {})[1] == 0
    assert AttackObjective(off_road=1.0).judge(metrics | {"ended": 0.045}, {})[1] == pytest.approx(0.01)


def test_every_attack_has_a_range_round_its_present_values():
    """Its first parameter is the gain; a trial of the present parameters is the method of conf/synthesizer."""
    spaces = OmegaConf.load(build_config.conf_folder() / "experiment" / "tune.yaml").tuning.spaces
    assert set(spaces) == set(ATTACKS)
    for name in ATTACKS:
        group = build_config.load_choice("synthesizer", name)
        present = flat(OmegaConf.to_container(group))
        for parameter, (low, high, *_) in spaces[name].items():
            assert low <= present[parameter] <= high, f"{name}.{parameter}"
        assert changed(group, {parameter: present[parameter] for parameter in spaces[name]}) == group


def config_of(*overrides):
    config = build_config.load_config("evaluate", ["seeds=[0]", "processes=1", "methods=[nominal]", *overrides])
    tuning = {"group": "synthesizer", "trials": 2, "startup": 1, "seed": 0, "ladder": 1, "space": {"gain": [0.0, 1.0]}}
    config.tuning = OmegaConf.create(tuning)
    return config


def tuned(config, *run):
    return run_tuning(config, tuning_of(config), *run)


def test_the_configuration_builds_the_adversary_under_trial(trials, tmp_path, capsys):
    run = (trials.setup, [trials.nominal], trials.nominal.traffic.prior, tmp_path)
    config = config_of("synthesizer=ctg_adv", "synthesizer.samples=2")
    result = tuned(config, *run)
    assert [trial["parameters"]["gain"] for trial in result["trials"]] == [0.5, 0.0]
    said = capsys.readouterr().out
    assert "for conf/synthesizer:\ngain: " in said and json.loads((tmp_path / "tuning.json").read_text())["best"]
    for wrong, what in ((["eta=[1,2]"], "at one eta above 0"), (["eta=0"], "at one eta above 0")):
        with pytest.raises(InputError, match=what):
            tuned(config_of("synthesizer=ctg_adv", *wrong), *run)
    with pytest.raises(InputError, match="against one row"):
        tuned(config, trials.setup, [trials.nominal] * 2, *run[2:])
    with pytest.raises(InputError, match="synthesizer=ctg: no adversary"):
        tuned(config_of("synthesizer=ctg"), *run)
