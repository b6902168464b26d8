"""From a configuration to methods, and what a run that cannot be is told."""

from dataclasses import fields, replace

import pytest

from e2rl.evaluation.build import build_methods
from e2rl.evaluation.check import evaluation_settings, processes_of
from e2rl.report.caption import caption, terms_by_method
from e2rl.run.config import load_config
from e2rl.run.errors import InputError
from e2rl.traffic.baselines.ctg import CTGAdv
from e2rl.traffic.e2.e2 import E2
from e2rl.traffic.nominal import NominalTraffic
from e2rl.traffic.rule_based import IDM
from tests.prior.small import small_prior


def config_of(overrides=()):
    return load_config("evaluate", list(overrides))


def methods_of(overrides=(), prior=None):
    config = config_of(overrides)
    evaluation_settings(config)
    return build_methods(config, prior or small_prior())


def settings_in(traffic):
    """The settings of a method, the prior apart."""
    return {
        item.name: getattr(traffic, item.name)
        for item in fields(traffic)
        if item.name != "prior"
    }


def named(methods):
    return [(method.name, method.eta) for method in methods]


def test_a_name_twice_is_one_row_and_rows_keep_their_order_on_the_same_weights():
    prior = small_prior()
    methods = methods_of(["methods=[idm,nominal,e2,idm]", "eta=1.5"], prior=prior)
    assert named(methods) == [("idm", 0), ("nominal", 0), ("e2", 1.5)], (
        "eta does not touch what knows none"
    )
    assert [type(method.traffic) for method in methods] == [IDM, NominalTraffic, E2]
    assert methods[1].traffic.prior is methods[2].traffic.prior is prior
    assert methods[0].traffic.bounds is prior.bounds, (
        "IDM is under the prior's own bounds"
    )


def test_variants_share_the_prior_but_for_what_they_change_and_differ_in_nothing_else():
    prior = small_prior()
    methods = methods_of(
        [
            "methods=[far,e2]",
            "eta=1",
            "+variants.far={synthesizer: {skeleton: {far: 2}, reselect: 0}}",
            "+variants.same={}",
            "+variants.blind={synthesizer: ctg_adv, synthesizer.knowledge: predicted, "
            "synthesizer.responsibility: full}",
            "+variants.cold={prior.sampler.temperature: 0.5}",
        ],
        prior=prior,
    )
    assert named(methods) == [
        (name, 1) for name in ("far", "e2", "same", "blind", "cold")
    ], "methods orders"
    far, e2, same, blind, cold = (method.traffic for method in methods)
    assert far.prior is e2.prior is same.prior is blind.prior is prior
    ours = settings_in(e2)
    assert settings_in(same) == settings_in(cold) == ours
    assert cold.prior.sampler.temperature == 0.5
    assert settings_in(far) == ours | {
        "skeleton": replace(e2.skeleton, far=2),
        "reselect": 0,
    }
    assert isinstance(blind, CTGAdv)
    assert (blind.knowledge, blind.responsibility) == (
        "predicted",
        "full",
    )


def test_several_intensities_are_a_row_each_but_of_what_knows_none():
    methods = methods_of(
        [
            "methods=[nominal,idm,e2]",
            "eta=[1,0,1,2.5]",
            "+variants.near={synthesizer.skeleton.far: 0}",
        ],
    )
    adversaries = [(name, eta) for name in ("e2", "near") for eta in (1, 0, 2.5)]
    assert named(methods) == [("nominal", 0), ("idm", 0), *adversaries]


@pytest.mark.parametrize(
    ("experiment", "rows"), [("table2", 5), ("table3", 21), ("intensity", 4)]
)
def test_every_row_of_an_experiment_can_be_built_and_tells_its_changes(
    experiment, rows
):
    config = config_of([f"experiment={experiment}"])
    methods = methods_of([f"experiment={experiment}"])
    assert len(methods) == rows
    assert len(set(named(methods))) == rows
    variants = [method.traffic for method in methods if method.name in config.variants]
    settings = [(settings_in(on), on.prior.sampler, on.prior.bounds) for on in variants]
    assert all(settings.count(item) == 1 for item in settings), (
        "no two variants are the same"
    )
    assert all(name in caption(config, {}) for name in config.variants)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ["methods=[e3]"],
            "synthesizer=e3: none of cat, ccdiff, constant_velocity, ctg, .*, strive; add a f",
        ),
        (["methods=[]"], r"methods=\[\]: name at least one"),
        (
            ["tries=1", "+variants.other={training: {steps: 4}}"],
            "variants.other: training is none of prior, synthesizer",
        ),
        (
            ["tries=1", "+variants.other={synthesizer.contrl.feasibility: 0}"],
            "variants.other: .*'contrl' .*compare it with conf/",
        ),
        (
            ["tries=1", "+variants.other={prior.sampler.temperature: -1}"],
            "temperature=-1",
        ),
        (
            ["+variants.idm={prior.sampler.steps: 4}"],
            "variants.idm: idm is a row already",
        ),
        (["eta=nan"], "eta=nan: expected"),
        (
            ["processes=2", "threads=2"],
            "processes=2, threads=2, device=cpu: .*processes=1",
        ),
        (["shard=[4,4]"], r"shard=\[4, 4\]: expected \[k, n\] with k from 0 to n - 1"),
        (["tries=1", "compare=[e2,ctg]"], "no row of the name ctg"),
        (["compare=[search]"], "leave out compare and shard, or set tries=1"),
        (
            ["synthesizer=ctg"],
            "synthesizer=ctg: search does not begin with it; set tries=1",
        ),
        (["tries=2", "budget=640"], "tries=2, budget=640: name one of the two"),
        (["budget_unit=tries"], "budget_unit=tries: without a budget"),
        (
            ["methods=[e2]", "budget_unit=seconds"],
            "budget_unit=seconds: without a budget",
        ),
        (["tries=8", "budget_unit=seconds"], "budget_unit=seconds: without a budget"),
        (["budget=0"], "budget=0"),
        (["budget=[640,2560]"], r"budget=\[640, 2560\]: name one; a sweep .* -m"),
        (["eta=[1,2]"], "a search has one intensity"),
        (["seeds=[1000000000]"], "seeds"),
        (["+variants.search={synthesizer.support: random}"], "search is a row already"),
        (
            ["tries=1", "+variants.blind={search.bandit: false}"],
            "variants.blind: changes the search, and tries=1",
        ),
        (["tries=0"], "tries=0: expected a number of at least 1"),
    ],
)
def test_what_cannot_run_is_named_with_its_remedy(overrides, message):
    with pytest.raises(InputError, match=message):
        methods_of(overrides)


@pytest.mark.parametrize(
    ("overrides", "rows", "budget", "unit"),
    [
        ((), ("search", "nominal"), 640.0, "nfe"),
        (("tries=1",), ("e2", "nominal"), None, "tries"),
        (("tries=1", "synthesizer=ccdiff"), ("ccdiff", "nominal"), None, "tries"),
        (("tries=8",), ("search", "nominal"), 8.0, "tries"),
        (("methods=[e2]",), ("e2",), None, "nfe"),
        (("methods=[e2]", "budget=4", "budget_unit=tries"), ("e2",), 4.0, "tries"),
    ],
)
def test_a_search_has_a_few_tries_and_other_methods_one(overrides, rows, budget, unit):
    requests = evaluation_settings(config_of(overrides))
    assert (requests.methods, requests.budget, requests.budget_unit) == (
        rows,
        budget,
        unit,
    )


def test_a_shared_device_keeps_to_one_process():
    assert (
        processes_of(config_of(["device=cuda"]))
        == processes_of(config_of(["threads=2"]))
        == 1
    )
    assert processes_of(config_of(["processes=3"])) == 3


def test_table_1_has_every_rival_on_both_terms():
    rows = methods_of(["experiment=table1"])
    rivals = {"ctg", "ctg_adv", "strive", "safe_sim_opt", "diffscene", "ccdiff", "cat"}
    certain = terms_by_method(rows)
    assert rivals <= set(certain)
    assert all(certain[name][0] == "plan" for name in rivals)
    assert certain["e2_pursuit"] == ("plan", "none")  # the rivals' terms
    ours = terms_by_method(methods_of(["experiment=table1_our_terms"]))
    for name in rivals:
        assert ours[f"{name}, our terms"] == (
            "predicted",
            "" if name == "ctg" else "full",
        )
    assert ours["e2_pursuit, our terms"] == ours["e2"] == ("predicted", "full")
