"""The bundled scenes: what they promise to every other room, and what a damaged archive
says."""

import sys
from pathlib import Path

import numpy as np
import pytest

from e2rl.run.errors import InputError
from e2rl.scenes import bundled
from e2rl.scenes.bundled import (
    CURRENT,
    FRAMES,
    SPLITS,
    asset_bytes,
    read_maps,
    read_recordings,
    unpack,
)
from e2rl.scenes.paths import (
    WHEELBASE,
    arc_length,
    wrap,
)
from e2rl.scenes.recording import (
    DT,
    Lane,
    Recording,
)

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from scenegen.archive import Place, pack  # noqa: E402
from scenegen.interaction import lateral_acceleration, overlapping_pairs  # noqa: E402


@pytest.fixture(scope="module")
def sets():
    return {split: read_recordings(unpack(split)) for split in SPLITS}


@pytest.fixture(scope="module")
def recordings(sets):
    return [recording for part in sets.values() for recording in part]


def test_splits_share_no_place_and_are_small(sets):
    nets = {
        split: {recording.location for recording in part}
        for split, part in sets.items()
    }
    assert sum(map(len, sets.values())) >= 180
    assert sum(map(len, nets.values())) >= 60
    assert not nets["train"] & nets["test"]
    assert not nets["train"] & nets["tune"]
    assert not nets["tune"] & nets["test"]
    assert 0.5 < len(nets["train"]) / sum(map(len, nets.values())) < 0.7
    ids = [recording.scene_id for part in sets.values() for recording in part]
    assert len(set(ids)) == len(ids)
    assert sum(len(asset_bytes(split)) for split in SPLITS) < 10e6


def test_traffic_is_physical_and_the_ego_drives(recordings):
    for recording in recordings:
        states = recording.states
        valid = recording.valid
        assert len(states) == FRAMES
        assert recording.current == CURRENT
        assert valid[:, recording.ego].all()
        assert arc_length(states[CURRENT : CURRENT + 81, recording.ego, :2])[-1] > 20.0
        inner = valid[2:] & valid[1:-1] & valid[:-2]
        velocity = (states[2:, :, :2] - states[:-2, :, :2]) / (2 * DT)
        speed = states[1:-1, :, 3]
        heading = states[1:-1, :, 2]
        along = velocity[..., 0] * np.cos(heading) + velocity[..., 1] * np.sin(heading)
        assert np.abs(along - speed)[inner].max() < 0.05  # positions are kept to 1 mm
        aside = velocity[..., 1] * np.cos(heading) - velocity[..., 0] * np.sin(heading)
        yaw_rate = wrap(states[2:, :, 2] - states[:-2, :, 2]) / (2 * DT)
        slip = (
            aside - WHEELBASE / 2 * recording.size[:, 0] * yaw_rate
        )  # 0 of a rear axle that follows
        assert np.abs(slip)[inner].max() < 0.05
        assert np.abs(lateral_acceleration(states, valid)).max() < 5.05
        assert (
            np.abs(wrap(np.diff(states[..., 2], axis=0)))[valid[1:] & valid[:-1]].max()
            < 0.15
        )
        assert not len(overlapping_pairs(states, valid, recording.size - 0.01)), (
            recording.scene_id
        )  # quantisation


def test_lane_ends_meet():
    for split in SPLITS:
        for scene_map in read_maps(unpack(split)):
            for name, lane in scene_map.lanes.items():
                assert arc_length(lane.points)[-1] >= 1.0, (scene_map.name, name)
                assert 2.5 <= lane.width <= 6.0
                assert 2.0 < lane.speed_limit < 40.0
                for other in lane.exits:
                    gap = np.linalg.norm(
                        scene_map.lanes[other].points[0] - lane.points[-1]
                    )
                    assert gap < 1.01, (scene_map.name, name, other)
                for other in lane.left:
                    assert name in scene_map.lanes[other].right


def small_set() -> tuple[Place, Recording]:
    rng = np.random.default_rng(1)
    lanes = {
        "a": Lane(
            np.array([[0.0, 0.0], [50.0, 1.5]]),
            3.4,
            speed_limit=13.9,
            exits=["b"],
            left=["c"],
        ),
        "b": Lane(np.eye(2), 3.5, speed_limit=8.0),
        "c": Lane(
            np.array([[0.0, 3.4], [50.0, 5.0]]),
            3.4,
            speed_limit=13.9,
            right=["a"],
        ),
    }
    lights = {"b": rng.integers(0, 4, 200).astype(np.int8)}
    scene_map = Place(
        "here",
        lanes,
        [np.eye(3)[:, :2]],
        lights,
        rng.normal(size=(2, 3)),
        np.full((2, 2), 2.0),
    )
    states = rng.normal(size=(FRAMES, 3, 4)).cumsum(0)
    states[..., 2] = (states[..., 2] + np.pi) % (2 * np.pi) - np.pi
    valid = rng.random((FRAMES, 3)) < 0.8
    valid[:, 1] = True
    states = np.where(valid[..., None], states, 0.0)
    recording = scene_map.recording(
        "x",
        first=7,
        states=states,
        valid=valid,
        size=np.full((3, 2), 2.5),
        ego=1,
    )
    return scene_map, recording


def test_round_trip():
    scene_map, packed = small_set()
    (read,) = read_recordings(pack([scene_map], [(packed, 7)]))
    assert (read.valid == packed.valid).all()
    assert read.ego == 1
    assert read.scene_id == "x"
    assert read.location == "here"
    error = np.abs(read.states - packed.states)
    error[..., 2] = np.minimum(error[..., 2], 2 * np.pi - error[..., 2])
    assert error.max() <= 5.1e-4
    assert (read.lights["b"] == packed.lights["b"]).all()
    assert read.lanes.keys() == packed.lanes.keys()
    for name, lane in packed.lanes.items():
        other = read.lanes[name]
        assert np.abs(other.points - lane.points).max() <= 5.1e-4
        assert (other.exits, other.left, other.right) == (
            lane.exits,
            lane.left,
            lane.right,
        )
    assert np.allclose(read.drivable[0], scene_map.drivable[0])


def test_an_unknown_split_and_a_damaged_archive_are_named(monkeypatch):
    with pytest.raises(InputError, match="expected one of train, tune, test"):
        read_recordings(unpack("validation"))
    monkeypatch.setitem(
        bundled.SHA256, "test", "0" * 64
    )  # as where the file is another one
    with pytest.raises(InputError, match="damaged"):
        read_recordings(unpack("test"))
