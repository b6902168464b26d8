"""From a configuration to methods, and what a run that cannot be is told."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from e2rl.evaluation.build import BASELINES, build_methods, build_sim, caption, check_protocol
from e2rl.synthesizer.synthesizer import Synthesizer
from hydra import compose, initialize_config_dir

from e2rl.errors import InputError
from tests.prior.small import small_prior

CONF = str(Path(__file__).parents[2] / "conf")


def config_of(*overrides):
    with initialize_config_dir(CONF, version_base="1.3"):
        return compose("evaluate", list(overrides))


def methods_of(*overrides):
    config = config_of(*overrides)
    check_protocol(config)
    return build_methods(config, small_prior())


def named(methods):
    return [(method.name, method.eta) for method in methods]


def test_the_prior_stands_beside_the_baselines_with_the_ego_replayed():
    config = config_of("experiment=prior")
    check_protocol(config)
    methods = build_methods(config, small_prior())
    assert named(methods) == [("replay", 0), ("constant_velocity", 0), ("idm", 0), ("nominal", 0)]
    assert [isinstance(method.synthesizer, Baseline) for method in methods] == [True, True, True, False]
    assert config.open_loop_samples > 0 and config.meta_rollouts > 0 and build_sim(config).replay_ego
    assert config.metrics == "traffic"


def test_by_default_the_prior_stands_beside_its_control():
    methods = methods_of("eta=1.5")
    assert named(methods) == [("nominal", 0), ("e2", 1.5)] and not build_sim(config_of()).replay_ego
    assert methods[0].synthesizer is methods[1].synthesizer


def test_a_name_twice_is_one_row_and_rows_keep_their_order():
    assert named(methods_of("methods=[idm,nominal,idm]")) == [("idm", 0), ("nominal", 0)]


@pytest.mark.parametrize("name", list(BASELINES))
def test_a_baseline_as_synthesizer_is_a_row_that_eta_does_not_touch_beside_the_prior(name):
    methods = methods_of(f"synthesizer={name}", "eta=2")
    assert named(methods) == [("nominal", 0), (name, 0)]
    assert isinstance(methods[0].synthesizer, Synthesizer) and isinstance(methods[1].synthesizer, Baseline)


def test_idm_is_under_the_prior_s_own_bounds():
    prior = small_prior()
    methods = build_methods(config_of("methods=[idm]"), prior)
    assert methods[0].synthesizer.bounds is prior.bounds


def test_variants_are_rows_of_the_prior_with_what_they_change_and_nothing_else():
    config = config_of(
        "methods=[]",
        "eta=0",
        "+variants.cold={prior: {sampler: {temperature: 0.5}}}",
        "+variants.free={prior.bounds.meeting: false}",
    )
    check_protocol(config)
    methods = build_methods(config, small_prior())
    assert named(methods) == [("cold", 0), ("free", 0)]
    cold, free = (method.synthesizer.prior for method in methods)
    assert cold.sampler == replace(free.sampler, temperature=0.5) and free.bounds == replace(cold.bounds, meeting=False)
    assert all(torch.equal(*pair) for pair in zip(cold.parameters(), free.parameters(), strict=True))


def test_variants_of_the_control_share_the_prior_and_differ_in_what_they_name():
    config = config_of(
        "methods=[far,e2]",
        "eta=1",
        "+variants.far={synthesizer: {skeleton: {far: 2}, reselect: 0}}",
        "+variants.near={synthesizer.skeleton.far: 0}",
        "+variants.same={}",
    )
    check_protocol(config)
    prior = small_prior()
    methods = build_methods(config, prior)
    assert named(methods) == [("far", 1), ("e2", 1), ("near", 1), ("same", 1)], "methods orders, variants follow"
    far, e2, near, same = (method.synthesizer.settings for method in methods)
    assert all(method.synthesizer.prior is prior for method in methods) and same == e2
    assert far == replace(e2, skeleton=replace(e2.skeleton, far=2), reselect=0)
    assert near == replace(e2, skeleton=replace(e2.skeleton, far=0))


def test_several_intensities_are_a_row_each_but_of_what_knows_none():
    config = config_of("methods=[nominal,idm,e2]", "eta=[1,0,1,2.5]", "+variants.near={synthesizer.skeleton.far: 0}")
    check_protocol(config)
    assert named(build_methods(config, small_prior())) == [
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
    ("experiment", "rows"), [("prior_ablation", 15), ("table2", 4), ("table3", 13), ("intensity", 4), ("skeleton", 1)]
)
def test_every_row_of_an_experiment_can_be_built_and_tells_its_changes(experiment, rows):
    config = config_of(f"experiment={experiment}")
    check_protocol(config)
    methods = build_methods(config, small_prior())
    assert len(methods) == rows and len({(method.name, method.eta) for method in methods}) == rows
    settings = [
        (method.synthesizer.settings, method.synthesizer.prior.sampler, method.synthesizer.prior.bounds)
        for method in methods
        if method.name in config.variants
    ]
    assert all(settings.count(each) == 1 for each in settings), "no two variants are the same"
    assert all(name in caption(config, {}) for name in config.variants)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ["methods=[e3]"],
            r"methods=\['e3'\]: e3 is none of nominal, replay, constant_velocity, idm, e2; .*synthesizer=",
        ),
        (["methods=[e2]", "synthesizer=nominal"], "e2 is none of nominal, replay, constant_velocity, idm;"),
        (["methods=[]"], r"methods=\[\], seeds=\[0, 1\]: name at least one of each"),
        (["seeds=[]"], r"seeds=\[\]: name at least one"),
        (["seeds=[0.5]"], r"seeds=\[0.5\]: sampling seeds are whole numbers"),
        (["+variants.idm={prior.sampler.steps: 4}"], "variants.idm: idm is a row already"),
        (["+variants.other={training: {steps: 4}}"], "variants.other: training is none of prior, synthesizer"),
        (["+variants.other={synthesizer.contrl.feasibility: 0}"], "variants.other: .*'contrl' .*compare it with conf/"),
        (["+variants.other={synthesizer: {control: {depth: 0}}}"], "variants.other: .*'depth' .*compare it with conf/"),
        (["+variants.other=4"], "variants.other=4: expected changes"),
        (["eta=[]"], r"eta=\[\]: the intensity"),
        (["eta=[1,-1]"], r"eta=\[1, -1\]: the intensity"),
        (["figure=pie"], "figure=pie: choose one of intensity, skeleton, or null"),
        (["figure=intensity"], "figure=intensity, eta=2.0: name several"),
        (["figure=skeleton", "save_rollouts=false"], "figure=skeleton: .*save_rollouts=true"),
        (["open_loop_samples=-1"], "open_loop_samples=-1: expected a whole number of at least 0"),
        (["open_loop_samples=many"], "open_loop_samples=many: expected a whole number"),
        (["meta_rollouts=1.5"], "meta_rollouts=1.5: expected a whole number"),
        (["metrics=all"], "metrics=all: choose one of main, traffic, adversaries"),
        (["eta=-0.1"], "eta=-0.1: the intensity is a number of at least 0"),
        (["eta=.nan"], "eta=.nan: the intensity"),
        (["num_scenes=0"], "num_scenes=0: a whole number of at least 1, or null"),
    ],
)
def test_what_cannot_run_is_named_with_its_remedy(overrides, message):
    with pytest.raises(InputError, match=message):
        check_protocol(config_of(*overrides))


def test_a_variant_of_impossible_temperature_says_so():
    with pytest.raises(InputError, match="temperature=-1"):
        methods_of("+variants.cold={prior.sampler.temperature: -1}")
