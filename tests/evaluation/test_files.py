"""Files of a run: the same when read back, strict JSON, names of their own, and one
line for what is damaged."""

import json
import math
import re
import sys

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from e2rl.driving.setup import Method, Setup
from e2rl.evaluation import rollout_files as files
from e2rl.evaluation.rollout_files import read_metrics, read_rows, write_json
from e2rl.evaluation.summary import metric_rows
from e2rl.metrics.realism import NO_SAMPLES
from e2rl.metrics.score import score_rollouts
from e2rl.planners.idm_planner import IDMEgo
from e2rl.run.errors import InputError
from e2rl.sim.rollout_file import file_stem, rollout_name
from e2rl.sim.settings import SimSettings
from e2rl.traffic.rule_based import ConstantVelocity
from tests.evaluation.constructed_runs import row_of
from tests.metrics.random_rollouts import labelled, random_rollouts
from tests.synthetic import make_scenes


@pytest.fixture(scope="module")
def rollouts():
    return random_rollouts(6, seed=1)


def test_rows_read_back_are_those_written(tmp_path, rollouts):
    rows = score_rollouts(rollouts)[0]
    files.write_rows(tmp_path / "rollouts.csv", rows)
    read = read_rows(tmp_path / "rollouts.csv")
    assert list(read[0]) == list(files.table_columns())
    assert len(read) == 6
    for row, other in zip(rows, read, strict=True):
        for column in files.table_columns():
            same = row[column] == other[column] or (
                math.isnan(row[column]) and math.isnan(other[column])
            )
            assert same, (column, row[column], other[column])


def test_metrics_are_strict_json_with_counts_command_and_paired_differences(
    tmp_path, rollouts, monkeypatch
):
    monkeypatch.setattr(sys, "argv", ["evaluate.py", "eta=[1, 2]"])
    rows, features = score_rollouts(rollouts)
    both = rows + [
        row | {"eta": 0.0}
        for row in labelled(
            rows, "synthetic", split="test", method="nominal", ego="idm"
        )
    ]
    write_json(
        tmp_path / "metrics.json",
        metric_rows(both, features * 2, draws=50, realism_draws=5, stage="after"),
    )
    first, _ = json.loads(
        (tmp_path / "metrics.json").read_text(), parse_constant=pytest.fail
    )
    assert (first["n_scenes"], first["n_seeds"], first["n_rollouts"]) == (3, 2, 6)
    assert first["command"] == "python evaluate.py 'eta=[1, 2]'"
    assert first["stage"] == "after"
    assert "git" in first
    assert first["metrics"]["transport"] == {
        "mean": None,
        "low": None,
        "high": None,
        "n": 0,
    }
    assert list(first["paired"]) == ["nominal"]
    assert "difference" in first["paired"]["nominal"]["cfr"]
    assert math.isnan(
        read_metrics(tmp_path / "metrics.json")[0]["metrics"]["transport"]["mean"]
    )


def test_several_intensities_of_one_method_are_told_apart(rollouts):
    rows, features = score_rollouts(rollouts)
    several = [row | {"eta": eta} for eta in (1.0, 2.0) for row in rows]
    several += labelled(rows, "synthetic", split="test", method="nominal", ego="idm")
    several += labelled(
        rows, "synthetic", split="test", method="nominal", ego="lane_graph"
    )
    result = metric_rows(several, features * 4, draws=10, realism_draws=2)
    assert [list(row["paired"]) for row in result] == [
        ["e2@2", "nominal"],
        ["e2@1", "nominal"],
        ["e2@1", "e2@2"],
        [],
    ]


def test_tries_of_searches_are_no_pairs():
    """All scenes of both methods fail, in the first try of one and in each try of the
    other."""
    rows = [
        row_of(
            scene,
            number,
            hit=number == 0 or method == "b",
            method=method,
            ego=ego,
            errored=0.0,
            raised_by="",
        )
        for ego in ("old", "new")
        for method in ("a", "b")
        for scene in range(20)
        for number in range(4)
    ]
    result = metric_rows(
        rows,
        [NO_SAMPLES] * len(rows),
        draws=10,
        realism_draws=0,
        egos=[("new", "old")],
        searched=True,
    )
    assert [
        (row["metrics"]["cfr_preventable"]["mean"], row["paired"]) for row in result
    ] == [(1.0, {})] * 4


PARTS = st.lists(st.text(min_size=1, max_size=150), min_size=3, max_size=3)


@settings(max_examples=200, deadline=None)
@given(PARTS, PARTS)
@example(["m", "e", "place/1"], ["m", "e", "place-1"])
@example(["m", "e", "Place"], ["m", "e", "place"])
@example(["m", "e__1", "x"], ["m__e", "1", "x"])
@example(["m", "e_", "x"], ["m", "e", "_x"])
@example(["m", "e", "x/1"], ["m", "e", file_stem("x/1")])
def test_other_rollouts_have_other_files_wherever_they_are_written(one, other):
    names = [file_stem(*parts) for parts in (one, other)]
    assert all(re.fullmatch(r"[\w.@+~-]{1,220}", name, re.ASCII) for name in names)
    assert (one == other) == (names[0].lower() == names[1].lower())


def test_intensities_have_files_of_their_own():
    row = {"method": "m", "ego_policy": "e", "scene_id": "x", "seed": 0}
    assert rollout_name(row | {"eta": 2.0}) == "m__e__2__x__0.npz"
    assert (
        len({rollout_name(row | {"eta": eta}) for eta in (1.0, 1.0 + 1e-9, 1.0 - 1e-9)})
        == 3
    )


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ("aa", "several scenes"),
        (("a", "b\x1b[2J"), "control"),
        (("a", "\ud800"), "control"),
    ],
)
def test_scenes_of_one_id_or_with_odd_names_are_refused_at_the_door(names, said):
    scenes = make_scenes(2)
    scenes.scene_id[:] = names
    with pytest.raises(InputError, match=said):
        Setup(scenes, IDMEgo(), ego_name="idm", sim=SimSettings())
    with pytest.raises(InputError, match="control"):
        Method("e2\nlast", ConstantVelocity())
