"""Tables of a run: the same when read back, strict JSON, and what is damaged is named."""

import json
import math
import sys
from functools import reduce

import pytest

from e2rl.evaluation import rollout_files as files
from e2rl.evaluation.rollout_files import read_metrics, read_rows, write_metrics
from e2rl.evaluation.summary import metric_rows
from e2rl.metrics.score import score_rollouts
from e2rl.run.errors import InputError
from tests.metrics.random_rollouts import labelled, random_rollouts


@pytest.fixture(scope="module")
def rollouts():
    return random_rollouts(6, seed=1)


def test_rows_read_back_are_those_written(tmp_path, rollouts):
    rows = score_rollouts(rollouts)[0]
    files.write_rows(tmp_path / "rollouts.csv", rows)
    read = read_rows(tmp_path / "rollouts.csv")
    assert list(read[0]) == list(files.table_columns()) and len(read) == 6
    for row, other in zip(rows, read, strict=True):
        for column in files.table_columns():
            same = row[column] == other[column] or (math.isnan(row[column]) and math.isnan(other[column]))
            assert same, (column, row[column], other[column])


def test_metrics_are_strict_json_with_counts_command_and_paired_differences(tmp_path, rollouts, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["evaluate.py", "eta=[1, 2]"])
    rows, features = score_rollouts(rollouts)
    both = rows + labelled(rows, "synthetic", "test", "nominal", "idm")
    both[6:] = [row | {"eta": 0.0} for row in both[6:]]
    result = metric_rows(both, features * 2, draws=50, realism_draws=5, stage="after")
    write_metrics(tmp_path / "metrics.json", result)
    text = (tmp_path / "metrics.json").read_text()
    assert "NaN" not in text
    stored = json.loads(text)
    assert [row["method"] for row in stored] == ["e2", "nominal"] and [row["eta"] for row in stored] == [2.0, 0.0]
    first = stored[0]
    assert (first["n_scenes"], first["n_seeds"], first["n_rollouts"]) == (3, 2, 6)
    assert first["command"] == "python evaluate.py 'eta=[1, 2]'" and first["stage"] == "after" and "git" in first
    assert first["metrics"]["transport"] == {"mean": None, "low": None, "high": None, "n": 0}
    assert list(first["paired"]) == ["nominal"] and "difference" in first["paired"]["nominal"]["cfr"]
    assert math.isnan(read_metrics(tmp_path / "metrics.json")[0]["metrics"]["transport"]["mean"])
    for where, name in (("metrics", "mean"), ("metrics", "n"), ("paired.nominal", "difference")):
        changed = json.loads(text)
        del reduce(dict.get, where.split("."), changed[0])["cfr"][name]
        (tmp_path / "metrics.json").write_text(json.dumps(changed))
        with pytest.raises(InputError, match=rf"it\[0\]\.{where}\.cfr\.{name} is missing"):
            read_metrics(tmp_path / "metrics.json")


def test_several_intensities_of_one_method_are_told_apart(rollouts):
    rows, features = score_rollouts(rollouts)
    many = [row | {"eta": eta} for eta in (1.0, 2.0) for row in rows]
    many += labelled(rows, "synthetic", "test", "nominal", "idm")
    many += labelled(rows, "synthetic", "test", "nominal", "lane_graph")
    result = metric_rows(many, features * 4, draws=10, realism_draws=2)
    assert [list(row["paired"]) for row in result] == [["e2@2", "nominal"], ["e2@1", "nominal"], ["e2@1", "e2@2"], []]
