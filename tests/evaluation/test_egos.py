"""Several egos in one run: the same noise, paired differences, pooled trainings."""

import math

import pytest
import torch

from e2rl.evaluation.ego_set import EgoSet, pool_trainings, recorded_acceleration, run_egos
from e2rl.evaluation.protocol import Method, Setup, run_protocol
from e2rl.evaluation.rollout_files import TABLE, read_rows
from e2rl.evaluation.summary import metric_rows
from e2rl.metrics.catalogue import METRICS
from e2rl.metrics.score import score_rollouts
from e2rl.planners.idm_planner import IDMEgo
from e2rl.report.comparison_tables import ego_tables, guard_table
from e2rl.report.drawing import image_of
from e2rl.report.plots import collision_bars
from e2rl.sim.env import SimSettings
from e2rl.sim.rollout_file import ROLLOUTS
from e2rl.traffic.rule_based import ConstantVelocity
from tests.learning.small import small_scenes
from tests.metrics.random_rollouts import labelled, random_rollouts

METHODS = [Method("nominal", ConstantVelocity())]


def slow(speed=3.0):
    return IDMEgo(desired_speed=speed, use_limits=False)


def setup_of(scenes, ego=None):
    return Setup(scenes, ego or slow(), "idm", SimSettings())


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """(rows, folder) of one ego, the same again, and two trainings of a faster one."""
    folder = tmp_path_factory.mktemp("run")
    egos = {"one": slow(), "same": slow(), "fast_0": slow(12.0), "fast_1": slow(9.0)}
    pairs = [("same", "one"), ("fast", "one"), ("fast", "same")]
    chosen = EgoSet(egos, ["one", "same", "fast"], pairs, {"fast": ["fast_0", "fast_1"]})
    scenes = small_scenes(3)
    scenes.location[:] = ["a", "b", "c"]
    return run_egos(setup_of(scenes), chosen, METHODS, [0], folder), folder


def test_every_ego_has_its_rows_and_files_and_drives_as_if_alone(run, tmp_path):
    rows, folder = run
    assert [row["ego"] for row in rows] == ["one", "same", "fast_0", "fast_1", "fast"]
    lines = read_rows(folder / TABLE)
    assert [line["ego_policy"] for line in lines] == ["one"] * 3 + ["same"] * 3 + ["fast_0"] * 3 + ["fast_1"] * 3
    assert len(list((folder / ROLLOUTS).glob("*.npz"))) == 12
    (alone,) = run_protocol(setup_of(small_scenes(3), slow(12.0)), METHODS, [0], tmp_path)
    assert alone["metrics"]["progress"]["mean"] == rows[2]["metrics"]["progress"]["mean"]


def test_an_ego_does_not_differ_from_itself_at_all(run):
    paired = run[0][1]["paired"]["ego one"]
    known = {name: value for name, value in paired.items() if value["n"] and name != "seconds_per_rollout"}
    assert {"cfr", "progress", "macc", "failures_per_km"} <= set(known)
    for name, value in known.items():
        assert value["difference"] == 0
        if not METRICS[name].samples:  # realism has no intervals between egos
            assert value["low"] == value["high"] == 0
    assert all(paired["progress"][name] == 0 for name in ("relative", "relative_low", "relative_high"))


def test_trainings_are_pooled_and_compared_with_the_same_rollouts_of_another(run):
    one, _, first, second, pooled = run[0]
    assert (pooled["n_rollouts"], pooled["n_trainings"], one["n_trainings"]) == (6, 2, 1)
    means = [row["metrics"]["progress"]["mean"] for row in (first, second, pooled)]
    assert means[2] == pytest.approx((means[0] + means[1]) / 2)
    paired = pooled["paired"]["ego one"]["progress"]
    base = one["metrics"]["progress"]["mean"]
    assert paired["n"] == 6 and paired["difference"] == pytest.approx(means[2] - base)
    assert paired["relative"] == pytest.approx(means[2] / base - 1)


def test_tables_guards_and_bars_name_every_ego_and_a_missed_guard(run):
    rows = run[0]
    names, pairs = ["one", "same", "fast"], [("fast", "one"), ("fast", "same")]
    tables = ego_tables(rows, names, pairs, "Egos", "settings")
    assert tables[0].title == "Egos" and tables[0].markdown().startswith("## Egos") and not tables[1].title
    assert "pool" in tables[0].caption
    progress = next(table for table in tables if table.head[0] == "progress [m]")
    assert progress.head[1:] == [*names, "fast − one [m]", "fast − one [%]", "fast − same [m]"]
    assert [row[0] for row in progress.rows] == ["nominal"] and progress.rows[0][4].startswith("+")
    strict, loose = (guard_table(rows, "one", "fast", "same", recorded) for recorded in (0.0, 100.0))
    verdicts = [{row[0].split(" ")[0]: row[-1] for row in table.rows} for table in (strict, loose)]
    assert [verdict["macc"] for verdict in verdicts] == ["missed", "met"] and verdicts[0]["progress"] == "met"
    assert image_of(collision_bars(rows, names, "e2")).size[0] > 0


def rows_of(values, ego, training=None):
    """Labelled rows of progress values, each in a place of its own, and no realism samples."""
    scored, features = score_rollouts(random_rollouts(len(values)))
    rows = [
        row | {"progress": value, "scene_id": str(index), "location": "", "seed": 0}
        for index, (row, value) in enumerate(zip(scored, values, strict=True))
    ]
    rows = labelled(rows, "made", "test", "nominal", ego)
    return [row | ({} if training is None else {"training": training}) for row in rows], features


def test_trainings_that_differ_widen_the_interval_that_places_alone_do_not():
    """Every place drives the same 10 or 20 m: all that varies is the training."""
    first, features = rows_of([10.0] * 8, "a_0")
    second, more = rows_of([20.0] * 8, "a_1")
    rows, samples = first + second, features + more
    pooled, copies = pool_trainings(rows, samples, {"a": ["a_0", "a_1"]})
    result = {row["ego"]: row["metrics"]["progress"] for row in metric_rows(rows + pooled, samples + copies, 200, 2)}
    assert result["a_0"]["low"] == result["a_0"]["high"] == 10
    assert (result["a"]["low"], result["a"]["mean"], result["a"]["high"]) == (10, 15, 20)
    assert not any("training" in row for row in rows), "the rows themselves stay as they are"


def test_a_share_of_nothing_is_unknown():
    ours, features = rows_of([1.0, 2.0, 3.0], "a")
    theirs, more = rows_of([0.0, 0.0, 4.0], "b")
    result = metric_rows(ours + theirs, features + more, 100, 2, egos=[("a", "b")])
    paired = result[0]["paired"]["ego b"]["progress"]
    assert paired["relative"] == pytest.approx(0.5) and math.isnan(paired["relative_low"]), "some draws have only zeros"
    assert paired["difference"] == pytest.approx(2 / 3) and not math.isnan(paired["low"])


def test_the_recorded_acceleration_is_that_of_the_logged_speeds():
    scenes = small_scenes(2)
    time = 0.1 * torch.arange(scenes.scenes["logged"].shape[1])
    scenes.scenes["logged"][:, :, 0, 3] = 2.0 + 1.5 * time
    scenes.scenes["logged_valid"][:, :, 0] = True
    assert recorded_acceleration(scenes) == pytest.approx(1.5, abs=1e-4)
