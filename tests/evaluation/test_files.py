"""Files of a run: exact keys and types, readable without pickle, whole or absent, the same when read back."""

import io
import json
import math
import sys
import zipfile
from functools import reduce

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from e2rl.evaluation import rollout_files as files
from e2rl.evaluation.rollout_files import Source, label_rows, read_metrics, read_rows, write_metrics, write_rollouts
from e2rl.evaluation.rollout_reader import as_rollout_dict, read_rollout, read_rollouts
from e2rl.evaluation.summary import metric_rows
from e2rl.metrics.score import score_rollouts
from e2rl.run.errors import InputError
from tests.metrics.random_rollouts import random_rollouts

SOURCE = Source("synthetic", "test", "e2", "idm")
DTYPES = {
    "format": "U", "scene_id": "U", "location": "U", "dataset": "U", "split": "U", "method": "U", "ego_policy": "U",
    "seed": "i", "eta": "f", "dt": "f", "ego": "i", "states": "f4", "valid": "b", "size": "f4", "agent_type": "U",
    "simulated": "b", "adversaries": "b", "logged": "f4", "logged_valid": "b", "lane_points": "f", "lane_offsets": "i",
    "lane_width": "f", "drivable_points": "f", "drivable_offsets": "i",
}  # fmt: skip


@pytest.fixture(scope="module")
def rollouts():
    return random_rollouts(6, seed=1)


def test_rollouts_have_the_format_s_keys_types_and_names(tmp_path, rollouts):
    paths = write_rollouts(tmp_path, rollouts, SOURCE)
    assert [path.name for path in paths][:2] == ["e2__idm__2__scene_0__0.npz", "e2__idm__2__scene_0__1.npz"]
    assert sorted(tmp_path.iterdir()) == sorted(paths), "no temporary file is left"
    for index, path in enumerate(paths):
        with np.load(path, allow_pickle=False) as archive:
            data = dict(archive)
        assert data.keys() == DTYPES.keys()
        for key, kind in DTYPES.items():
            assert data[key].dtype.kind == kind[0] and (len(kind) < 2 or data[key].dtype == kind), key
        assert str(data["format"]) == "e2rl-rollout/1" and float(data["dt"]) == 0.1 and int(data["ego"]) == 0
        assert data["states"].shape == (81, 48, 4)
        for name, least in (("lane", 2), ("drivable", 3)):
            offsets = data[f"{name}_offsets"]
            assert offsets[0] == 0 and offsets[-1] == len(data[f"{name}_points"]) and (np.diff(offsets) >= least).all()
        assert len(data["lane_width"]) == len(data["lane_offsets"]) - 1 and (data["lane_width"] > 0).all()
        np.testing.assert_array_equal(data["states"], rollouts["states"][index].numpy())


def test_plans_are_kept_of_the_ego_and_of_adversaries_and_evasions_where_there_are_any(tmp_path, rollouts):
    rows = rollouts["states"].shape[2]
    plans = torch.arange(6.0 * 16 * rows * 10 * 2).reshape(6, 16, rows, 10, 2)
    targets = torch.where(rollouts["adversaries"], 0, -1)[:, None].expand(-1, 16, -1)
    evasion = rollouts["states"][:, :, 0].clone()
    evasion[1] = torch.nan
    more = rollouts | {"plans": plans, "targets": targets, "evasion": evasion}
    for index, path in enumerate(write_rollouts(tmp_path, more, SOURCE)):
        data = read_rollout(path)
        planners = [0, *rollouts["adversaries"][index].nonzero()[:, 0].tolist()]
        assert data["planners"].tolist() == planners and ("evasion" in data) == (index != 1)
        np.testing.assert_array_equal(data["plans"], plans[index][:, planners].numpy())
        assert (data["targets"][:, 0] == -1).all() and (data["targets"][:, 1:] == 0).all()


def test_lines_too_short_to_be_lines_are_left_out():
    points = torch.arange(12.0).reshape(6, 2)
    kept, offsets, numbers = files.polylines(points, torch.tensor([0, 0, 3, 4, 4, -1]), minimum=2)
    assert (
        numbers.tolist() == [0, 4] and offsets.tolist() == [0, 2, 4] and kept.tolist() == points[[0, 1, 3, 4]].tolist()
    )
    empty, offsets, _ = files.polylines(points[:0], torch.zeros(0, dtype=torch.int64), minimum=3)
    assert empty.shape == (0, 2) and offsets.tolist() == [0]


def test_rollouts_read_back_are_those_written(tmp_path, rollouts):
    write_rollouts(tmp_path / "rollouts", rollouts, SOURCE)
    read = as_rollout_dict(read_rollouts(tmp_path))
    for key in ("states", "valid", "size", "agent_type", "adversaries", "logged"):
        torch.testing.assert_close(read[key], rollouts[key], equal_nan=True, rtol=0, atol=0)
    assert read["scene_id"] == rollouts["scene_id"] and read["eta"].tolist() == [2.0] * 6


def test_names_that_no_path_may_hold_are_mended(tmp_path, rollouts):
    odd = rollouts | {"scene_id": ["a/../b c"] * 6}
    path = write_rollouts(tmp_path, odd, SOURCE)[0]
    assert path.parent == tmp_path and path.name == "e2__idm__2__a-..-b-c__0.npz"
    assert read_rollout(path)["scene_id"] == "a/../b c"


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=6),
    st.floats(0.3, 1),
)
def test_a_damaged_rollout_is_refused_by_name(tmp_path, rollouts, changes, kept):
    """Only bytes that say nothing may be changed: then the arrays are the same."""
    path = write_rollouts(tmp_path, rollouts, SOURCE)[0]
    whole, content = read_rollout(path), path.read_bytes()
    damaged = bytearray(content[: int(kept * len(content)) + 1])
    for where, value in changes:
        damaged[int(where * len(damaged))] = value
    path.write_bytes(damaged)
    try:
        found = read_rollout(path)
    except InputError as error:
        assert str(error).startswith(str(path))
    else:
        np.testing.assert_equal(found, whole)  # NaN equals NaN


@pytest.mark.parametrize(
    ("name", "value", "what"),
    [
        ("states", np.zeros((81, 48, 3), np.float32), "states has shape"),
        ("valid", np.ones((80, 48), bool), "valid has shape"),
        ("size", np.array(["a"]), "size has shape"),
        ("seed", np.array([1, 2]), "seed is no single number"),
        ("eta", np.array(np.nan), "eta is out of range"),
        ("eta", np.array(1e300), "out of range"),
        ("dt", np.array(0.0), "out of range"),
        ("seed", np.array(1e300), "seed is no single number"),
        ("ego", np.array(48), "ego is out of range"),
        ("size", np.full((48, 2), 1e9, np.float32), "size is not between"),
        ("states", np.full((81, 48, 4), np.nan, np.float32), "a valid state is NaN"),
        ("states", np.full((81, 48, 4), 1e6, np.float32), "a valid state of states is beyond"),
        ("logged", np.full((81, 48, 4), -1e6, np.float32), "a valid state of logged is beyond"),
        ("states", np.full((81, 48, 4), [0, 0, 1e4, 0], np.float32), "beyond 100000 m, 1000 rad"),
        ("lane_width", np.full(3, np.nan, np.float32), "as many lanes as borders"),
        ("evasion", np.zeros((80, 4), np.float32), "evasion has shape"),
        ("plans", np.zeros((16, 1, 10, 2), np.float32), "some are missing"),
        ("agent_type", np.array(["horse"] * 48), "unknown type"),
        ("lane_offsets", np.array([0, 9, 3]), "as many lanes as borders"),
        ("drivable_offsets", np.array([0, 10**12]), "do not divide"),
    ],
)
def test_arrays_that_do_not_fit_together_are_named(tmp_path, rollouts, name, value, what):
    path = write_rollouts(tmp_path, rollouts, SOURCE)[0]
    np.savez(path, **(dict(np.load(path)) | {name: value}))
    with pytest.raises(InputError, match=rf"npz: damaged: .*{what}"):
        read_rollout(path)


def test_an_archive_that_claims_more_than_it_may_is_not_unpacked(tmp_path):
    with (
        zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("states.npy", "w") as one,
    ):
        for _ in range(1025):
            one.write(bytes(1 << 20))
    with pytest.raises(InputError, match=r"bomb\.npz: no readable rollout .unpacks to 1075 MB"):
        read_rollout(tmp_path / "bomb.npz")
    claim = io.BytesIO()
    np.lib.format.write_array_header_1_0(claim, {"descr": "<f8", "fortran_order": False, "shape": (1 << 60,)})
    with zipfile.ZipFile(tmp_path / "claim.npz", "w") as archive:
        archive.writestr("states.npy", claim.getvalue())
    with pytest.raises(InputError, match=r"claim\.npz: no readable rollout"):
        read_rollout(tmp_path / "claim.npz")


def test_bad_rollout_files_are_named(tmp_path, rollouts):
    broken, foreign = tmp_path / "broken.npz", tmp_path / "foreign.npz"
    whole = write_rollouts(tmp_path / "good", rollouts, SOURCE)[0].read_bytes()
    broken.write_bytes(whole[: len(whole) // 2])
    np.savez(foreign, format=np.array("other/1"))
    for path in (broken, foreign, tmp_path / "absent.npz"):
        with pytest.raises(InputError, match=path.name):
            read_rollout(path)
    with pytest.raises(InputError, match="no rollouts"):
        read_rollouts(tmp_path / "nowhere")


def test_rows_read_back_are_those_written(tmp_path, rollouts):
    rows = label_rows(score_rollouts(rollouts)[0], SOURCE)
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
    both = label_rows(rows, SOURCE) + label_rows(rows, Source("synthetic", "test", "nominal", "idm"))
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
    assert (
        first["paired"].keys() == {"nominal"}
        and {"difference", "low", "high"} <= first["paired"]["nominal"]["cfr"].keys()
    )
    assert math.isnan(read_metrics(tmp_path / "metrics.json")[0]["metrics"]["transport"]["mean"])
    for where, name in (("metrics", "mean"), ("metrics", "n"), ("paired.nominal", "difference")):
        changed = json.loads(text)
        del reduce(dict.get, where.split("."), changed[0])["cfr"][name]
        (tmp_path / "metrics.json").write_text(json.dumps(changed))
        with pytest.raises(InputError, match=rf"it\[0\]\.{where}\.cfr\.{name} is missing"):
            read_metrics(tmp_path / "metrics.json")


def test_several_intensities_of_one_method_are_told_apart(rollouts):
    rows, features = score_rollouts(rollouts)
    many = [row | {"eta": eta} for eta in (1.0, 2.0) for row in label_rows(rows, SOURCE)]
    many += label_rows(rows, Source("synthetic", "test", "nominal", "idm"))
    many += label_rows(rows, Source("synthetic", "test", "nominal", "lane_graph"))
    result = metric_rows(many, features * 4, draws=10, realism_draws=2)
    assert [list(row["paired"]) for row in result] == [["e2@2", "nominal"], ["e2@1", "nominal"], ["e2@1", "e2@2"], []]
