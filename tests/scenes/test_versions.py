"""Versions of logs: each makes scenes, and takes away what it says and nothing else."""

from dataclasses import fields, replace

import numpy as np
import pytest

import e2rl
from e2rl.run.errors import InputError
from e2rl.scenes.builder import BuildSettings, build_scene
from e2rl.scenes.bundled import BundledSource
from e2rl.scenes.lane_graph import LaneGraph
from e2rl.scenes.recording import (
    VEHICLE,
    Lane,
    Recording,
)
from e2rl.scenes.scene import validate
from e2rl.scenes.versions import (
    BESIDE,
    CROP,
    HEADING_NOISE,
    MOVES,
    SHIFT,
    VERSIONS,
    version_of,
)

CHANGED = {  # fields of a Recording that a version may change
    "mirrored": {"states", "lanes", "drivable"},
    "unconnected": {"lanes"},
    "unlit": {"lights"},
    "unlimited": {"lanes"},
    "unmeasured": {"lanes"},
    "unparked": {"states", "valid", "size", "agent_type", "ego", "heights"},
    "turned": {"states"},
    "shifted": {"lanes", "drivable"},
    "cropped": {"lanes", "lights"},
    "other_ego": {"ego"},
}
OF_LANES = {
    "unconnected": {"exits", "left", "right"},
    "unlimited": {"speed_limit"},
    "unmeasured": {"width"},
}


@pytest.fixture(scope="module")
def recordings() -> list[Recording]:
    every = BundledSource().recordings()
    return [next(every) for _ in range(6)]


def equal(a: object, b: object) -> bool:
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b, equal_nan=True)
    if isinstance(a, list):
        return len(a) == len(b) and all(map(equal, a, b))
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(equal(a[key], b[key]) for key in a)
    return equal(vars(a), vars(b)) if isinstance(a, Lane) else a == b


def differing(a: object, b: object) -> set[str]:
    return {
        item.name
        for item in fields(a)
        if not equal(getattr(a, item.name), getattr(b, item.name))
    }


def spread(recording: Recording) -> np.ndarray:
    """The largest distance of each track from its first place, m."""
    result = []
    for track, recorded in zip(
        recording.states.swapaxes(0, 1), recording.valid.T, strict=True
    ):
        xy = track[recorded, :2]
        result.append(np.linalg.norm(xy - xy[:1], axis=1).max() if len(xy) else np.inf)
    return np.array(result)


@pytest.mark.parametrize("name", VERSIONS)
def test_a_version_is_a_scene_and_differs_where_it_says(recordings, name):
    changed = [version_of(item, name) for item in recordings]
    for log, other in zip(recordings, changed, strict=True):
        assert other.scene_id == f"{log.scene_id}~{name}"
        assert differing(log, other) <= CHANGED[name] | {"scene_id"}
        validate(build_scene(other, BuildSettings()), other.scene_id)
        assert equal(vars(other), vars(version_of(log, name))), (
            "drawn from the log's own number"
        )
    assert any(
        differing(a, b) - {"scene_id"} for a, b in zip(recordings, changed, strict=True)
    )


@pytest.mark.parametrize("name", OF_LANES)
def test_of_a_lane_only_what_is_left_out_is_missing(recordings, name):
    for log in recordings:
        for lane, other in zip(
            log.lanes.values(), version_of(log, name).lanes.values(), strict=True
        ):
            assert differing(lane, other) <= OF_LANES[name]
            assert not any(getattr(other, item) for item in OF_LANES[name])


def test_a_mirror_in_a_mirror_is_the_log(recordings):
    for log in recordings:
        assert not differing(
            replace(version_of(log, "mirrored+mirrored"), scene_id=log.scene_id), log
        )


def test_without_parked_vehicles_everybody_stays_who_moves_or_waits_on_a_lane(
    recordings,
):
    left = 0
    for log in recordings:
        other = version_of(log, "unparked")
        gone = []
        assert equal(other.states[:, other.ego], log.states[:, log.ego])
        rest = {track.tobytes() for track in other.states.swapaxes(0, 1)}
        beside = LaneGraph(log.lanes).tree.query(
            log.states[log.valid.argmax(0), np.arange(len(log.size)), :2]
        )[0]
        for k, far in enumerate(spread(log)):
            if log.states[:, k].tobytes() not in rest:
                gone.append(k)
                assert log.agent_type[k] == VEHICLE
                assert far <= MOVES * 1.5
                assert beside[k] > BESIDE - MOVES
        assert len(other.size) + len(gone) == len(log.size)
        left += len(gone)
    assert left > 0


def test_headings_are_off_by_as_much_all_along_a_track_and_the_ego_s_are_not(
    recordings,
):
    off = [
        version_of(log, "turned").states[..., 2] - log.states[..., 2]
        for log in recordings
    ]
    assert all(np.ptp(item, axis=0).max() < 1e-9 for item in off)
    assert not any(
        item[:, log.ego].any() for item, log in zip(off, recordings, strict=True)
    )
    drawn = np.concatenate(
        [np.delete(item[0], log.ego) for item, log in zip(off, recordings, strict=True)]
    )
    assert 0.8 * HEADING_NOISE < drawn.std() < 1.2 * HEADING_NOISE


def test_maps_are_shifted_and_cropped_by_as_much_as_they_say(recordings):
    for log in recordings:
        moved = version_of(log, "shifted")
        steps = [
            moved.lanes[name].points - lane.points for name, lane in log.lanes.items()
        ]
        assert np.allclose(np.linalg.norm(np.concatenate(steps), axis=1), SHIFT)
        path = log.states[log.valid[:, log.ego], log.ego, :2]
        cropped = version_of(log, "cropped").lanes
        for name, lane in log.lanes.items():
            gap = np.linalg.norm(lane.points[:, None] - path, axis=-1).min()
            assert (name in cropped) == (gap < CROP)


def test_another_ego_is_the_one_that_drives_farthest_and_there_must_be_one(recordings):
    result = 0
    for log in recordings:
        driven = np.linalg.norm(log.states[-1, :, :2] - log.states[0, :, :2], axis=-1)
        able = (
            log.valid.all(0)
            & (log.agent_type == VEHICLE)
            & (np.arange(len(driven)) != log.ego)
        )
        if able.any() and driven[able].max() > MOVES:
            other = version_of(log, "other_ego").ego
            result += 1
            assert able[other]
            assert driven[other] == driven[able].max()
    assert result > 0
    alone = replace(log, valid=log.valid & (np.arange(len(driven)) == log.ego))
    assert version_of(alone, "other_ego") is None
    assert version_of(alone, "other_ego+unlit") is None


def test_a_log_without_a_version_makes_the_scenes_of_the_others(monkeypatch, tmp_path):
    original = VERSIONS["other_ego"]
    calls = []

    def some(log):
        calls.append(log.scene_id)
        return None if len(calls) % 2 else original(log)

    recorded = e2rl.load_scenes("bundled", num_scenes=6)
    monkeypatch.setitem(VERSIONS, "other_ego", some)
    settings = {
        "versions": ["recorded", "other_ego"],
        "cache": str(tmp_path),
        "workers": 1,
    }
    both = e2rl.load_scenes(
        "bundled",
        num_scenes=9,
        **settings,
    )
    others = [name for name in both.scene_id if name.endswith("~other_ego")]
    assert len(others) >= 2
    assert len(both) - len(others) > len(others)
    assert (
        recorded.scene_id[:3]
        == [name for name in both.scene_id if name not in others][:3]
    )


def test_an_invalid_version_beside_the_log_is_left_out_and_alone_is_told(
    monkeypatch, tmp_path
):
    monkeypatch.setitem(
        VERSIONS,
        "shifted",
        lambda log: replace(log, states=log.states + [1e5, 0, 0, 0]),
    )
    settings = {"cache": str(tmp_path), "workers": 1}
    both = e2rl.load_scenes(
        "bundled",
        num_scenes=3,
        versions=["recorded", "shifted"],
        **settings,
    )
    assert len(both) == 3
    assert not any("~" in name for name in both.scene_id)
    with pytest.raises(InputError, match="plausible"):
        e2rl.load_scenes(
            "bundled",
            num_scenes=3,
            versions=["shifted"],
            **settings,
        )


@pytest.mark.parametrize(
    ("versions", "message"),
    [
        (["unlit+unlighted"], "'unlighted' is none of recorded, mirrored"),
        (["recorded+unlit"], "'recorded' is none of"),
        (["unlit", "unlit"], "several different ones"),
        ([], "name one or several"),
    ],
)
def test_versions_that_are_none_are_named(versions, message):
    with pytest.raises(InputError, match=message):
        e2rl.load_scenes(
            "bundled",
            num_scenes=1,
            versions=versions,
        )


def test_heights_go_with_their_tracks(recordings):
    """Each track has its own number for a height, and keeps it where others are left
    out."""
    recording = recordings[0]
    number = np.broadcast_to(
        np.arange(recording.valid.shape[1], dtype=float), recording.valid.shape
    )
    whole = replace(recording, heights=number.copy())
    rest = VERSIONS["unparked"](whole)
    assert rest.heights.shape == rest.valid.shape
    assert np.array_equal(whole.states[:, rest.heights[0].astype(int)], rest.states)
