"""Mutations of logs of every format say in their own files what they say; what must not pass is told from what may."""

import csv
import warnings

import numpy as np
import pytest

from e2rl.scenes.bundled import load_recordings
from e2rl.scenes.scenarionet import ScenarioNetSource, recording_of
from tests.scenes.test_argoverse2 import write_scenario, write_sensor_log
from tools.fuzz.corpus import description
from tools.mutate import __main__ as mutate
from tools.mutate import formats
from tools.mutate.argoverse2 import ScenarioLog, SensorLog, map_lines, map_of
from tools.mutate.formats import source_of
from tools.mutate.kinds import KINDS, READ, REFUSED
from tools.mutate.scenarionet import ScenarioNetLog


@pytest.fixture(scope="module")
def log():
    return ScenarioNetLog.of("made.pkl", description(load_recordings("tune")[0]))


def test_an_unchanged_log_is_written_as_it_was(log):
    ours, theirs = (recording_of(data, "x") for data in (log.changed(lambda own: None).description(), log.data))
    for name in ("states", "valid", "size", "agent_type"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
    assert list(ours.lanes) == list(theirs.lanes)
    assert all((ours.lanes[name].points == theirs.lanes[name].points).all() for name in ours.lanes)


def test_a_change_does_not_reach_the_whole_log(log):
    before = log.position.copy()
    for kind in KINDS.values():
        log.changed(kind.change).description()
    np.testing.assert_array_equal(log.position, before)
    assert "a twin" not in log.data["tracks"] and "added" not in log.data["map_features"]


CHEAP = [
    ("headings in degrees", "is the largest heading"),
    ("map mirrored", "from the nearest lane|along a lane"),
    ("all in feet", "length"),
    ("one vehicle in feet", "of a vehicle"),
    ("time stamps in milliseconds", "time stamps"),
    ("a track twice under one id", "two of its tracks"),
    ("a track twice under two ids", "at the same place"),
    ("types of an unknown kind", "unknown type"),
    ("current_time_index of infinity", "is no frame"),
    ("map and tracks mirrored", ""),
    ("late tracks", ""),
    ("a lane of no length", ""),
]


@pytest.mark.parametrize(("name", "reason"), CHEAP)
def test_what_must_be_refused_is_and_what_may_be_is_read(log, name, reason):
    found, why, _ = mutate.mutated(ScenarioNetSource(), log, KINDS[name])
    assert found == KINDS[name].expected == (REFUSED if reason else READ)
    if reason:
        assert any(part in why for part in reason.split("|")), why


@pytest.mark.parametrize("kind", [ScenarioLog, SensorLog])
def test_argoverse_logs_are_written_in_their_own_form(tmp_path, kind):
    from tests.scenes.test_argoverse2 import Argoverse2Source

    root = write_scenario(tmp_path / "all") if kind is ScenarioLog else write_sensor_log(tmp_path / "all")
    source = source_of(str(root))
    assert isinstance(source, Argoverse2Source)
    path = root / source.logs()[0]
    whole, (before,) = kind.of(path), source.recordings()
    for name, change in (("same", lambda log: None), ("moved", lambda log: KINDS["all 300 km away"].change(log))):
        (tmp_path / name).mkdir()
        whole.changed(change).write(tmp_path / name)
        (after,) = source_of(str(tmp_path / name)).recordings()
        away = 0.0 if name == "same" else 3e5
        known = before.valid
        np.testing.assert_array_equal(after.valid, known)
        np.testing.assert_allclose(after.states[known][:, :2], before.states[known][:, :2] + away, atol=1e-3)
        np.testing.assert_allclose(np.cos(after.states[known][:, 2] - before.states[known][:, 2]), 1, atol=1e-6)
        np.testing.assert_allclose(map_lines(map_of(tmp_path / name))[0], whole.lines[0] + away)


def test_the_record_goes_on_and_the_table_names_what_went_otherwise(tmp_path, monkeypatch, log, capsys):
    folder, record = tmp_path / "logs", tmp_path / "record.csv"
    folder.mkdir()
    log.write(folder)
    monkeypatch.setattr("sys.argv", ["mutate", str(folder), "--kinds", "current_time_index", "--record", str(record)])
    assert mutate.main() == 0
    said = capsys.readouterr().out
    assert "| current_time_index of infinity | refused | 1 | 1 | 0 | 0 |" in said and "must be: 0" in said
    rows = list(csv.DictReader(record.open()))
    assert [row["outcome"] for row in rows] == ["read"] + ["refused"] * 6 and rows[0]["kind"] == mutate.GENUINE
    rows[-1] |= {"outcome": "read", "reason": ""}
    with record.open("w", newline="") as file:
        writer = csv.DictWriter(file, mutate.COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    assert mutate.main() == 1 and len(list(csv.DictReader(record.open()))) == len(rows)
    assert f"{rows[-1]['kind']}: {folder}: made.pkl: read" in capsys.readouterr().out
    warnings.resetwarnings()


def test_of_a_log_that_makes_no_scene_nothing_else_is_tried(tmp_path, log):
    short = log.changed(lambda own: None)
    short.edits.append(lambda data: data["metadata"].update(current_time_index=1e9))
    short.write(tmp_path)
    (row,) = mutate.run([str(tmp_path)], 1, "", tmp_path / "record.csv")
    assert row["kind"] == mutate.GENUINE and row["outcome"] == REFUSED


def test_without_its_library_no_log_of_a_format_counts_as_refused(tmp_path, monkeypatch):
    (tmp_path / "log.xml").write_text("<commonRoad/>")
    monkeypatch.setattr(formats, "find_spec", lambda name: None)
    with pytest.raises(SystemExit, match="needs commonroad; install"):
        source_of(str(tmp_path))
