"""The bundled scenes: what they promise to every other room, and what a damaged archive says."""

import io
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from shapely.geometry import Polygon

from e2rl.run.errors import InputError
from e2rl.scenes import bundled
from e2rl.scenes.boxes import corners
from e2rl.scenes.bundled import CURRENT, FRAMES, SPLITS, SceneMap, load_maps, load_recordings, read_recordings
from e2rl.scenes.interaction import lateral_acceleration, overlap, overlapping_pairs
from e2rl.scenes.paths import WHEELBASE, arc_length
from e2rl.scenes.recording import DT, Lane, Recording

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from scenegen.archive import pack  # noqa: E402


@pytest.fixture(scope="module")
def sets():
    return {split: load_recordings(split) for split in SPLITS}


@pytest.fixture(scope="module")
def recordings(sets):
    return [recording for part in sets.values() for recording in part]


def test_counts_and_splits(sets):
    nets = {split: {recording.location for recording in part} for split, part in sets.items()}
    assert sum(map(len, sets.values())) >= 180
    assert sum(map(len, nets.values())) >= 60
    assert not nets["train"] & nets["test"] and not nets["train"] & nets["tune"] and not nets["tune"] & nets["test"]
    share = len(nets["train"]) / sum(map(len, nets.values()))
    assert 0.5 < share < 0.7
    ids = [recording.scene_id for part in sets.values() for recording in part]
    assert len(set(ids)) == len(ids)


def test_assets_are_small():
    assert sum(len(bundled.asset_bytes(split)) for split in SPLITS) < 10e6


def test_ego_drives_and_keeps_off_the_border(recordings):
    for recording in recordings:
        assert recording.states.shape[0] == FRAMES and recording.current == CURRENT
        assert recording.valid[:, recording.ego].all()
        track = recording.states[CURRENT : CURRENT + 81, recording.ego, :2]
        assert arc_length(track)[-1] > 20.0


def test_speed_is_displacement_along_the_heading(recordings):
    for recording in recordings:
        states, valid = recording.states, recording.valid
        inner = valid[2:] & valid[1:-1] & valid[:-2]
        velocity = (states[2:, :, :2] - states[:-2, :, :2]) / (2 * DT)
        speed, heading = states[1:-1, :, 3], states[1:-1, :, 2]
        along = velocity[..., 0] * np.cos(heading) + velocity[..., 1] * np.sin(heading)
        assert np.abs(along - speed)[inner].max() < 0.05  # positions are kept to 1 mm
        aside = velocity[..., 1] * np.cos(heading) - velocity[..., 0] * np.sin(heading)
        turned = (states[2:, :, 2] - states[:-2, :, 2] + np.pi) % (2 * np.pi) - np.pi
        yaw_rate = turned / (2 * DT)  # a rear axle without side slip, WHEELBASE / 2 lengths behind the centre
        assert np.abs(aside - WHEELBASE / 2 * recording.size[:, 0] * yaw_rate)[inner].max() < 0.05


def test_turning_is_physical(recordings):
    for recording in recordings:
        assert np.abs(lateral_acceleration(recording.states, recording.valid)).max() < 5.05
        turn = np.diff(recording.states[..., 2], axis=0)[recording.valid[1:] & recording.valid[:-1]]
        assert np.abs((turn + np.pi) % (2 * np.pi) - np.pi).max() < 0.15


def test_no_overlaps(recordings):
    for recording in recordings:
        shrunk = recording.size - 0.01  # quantisation
        assert not len(overlapping_pairs(recording.states, recording.valid, shrunk)), recording.scene_id


def test_overlap_agrees_with_shapely():
    rng = np.random.default_rng(0)
    pose = np.concatenate([rng.uniform(-4, 4, (2, 300, 2)), rng.uniform(-4, 4, (2, 300, 1))], -1)
    size = rng.uniform(1, 5, (2, 300, 2))
    ours = overlap(pose[0], size[0], pose[1], size[1])
    boxes = [[Polygon(box) for box in row] for row in corners(torch.from_numpy(pose), torch.from_numpy(size)).numpy()]
    oracle = np.array([a.intersection(b).area > 1e-9 for a, b in zip(*boxes, strict=True)])
    assert (ours == oracle).all() and 0.2 < oracle.mean() < 0.9


def test_lane_ends_meet():
    for split in SPLITS:
        for scene_map in load_maps(split):
            for name, lane in scene_map.lanes.items():
                assert arc_length(lane.points)[-1] >= 1.0, (scene_map.name, name)
                assert 2.5 <= lane.width <= 6.0 and 2.0 < lane.speed_limit < 40.0
                for other in lane.exits:
                    gap = np.linalg.norm(scene_map.lanes[other].points[0] - lane.points[-1])
                    assert gap < 1.01, (scene_map.name, name, other)
                for other in lane.left:
                    assert name in scene_map.lanes[other].right


def test_traffic_keeps_to_lanes_or_kerbs(recordings):
    for recording in recordings[::6]:
        points = np.concatenate([lane.points for lane in recording.lanes.values()])
        moving = recording.valid[CURRENT] & (recording.states[..., 3].max(0) > 1.0)
        here = recording.states[CURRENT, moving, :2]
        gap = np.linalg.norm(here[:, None] - points[None], axis=-1).min(1)
        assert np.mean(gap < 3.5) > 0.9  # vertices lie up to 4 m apart


def test_lights_are_those_of_junction_lanes(recordings):
    lit = [recording for recording in recordings if recording.lights]
    assert len(lit) > 30
    for recording in lit:
        for lane, state in recording.lights.items():
            assert lane in recording.lanes and state.shape == (FRAMES,) and set(np.unique(state)) <= {0, 1, 2, 3}
    assert any(len(np.unique(state)) > 1 for recording in lit for state in recording.lights.values())


def small_set() -> tuple[SceneMap, Recording]:
    rng = np.random.default_rng(1)
    lanes = {
        "a": Lane(np.array([[0.0, 0.0], [50.0, 1.5]]), 3.4, 13.9, ["b"], ["c"]),
        "b": Lane(np.eye(2), 3.5, 8.0),
        "c": Lane(np.array([[0.0, 3.4], [50.0, 5.0]]), 3.4, 13.9, right=["a"]),
    }
    scene_map = SceneMap(
        "here",
        lanes,
        [np.eye(3)[:, :2]],
        {"b": rng.integers(0, 4, 200).astype(np.int8)},
        rng.normal(size=(2, 3)),
        np.full((2, 2), 2.0),
    )
    states = rng.normal(size=(FRAMES, 3, 4)).cumsum(0)
    states[..., 2] = (states[..., 2] + np.pi) % (2 * np.pi) - np.pi
    valid = rng.random((FRAMES, 3)) < 0.8
    valid[:, 1] = True
    states = np.where(valid[..., None], states, 0.0)
    lights = {"b": scene_map.lights["b"][7 : 7 + FRAMES]}
    return scene_map, Recording(
        "x",
        "here",
        "bundled",
        states,
        valid,
        np.full((3, 2), 2.5),
        np.zeros(3, int),
        1,
        lanes,
        scene_map.drivable,
        lights,
    )


def test_round_trip():
    scene_map, made = small_set()
    (read,) = read_recordings(pack([scene_map], [(made, 7)]), "small")
    assert (read.valid == made.valid).all() and read.ego == 1 and read.scene_id == "x" and read.location == "here"
    error = np.abs(read.states - made.states)
    error[..., 2] = np.minimum(error[..., 2], 2 * np.pi - error[..., 2])
    assert error.max() <= 5.1e-4
    assert (read.lights["b"] == made.lights["b"]).all() and read.lanes.keys() == made.lanes.keys()
    for name, lane in made.lanes.items():
        other = read.lanes[name]
        assert np.abs(other.points - lane.points).max() <= 5.1e-4
        assert (other.exits, other.left, other.right) == (lane.exits, lane.left, lane.right)
    assert np.allclose(read.drivable[0], scene_map.drivable[0])


def test_damaged_and_missing_assets(tmp_path, monkeypatch):
    with pytest.raises(InputError, match="damaged"):
        bundled.unpack(bundled.asset_bytes("test")[:5000], "test")
    stream = io.BytesIO()
    np.savez(stream, format=np.array("other/1"))
    with pytest.raises(InputError, match="format other/1"):
        bundled.unpack(stream.getvalue(), "test")
    arrays = dict(bundled.unpack(bundled.asset_bytes("test"), "test"))
    arrays.pop("exits")
    with pytest.raises(InputError, match="do not fit together"):
        read_recordings(arrays, "test")
    with pytest.raises(InputError, match="expected one of train, tune, test"):
        load_recordings("validation")
    monkeypatch.setattr(bundled, "files", lambda _: tmp_path)
    with pytest.raises(InputError, match="missing"):
        load_recordings("test")
