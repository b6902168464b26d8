"""From a configuration to methods and egos, outside classes included, and what a run that cannot be is told."""

from dataclasses import replace

import pytest
import torch

from e2rl.evaluation import methods as build_objects
from e2rl.planners.ego import Ego
from e2rl.run import config as build_config
from e2rl.run.errors import InputError
from e2rl.traffic.baselines.ctg import CTGAdv
from e2rl.traffic.e2.e2 import E2
from e2rl.traffic.nominal import NominalTraffic
from e2rl.traffic.rule_based import IDM
from e2rl.traffic.traffic import Traffic, keep_velocity
from tests.prior.small import small_prior

HERE = __name__  # where `_target_` finds the classes below


class Outside(Traffic):
    """A method of somebody else: no adversary, needs a setting, takes the prior or leaves it."""

    stochastic = False

    def __init__(self, prior=None, *, braking):
        self.braking = braking

    def replan(self, state, world, ego_plan):
        raise NotImplementedError


class Refusing(Outside):
    def __init__(self, prior=None, braking=None):
        raise InputError(f"braking={braking}: too weak")


class Unfinished(Traffic):
    """It has no `replan`."""


class Cruise(Ego):
    def plan(self, world):
        return keep_velocity(world.states[:, 0])


def config_of(*overrides):
    return build_config.load_config("evaluate", overrides)


def methods_of(*overrides, prior=None):
    config = config_of(*overrides)
    build_objects.check_evaluation(config)
    return build_objects.build_methods(config, prior or small_prior())


def named(methods):
    return [(method.name, method.eta) for method in methods]


def test_the_prior_stands_beside_the_baselines_with_the_ego_replayed():
    config, methods = config_of("experiment=prior"), methods_of("experiment=prior")
    assert named(methods) == [("replay", 0), ("constant_velocity", 0), ("idm", 0), ("nominal", 0)]
    assert [method.traffic.stochastic for method in methods] == [False, False, False, True]
    assert config.open_loop_samples > 0 and config.meta_rollouts > 0 and build_objects.build_ego(config).replays_log
    assert config.metrics == "traffic"


def test_by_default_the_prior_stands_beside_its_control_on_the_same_weights():
    methods = methods_of("eta=1.5")
    assert named(methods) == [("nominal", 0), ("e2", 1.5)] and not build_objects.build_ego(config_of()).replays_log
    assert [type(method.traffic) for method in methods] == [NominalTraffic, E2]
    assert methods[0].traffic.prior is methods[1].traffic.prior


def test_a_name_twice_is_one_row_and_rows_keep_their_order():
    assert named(methods_of("methods=[idm,nominal,idm]")) == [("idm", 0), ("nominal", 0)]


@pytest.mark.parametrize("name", ["replay", "constant_velocity", "idm"])
def test_a_baseline_as_synthesizer_is_a_row_that_eta_does_not_touch_beside_the_prior(name):
    methods = methods_of(f"synthesizer={name}", "eta=2")
    assert named(methods) == [("nominal", 0), (name, 0)]
    assert isinstance(methods[0].traffic, NominalTraffic) and not methods[1].traffic.adversarial


def test_idm_is_under_the_prior_s_own_bounds():
    prior = small_prior()
    [method] = methods_of("methods=[idm]", prior=prior)
    assert isinstance(method.traffic, IDM) and method.traffic.bounds is prior.bounds


def test_the_synthesizer_s_own_row_has_its_overrides_and_a_row_of_another_name_the_settings_of_its_file():
    [own] = methods_of("methods=[e2]", "synthesizer.reselect=7")
    assert own.traffic.reselect == 7
    [other] = methods_of("methods=[e2]", "synthesizer=nominal")
    assert other.traffic.reselect == config_of().synthesizer.reselect


def test_variants_are_rows_of_the_prior_with_what_they_change_and_nothing_else():
    cold, free = methods_of(
        "methods=[]",
        "eta=0",
        "+variants.cold={prior: {sampler: {temperature: 0.5}}}",
        "+variants.free={prior.bounds.meeting: false}",
    )
    assert named([cold, free]) == [("cold", 0), ("free", 0)]
    cold, free = cold.traffic.prior, free.traffic.prior
    assert cold.sampler == replace(free.sampler, temperature=0.5) and free.bounds == replace(cold.bounds, meeting=False)
    assert all(torch.equal(*pair) for pair in zip(cold.parameters(), free.parameters(), strict=True))


def test_variants_of_the_control_share_the_prior_and_differ_in_what_they_name():
    prior = small_prior()
    methods = methods_of(
        "methods=[far,e2]",
        "eta=1",
        "+variants.far={synthesizer: {skeleton: {far: 2}, reselect: 0}}",
        "+variants.near={synthesizer.skeleton.far: 0}",
        "+variants.same={}",
        prior=prior,
    )
    assert named(methods) == [("far", 1), ("e2", 1), ("near", 1), ("same", 1)], "methods orders, variants follow"
    far, e2, near, same = (method.traffic for method in methods)
    assert all(method.traffic.prior is prior for method in methods)
    assert same.settings == e2.settings and same.reselect == e2.reselect
    assert far.settings == e2.settings | {"skeleton": replace(e2.skeleton, far=2)} and far.reselect == 0
    assert near.settings == e2.settings | {"skeleton": replace(e2.skeleton, far=0)} and near.reselect == e2.reselect


def test_several_intensities_are_a_row_each_but_of_what_knows_none():
    methods = methods_of("methods=[nominal,idm,e2]", "eta=[1,0,1,2.5]", "+variants.near={synthesizer.skeleton.far: 0}")
    assert named(methods) == [
        ("nominal", 0),
        ("idm", 0),
        ("e2", 1),
        ("e2", 0),
        ("e2", 2.5),
        ("near", 1),
        ("near", 0),
        ("near", 2.5),
    ]


@pytest.mark.parametrize(
    ("experiment", "rows"), [("prior_ablation", 15), ("table2", 5), ("table3", 16), ("intensity", 4), ("skeleton", 1)]
)
def test_every_row_of_an_experiment_can_be_built_and_tells_its_changes(experiment, rows):
    config, methods = config_of(f"experiment={experiment}"), methods_of(f"experiment={experiment}")
    assert len(methods) == rows and len(set(named(methods))) == rows
    variants = [method.traffic for method in methods if method.name in config.variants]
    own = [(on.support, on.reselect, on.knowledge, on.responsibility, on.settings) for on in variants]
    settings = [(*each, on.prior.sampler, on.prior.bounds) for each, on in zip(own, variants, strict=True)]
    assert all(settings.count(each) == 1 for each in settings), "no two variants are the same"
    assert all(name in build_objects.caption(config, {}) for name in config.variants)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["methods=[e3]"], "synthesizer=e3: none of cat, ccdiff, constant_velocity, ctg, .*, strive; add a f"),
        (["methods=[]"], r"methods=\[\]: expected a list of at least one"),
        (["seeds=[]"], r"seeds=\[\]: expected a list of whole numbers"),
        (["seeds=[0.5]"], r"seeds=\[0.5\]: expected a list of whole numbers"),
        (["+variants.other={training: {steps: 4}}"], "variants.other: training is none of prior, synthesizer"),
        (["+variants.other={synthesizer.contrl.feasibility: 0}"], "variants.other: .*'contrl' .*compare it with conf/"),
        (["+variants.other={synthesizer: {control: {depth: 0}}}"], "variants.other: .*'depth' .*compare it with conf/"),
        (["+variants.idm={prior.sampler.steps: 4}"], "variants.idm: idm is a row already"),
        (["+variants.other=4"], "variants.other=4: expected changes"),
        (["eta=[]"], r"eta=\[\]: the intensity"),
        (["eta=[1,-1]"], r"eta=\[1, -1\]: the intensity"),
        (["eta=-0.1"], "eta=-0.1: the intensity is a number of at least 0"),
        (["eta=.nan"], "eta=.nan: the intensity"),
        (["figure=pie"], "figure=pie: choose one of intensity, skeleton"),
        (["figure=intensity"], "figure=intensity, eta=2.0: name several"),
        (["figure=curves"], "figure=curves, eta=2.0: name several"),
        (["figure=curves", "eta=[1,2]", "+egos.one={ego: idm}"], "figure=curves: of one ego"),
        (["figure=skeleton", "save_rollouts=false"], "figure=skeleton: .*save_rollouts=true"),
        (["open_loop_samples=-1"], "open_loop_samples=-1: expected a whole number of at least 0"),
        (["open_loop_samples=many"], "open_loop_samples=many: expected a whole number"),
        (["meta_rollouts=1.5"], "meta_rollouts=1.5: expected a whole number"),
        (["metrics=all"], "metrics=all: choose one of main, traffic, adversaries"),
        (["num_scenes=0"], "num_scenes=0: expected a whole number of at least 1"),
        (["processes=0"], "processes=0: expected a whole number of at least 1"),
        (["processes=2", "threads=2"], "processes=2, threads=2, device=cpu, .*: .*processes=1"),
        (["launcher=ray", "threads=2"], "threads=2, device=cpu, launcher=ray: .*launcher=processes"),
        (["launcher=grid"], "launcher=grid: choose one of processes, ray"),
        (["share=2"], r"share=2: expected \[k, n\]"),
        (["share=[4,4]"], r"share=\[4, 4\]: expected \[k, n\] with k from 0 to n - 1"),
        (["share=[0,1.5]"], r"share=\[0, 1.5\]: expected"),
        (["share=[0,2]", "figure=skeleton"], "share=.*run as a whole; leave share out"),
    ],
)
def test_what_cannot_run_is_named_with_its_remedy(overrides, message):
    with pytest.raises(InputError, match=message):
        build_objects.check_evaluation(config_of(*overrides))


def test_the_skeleton_figure_and_a_shared_device_keep_to_one_process():
    assert build_objects.processes_of(config_of("figure=skeleton", "processes=3")) == 1
    assert build_objects.processes_of(config_of("figure=skeleton", "launcher=ray")) == 1
    assert (
        build_objects.processes_of(config_of("device=cuda")) == build_objects.processes_of(config_of("threads=2")) == 1
    )


def test_a_variant_of_impossible_temperature_says_so():
    with pytest.raises(InputError, match="temperature=-1"):
        methods_of("+variants.cold={prior.sampler.temperature: -1}")


def test_a_choice_is_its_file_and_an_unknown_one_lists_those_there_are():
    assert build_config.load_choice("synthesizer", "e2") == config_of("synthesizer=e2").synthesizer
    names = "actor, bits, external, idm, lane_graph, lane_graph_tuned, policy_file, replay, sampling"
    with pytest.raises(InputError, match=f"ego=taxi: none of {names}; add"):
        build_config.load_choice("ego", "taxi")


def test_classes_from_outside_are_built_from_their_settings_alone():
    config = config_of("synthesizer=replay", f"synthesizer._target_={HERE}.Outside", "+synthesizer.braking=3")
    traffic = build_objects.build_traffic(config.synthesizer, small_prior())
    assert isinstance(traffic, Outside) and traffic.braking == 3
    ego = build_objects.build_ego(config_of("ego=idm", "~ego", f"+ego._target_={HERE}.Cruise", "+ego.replan_every=2"))
    assert isinstance(ego, Cruise) and ego.replan_every == 2


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["_target_=no.such.Method"], "(?s)synthesizer=no.such.Method: cannot be built: .*conf/synthesizer"),
        ([f"_target_={HERE}.Missing"], f"synthesizer={HERE}.Missing: cannot be built: "),
        ([f"_target_={HERE}.Unfinished"], "Unfinished: cannot be built: .*abstract"),
        ([f"_target_={HERE}.Outside"], "Outside: cannot be built: .*'braking'"),
        ([f"_target_={HERE}.Outside", "braking=1", "speed=3"], "Outside: cannot be built: .*'speed'"),
        ([f"_target_={HERE}.Cruise"], "Cruise: cannot be built: .*'prior'"),
        (["_target_=builtins.dict"], "synthesizer=builtins.dict: is no e2rl.traffic.traffic.Traffic; subclass it"),
        ([f"_target_={HERE}.Refusing", "braking=1"], "^braking=1: too weak"),
    ],
)
def test_a_class_that_cannot_be_built_is_named_with_the_reason(overrides, message):
    changes = [f"++synthesizer.{override}" for override in overrides]
    config = config_of("synthesizer=replay", *changes)
    with pytest.raises(InputError, match=message):
        build_objects.build_traffic(config.synthesizer, small_prior())


def test_an_ego_that_is_none_is_refused():
    with pytest.raises(InputError, match="ego=torch.nn.ReLU: is no e2rl.planners.ego.Ego; subclass it"):
        build_objects.build_ego(config_of("ego=idm", "~ego", "+ego._target_=torch.nn.ReLU"))


def test_a_variant_may_be_one_of_another_method():
    rows = methods_of(
        "methods=[nominal]",
        "+variants.blind={synthesizer: ctg_adv, synthesizer.knowledge: predicted, synthesizer.responsibility: full}",
    )
    assert named(rows) == [("nominal", 0.0), ("blind", 2.0)]
    assert isinstance(rows[1].traffic, CTGAdv) and rows[1].traffic.responsibility == "full"
    assert build_objects.terms_by_method(rows) == {"nominal": ("predicted", ""), "blind": ("predicted", "full")}
    with pytest.raises(InputError, match="synthesizer=nobody"):
        methods_of("+variants.blind={synthesizer: nobody}")


def test_table_1_has_every_rival_on_both_terms():
    rows = methods_of("experiment=table1")
    rivals = {"ctg", "ctg_adv", "strive", "safe_sim_opt", "diffscene", "ccdiff", "cat"}
    known = build_objects.terms_by_method(rows)
    assert rivals <= set(known) and all(known[name][0] == "plan" for name in rivals)
    assert known["e2_pursuit"] == ("plan", "none")  # the rivals' terms
    ours = build_objects.terms_by_method(methods_of("experiment=table1_our_terms"))
    for name in rivals:
        assert ours[f"{name}, our terms"] == ("predicted", "" if name == "ctg" else "full")
    assert ours["e2_pursuit, our terms"] == ours["e2"] == ("predicted", "full")


@pytest.mark.parametrize(
    "more",
    [
        ["compare=ctg"],
        ["compare=[e2,ctg]"],
        ["compare=[]"],
        ["compare=e2", "eta=[1,2]"],
        ["compare=e2", "+egos.a={ego: idm}"],
    ],
)
def test_a_table_of_methods_needs_its_reference_and_one_eta_and_ego(more):
    with pytest.raises(InputError, match="compare="):
        methods_of(*more)
