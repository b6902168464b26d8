"""The egos of a configuration, and what one that cannot be is told."""

import pytest

from e2rl.evaluation import methods as build_objects
from e2rl.evaluation.ego_set import build_egos, curve_runs
from e2rl.planners.actor import ActorEgo
from e2rl.planners.lane_graph_planner import LaneGraphEgo
from e2rl.run import config as build_config
from e2rl.run.errors import InputError
from e2rl.run.files import seal
from tests.prior.small import small_prior

LEARNING = ["experiment=policy_learning"]


def config_of(*overrides):
    return build_config.load_config("evaluate", overrides)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """A run folder with the weights of an untrained actor."""
    folder = tmp_path_factory.mktemp("run")
    (folder / "checkpoints" / "round-000001").mkdir(parents=True)
    build_objects.build_ego(config_of("ego=actor")).network.save(
        folder / "checkpoints" / "round-000001" / "actor.safetensors"
    )
    seal(folder / "checkpoints" / "round-000001")
    return folder


def test_without_egos_there_is_the_one_of_the_group():
    assert build_egos(config_of()) is None


def test_an_entry_is_a_file_with_changes_of_its_fields():
    chosen = build_egos(config_of("+egos.a={ego: lane_graph, max_risk: 0.3}", "+egos.b={ego: lane_graph}"))
    assert isinstance(chosen.egos["a"], LaneGraphEgo) and chosen.pairs == [("b", "a")]
    assert chosen.egos["a"].max_risk == 0.3 != chosen.egos["b"].max_risk


def test_table_4_compares_every_ego_with_one_of_them():
    config = config_of("experiment=table4")
    build_objects.check_evaluation(config)
    chosen = build_egos(config)
    names = ["replay", "idm", "lane_graph", "sampling", "bits", "actor_untrained", "actor"]
    assert list(chosen.egos) == names
    assert chosen.pairs == [(name, "lane_graph") for name in names if name != "lane_graph"]
    trained, untrained = (chosen.egos[name].network.weights() for name in ("actor", "actor_untrained"))
    assert any((trained[name] != untrained[name]).any() for name in trained)
    for wrong in ("compare=taxi", "policy_learning={before: idm, after: replay, planner: lane_graph, runs: null}"):
        with pytest.raises(InputError, match="compare="):
            build_objects.check_evaluation(config_of("experiment=table4", wrong))


def test_first_weights_do_not_depend_on_the_other_egos():
    one, two = (build_egos(config_of(*more, "+egos.x={ego: actor}")) for more in ([], ["+egos.a={ego: actor}"]))
    first, second = (chosen.egos["x"].network.weights() for chosen in (one, two))
    assert all((first[name] == second[name]).all() for name in first)


def test_the_experiment_compares_what_was_trained_with_each_other_ego(checkpoint):
    config = config_of(*LEARNING, f"egos.after.checkpoint={checkpoint}")
    build_objects.check_evaluation(config)
    methods = build_objects.build_methods(config, small_prior())
    attacks = ["e2", "e2_unbound", "no duty", "told the plan", "random_k"]
    expected = [("nominal", 0), *((name, eta) for name in attacks for eta in (1, 2))]
    assert [(method.name, method.eta) for method in methods] == expected
    known = {method.name: (method.traffic.knowledge, method.traffic.responsibility) for method in methods[1:]}
    assert list(known.values())[:4] == [
        ("predicted", "full"),
        ("plan", "none"),
        ("predicted", "none"),
        ("plan", "full"),
    ]
    chosen = build_egos(config)
    assert list(chosen.egos) == ["before", "after", "lane_graph", "sampling"] and not chosen.trainings
    assert chosen.pairs == [("after", "before"), ("after", "lane_graph"), ("after", "sampling")]
    assert curve_runs(config) == [], "the run has no logs"


def test_several_checkpoints_are_trainings_of_one_name(checkpoint):
    chosen = build_egos(config_of(*LEARNING, f"egos.after.checkpoints=[{checkpoint},{checkpoint}]"))
    assert list(chosen.egos) == ["before", "after_0", "after_1", "lane_graph", "sampling"]
    assert chosen.trainings == {"after": ["after_0", "after_1"]} and "after" in chosen.names
    assert isinstance(chosen.egos["after_1"], ActorEgo)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (LEARNING, "egos.after.checkpoint: needed; give the folder that train.py wrote"),
        ([*LEARNING, "egos.after.checkpoint=nowhere"], "egos.after: nowhere: no actor there; give"),
        ([*LEARNING, "egos.after.checkpoints=[a,nowhere]"], "egos.after: a: no actor there"),
        ([*LEARNING, "egos.after.checkpoints=nowhere"], "egos.after.checkpoints=nowhere: expected a list"),
        ([*LEARNING, "egos.after.checkpoint=a", "egos.after.checkpoints=[b]"], "egos.after: has a checkpoint and"),
        (["+egos.a={ego: taxi}"], "egos.a: ego=taxi: none of actor, bits, external, idm"),
        (["+egos.a={ego: idm, speed: 3}"], "egos.a: Key 'speed' .*compare it with conf/ego/idm"),
        (["+egos.a=idm"], "egos.a='idm': expected a file of conf/ego"),
        (["+egos.a={headway: 1}"], "egos.a=.*: expected a file of conf/ego"),
        (["+egos.a_0={ego: idm}", "+egos.a={ego: actor, checkpoints: [x, y]}"], "egos.a: a_0 is the name of another"),
        (["+egos.a={ego: idm}", "tuning={}"], "egos: tuning, .* choose it with ego=NAME"),
        (["+egos.a={ego: idm}", "meta_rollouts=2"], "egos: tuning, .*meta_rollouts are of one ego"),
        (["policy_learning={before: a, after: b}"], "policy_learning: names no egos"),
        ([*LEARNING, "egos.after.ego=idm", "egos.after.checkpoint=a"], "egos.after: Key 'checkpoint'"),
    ],
)
def test_what_cannot_be_is_named_with_its_remedy(overrides, message):
    with pytest.raises(InputError, match=message):
        build_egos(config_of(*overrides))


def test_a_name_that_no_file_may_have_is_refused():
    config = config_of()
    config.egos = {"a/b": {"ego": "idm"}}
    with pytest.raises(InputError, match="egos.a/b: the name goes into file names"):
        build_egos(config)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["policy_learning.planner=taxi"], "policy_learning.planner=taxi: none of egos .before, after, lane_graph"),
        (["policy_learning.before=after"], "policy_learning: after is after, and before or planner, too"),
        (["methods=[e2]"], "policy_learning compares nominal driving; name nominal, too"),
    ],
)
def test_roles_are_names_of_egos(checkpoint, overrides, message):
    with pytest.raises(InputError, match=message):
        build_egos(config_of(*LEARNING, f"egos.after.checkpoint={checkpoint}", *overrides))
