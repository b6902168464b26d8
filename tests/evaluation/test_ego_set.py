"""The egos of a run: the same noise, paired differences, pooled trainings; those of a
configuration."""

import math
from dataclasses import replace

import pytest

from e2rl.driving.batches import Work, drive_all
from e2rl.driving.setup import Method, Setup
from e2rl.evaluation.build import build_egos
from e2rl.evaluation.protocol import run_protocol
from e2rl.evaluation.record import record
from e2rl.evaluation.rollout_files import TABLE, read_rows
from e2rl.evaluation.summary import metric_rows
from e2rl.metrics.score import score_rollouts
from e2rl.planners.idm_planner import IDMEgo
from e2rl.planners.lane_graph_planner import LaneGraphEgo
from e2rl.run.config import load_config
from e2rl.run.errors import InputError
from e2rl.sim.rollout_file import ROLLOUTS
from e2rl.sim.settings import SimSettings
from e2rl.traffic.rule_based import ConstantVelocity
from tests.learning.small import small_scenes
from tests.metrics.random_rollouts import labelled, random_rollouts

METHODS = [Method("nominal", ConstantVelocity())]


def slow(speed=3.0):
    return IDMEgo(desired_speed=speed, use_limits=False)


def setup_of(scenes, ego=None):
    return Setup(scenes, ego or slow(), ego_name="idm", sim=SimSettings())


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """(rows, folder) of one ego, the same again, and two trainings of a faster one."""
    folder = tmp_path_factory.mktemp("run")
    egos = {"one": slow(), "same": slow(), "fast_0": slow(12.0), "fast_1": slow(9.0)}
    scenes = small_scenes(3)
    scenes.location[:] = ["a", "b", "c"]
    scored = drive_all(
        [replace(setup_of(scenes), ego=egos[name], ego_name=name) for name in egos],
        METHODS,
        seeds=[0],
        work=Work(folder / ROLLOUTS),
    )
    result = record(
        scored,
        folder,
        egos=[("same", "one"), ("fast", "one"), ("fast", "same")],
        trainings={"fast": ["fast_0", "fast_1"]},
    )
    return result.metrics, folder


def test_every_ego_has_its_rows_and_files_and_drives_as_if_alone(run, tmp_path):
    rows, folder = run
    assert [row["ego"] for row in rows] == ["one", "same", "fast_0", "fast_1", "fast"]
    lines = read_rows(folder / TABLE)
    assert [line["ego_policy"] for line in lines] == ["one"] * 3 + ["same"] * 3 + [
        "fast_0"
    ] * 3 + ["fast_1"] * 3
    assert len(list((folder / ROLLOUTS).glob("*.npz"))) == 12
    (alone,) = run_protocol(
        setup_of(small_scenes(3), slow(12.0)), METHODS, seeds=[0], folder=tmp_path
    )
    assert (
        alone["metrics"]["progress"]["mean"] == rows[2]["metrics"]["progress"]["mean"]
    )


def test_an_ego_does_not_differ_from_itself_at_all(run):
    paired = run[0][1]["paired"]["ego one"]
    certain = {
        name: value
        for name, value in paired.items()
        if value["n"] and name != "seconds_per_rollout"
    }
    assert {"cfr", "progress", "macc", "failures_per_km"} <= set(certain)
    for value in certain.values():
        assert value["difference"] == 0
        assert math.isnan(value["low"])
        assert math.isnan(value["high"]), "three places are too few for an interval"


def test_trainings_are_pooled_and_compared_with_the_same_rollouts_of_another(run):
    single, _, first, second, pooled = run[0]
    assert (pooled["n_rollouts"], pooled["n_trainings"], single.get("n_trainings")) == (
        6,
        2,
        None,
    )
    means = [row["metrics"]["progress"]["mean"] for row in (first, second, pooled)]
    assert means[2] == pytest.approx((means[0] + means[1]) / 2)
    paired = pooled["paired"]["ego one"]["progress"]
    base = single["metrics"]["progress"]["mean"]
    assert paired["n"] == 6
    assert paired["difference"] == pytest.approx(means[2] - base)


def rows_of(values, ego, training=None):
    """Labelled rows of progress values, each in a place of its own, and no realism
    samples."""
    scored, features = score_rollouts(random_rollouts(len(values)))
    rows = [
        row | {"progress": value, "scene_id": str(index), "location": "", "seed": 0}
        for index, (row, value) in enumerate(zip(scored, values, strict=True))
    ]
    rows = labelled(rows, "made", split="test", method="nominal", ego=ego)
    return [
        row | ({} if training is None else {"training": training}) for row in rows
    ], features


def test_trainings_that_differ_widen_the_interval_that_places_alone_do_not():
    """Places drive about 10 or 20 m: nearly all that varies is the training."""
    first, features = rows_of([10 + 0.01 * place for place in range(-6, 7)], "a_0")
    second, further = rows_of([20 + 0.01 * place for place in range(-6, 7)], "a_1")
    rows = first + second
    samples = features + further
    pooled = {"a": ["a_0", "a_1"]}
    result = {
        row["ego"]: row["metrics"]["progress"]
        for row in metric_rows(
            rows, samples, trainings=pooled, draws=200, realism_draws=2
        )
    }
    alone, both = (
        [result[name][end] for end in ("low", "mean", "high")] for name in ("a_0", "a")
    )
    assert alone == pytest.approx([10, 10, 10], abs=0.05)
    assert alone[0] < alone[2]
    assert both == pytest.approx([10, 15, 20], abs=0.05)
    assert not any("training" in row for row in rows), (
        "the rows themselves stay as they are"
    )


# --- from the configuration

LEARNING = ["experiment=policy_learning"]
TRAINED = [*LEARNING, "egos.after.checkpoint=bundled"]


def config_of(overrides=()):
    return load_config("evaluate", list(overrides))


def test_an_entry_is_a_file_with_changes_whose_first_weights_do_not_depend_on_the_other_egos():
    chosen = build_egos(
        config_of(["+egos.a={ego: lane_graph, max_risk: 0.3}", "+egos.x={ego: actor}"]),
        "",
    )
    assert isinstance(chosen.egos["a"], LaneGraphEgo)
    assert chosen.egos["a"].max_risk == 0.3
    alone = (
        build_egos(config_of(["+egos.x={ego: actor}"]), "").egos["x"].network.weights()
    )
    assert all(
        (alone[name] == value).all()
        for name, value in chosen.egos["x"].network.weights().items()
    )


def test_table_4_compares_every_ego_with_one_of_them():
    chosen = build_egos(config_of(["experiment=table4"]), "ego")
    names = [
        "replay",
        "idm",
        "lane_graph",
        "sampling",
        "pdm_closed",
        "lane_graph_tuned",
        "bits",
        "actor_untrained",
    ]
    names.append("actor")
    assert list(chosen.egos) == names
    assert chosen.pairs == [
        (name, "lane_graph") for name in names if name != "lane_graph"
    ]
    trained, untrained = (
        chosen.egos[name].network.weights() for name in ("actor", "actor_untrained")
    )
    assert any((trained[name] != untrained[name]).any() for name in trained)


def test_the_experiment_compares_each_ego_with_the_untrained_one():
    chosen = build_egos(config_of(TRAINED), "")
    assert list(chosen.egos) == ["before", "after", "lane_graph", "sampling"]
    assert not chosen.trainings
    assert chosen.pairs == [
        ("after", "before"),
        ("lane_graph", "before"),
        ("sampling", "before"),
    ]


def test_several_checkpoints_are_trainings_of_one_name():
    chosen = build_egos(
        config_of([*LEARNING, "egos.after.checkpoints=[bundled,bundled]"]), ""
    )
    assert list(chosen.egos) == [
        "before",
        "after_0",
        "after_1",
        "lane_graph",
        "sampling",
    ]
    assert chosen.trainings == {"after": ["after_0", "after_1"]}
    assert "after" in chosen.names


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            LEARNING,
            "egos.after.checkpoint: needed; give the folder that train.py wrote",
        ),
        (
            [*LEARNING, "egos.after.checkpoints=[a,nowhere]"],
            "egos.after: a: no actor there",
        ),
        (
            ["+egos.a={ego: idm, speed: 3}"],
            "egos.a: Key 'speed' .*compare it with conf/ego/idm",
        ),
        (
            ["+egos.a_0={ego: idm}", "+egos.a={ego: actor, checkpoints: [x, y]}"],
            "egos.a: a_0 is the name of another",
        ),
    ],
)
def test_what_cannot_be_is_named_with_its_remedy(overrides, message):
    with pytest.raises(InputError, match=message):
        build_egos(config_of(overrides), "")
