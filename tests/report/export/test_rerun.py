"""Rerun: its reader gets back what was driven, to the nanosecond and in single
precision."""

import numpy as np
import pytest

pytest.importorskip("rerun", reason="--to rerun needs the extra rerun")
from rerun.chunk import RrdReader  # noqa: E402

from tests.report.export.bundled_run import failure_of, gaps  # noqa: E402
from tests.report.export.small_run import exported  # noqa: E402

STEP = 10**8  # ns


@pytest.fixture(scope="module")
def path(bundled, tmp_path_factory):
    (path,) = exported(
        bundled, tmp_path_factory.mktemp("rerun") / "out", "rerun", "--no-scene"
    )
    return path


@pytest.fixture(scope="module")
def columns(path):
    """{entity: {column: [values of each row]}}; times in ns under `time`"""
    entities = {}
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        values = entities.setdefault(chunk.entity_path, {})
        for name, column in zip(batch.schema.names, batch.columns, strict=True):
            if name == "time":
                column = column.cast("int64")
            values.setdefault(name, []).extend(column.to_pylist())
    return entities


@pytest.fixture(scope="module")
def failure(bundled):
    return failure_of(bundled)


def path_of(row: int) -> str:
    return "/scene/traffic/" + ("Ego" if row == 0 else f"agent_{row}")


def series_of(columns, name: str) -> np.ndarray:
    values = columns[name]["Scalars:scalars"]
    return np.array([value for value in values if value is not None]).ravel()


def test_boxes_are_those_of_the_rollout(columns, failure):
    rollout = failure.rollout
    rows = np.flatnonzero(rollout.valid.any(0)).tolist()
    paths = {name for name in columns if name.startswith("/scene/traffic/")}
    assert paths == set(map(path_of, rows))
    for row in rows:
        box = columns[path_of(row)]
        moving = [
            {
                name: box[f"Boxes3D:{name}"][step]
                for name in ("centers", "half_sizes", "quaternions")
            }
            for step in range(len(rollout.states))
        ]
        assert box["time"] == [STEP * step for step in range(len(moving))]
        for step, parts in enumerate(moving):
            present = bool(rollout.valid[step, row])
            assert {len(part) for part in parts.values()} == {int(present)}
            if not present:
                continue
            (centre,) = parts["centers"]
            (half,) = parts["half_sizes"]
            (rotation,) = parts["quaternions"]
            x, y, heading, _ = rollout.states[step, row].tolist()
            assert centre == [x, y, half[2]]
            assert half[:2] == (rollout.size[row] / 2).tolist()
            assert rotation[:2] == [0, 0]
            turn = 2 * np.arctan2(rotation[2], rotation[3]) - heading
            assert abs(np.sin(turn / 2)) < 1e-7


def test_the_frame_of_the_ego_is_in_its_box(columns):
    box = columns[path_of(0)]
    frame = columns["/scene/frame"]
    assert frame["time"] == box["time"]
    assert frame["Transform3D:translation"] == box["Boxes3D:centers"]
    assert frame["Transform3D:quaternion"] == box["Boxes3D:quaternions"]


def test_speeds_and_gaps_are_those_of_the_boxes(columns, failure):
    rollout = failure.rollout
    for row in np.flatnonzero(rollout.valid.any(0)).tolist():
        name = path_of(row).removeprefix("/scene/traffic/")
        speed = np.where(rollout.valid[:, row], rollout.states[:, row, 3], np.nan)
        np.testing.assert_array_equal(series_of(columns, f"/speed/{name}"), speed)
        if row == failure.partner:
            np.testing.assert_array_equal(series_of(columns, "/speed/partner"), speed)
    for name, states in (
        ("Ego", rollout.states[:, 0]),
        ("driver", rollout.driver),
        ("evasion", rollout.evasion),
    ):
        expected = gaps(rollout, states, failure.partner)
        gap = series_of(columns, f"/gap/{name}")
        np.testing.assert_allclose(gap, expected, atol=1e-5)


def test_lines_are_those_of_the_map(columns, failure):
    (strips,) = columns["/scene/map"]["LineStrips3D:strips"]
    rings = [ring.tolist() for ring in failure.rollout.polygons()]
    expected = [ring + ring[:1] for ring in rings]
    expected += [lane.tolist() for lane in failure.rollout.lanes()]
    assert [[point[:2] for point in strip] for strip in strips] == expected


def test_plans_are_those_of_the_ego_and_the_adversary(columns, failure):
    plans = columns["/scene/plans"]
    count = len(failure.rollout.plans)
    assert plans["time"] == [5 * STEP * number for number in range(count)]
    strips = np.array(plans["LineStrips3D:strips"])[..., :2]
    np.testing.assert_array_equal(strips, failure.rollout.plans)


def test_the_verdict_is_that_of_the_table(columns, failure):
    ((text,),) = columns["/verdict"]["TextDocument:text"]
    for name in ("scene_id", "contact_type", "duty"):
        assert f"- {name}: {failure.row[name]}\n" in text


def test_no_clock_of_the_machine_is_a_timeline(path):
    """The viewer would play by it: all motion was written within a moment."""
    for chunk in RrdReader(path).stream().to_chunks():
        assert chunk.timeline_names in ([], ["time"])


def test_failures_are_recordings_of_their_own(run, tmp_path):
    """Each with a blueprint: a viewer joins recordings of one id."""
    paths = exported(run, tmp_path / "out", "rerun")
    readers = [RrdReader(path) for path in paths]
    names = [entry.recording_id for reader in readers for entry in reader.recordings()]
    assert len(set(names)) == len(names) == len(paths) == 2
    assert all(len(reader.blueprints()) == 1 for reader in readers)
