"""Variants of logs: each makes scenes, and takes away what it says and nothing else."""

from dataclasses import fields, replace

import numpy as np
import pytest

import e2rl
from e2rl.run.errors import InputError
from e2rl.scenes.builder import BuildSettings, build_scene
from e2rl.scenes.bundled import BundledSource
from e2rl.scenes.recording import VEHICLE, Lane, Recording
from e2rl.scenes.scene import validate
from e2rl.scenes.variants import CROP, PARKED, SHIFT, VARIANTS, variant_of

CHANGED = {  # fields of a Recording that a variant may change
    "mirrored": {"states", "lanes", "drivable"},
    "unconnected": {"lanes"},
    "unlit": {"lights"},
    "unlimited": {"lanes"},
    "unmeasured": {"lanes"},
    "unparked": {"states", "valid", "size", "agent_type", "ego"},
    "turned": {"states"},
    "shifted": {"lanes", "drivable"},
    "cropped": {"lanes", "lights"},
    "other_ego": {"ego"},
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


@pytest.mark.parametrize("name", VARIANTS)
def test_a_variant_is_a_scene_and_differs_where_it_says(recordings, name):
    made = [variant_of(each, name) for each in recordings]
    for log, other in zip(recordings, made, strict=True):
        assert other.scene_id == f"{log.scene_id}~{name}"
        differ = {each.name for each in fields(log) if not equal(getattr(log, each.name), getattr(other, each.name))}
        assert differ <= CHANGED[name] | {"scene_id"}
        validate(build_scene(other, BuildSettings()), other.scene_id)
        assert equal(vars(other), vars(variant_of(log, name))), "drawn from the log's own number"
    changed = [not equal(vars(a), vars(b) | {"scene_id": a.scene_id}) for a, b in zip(recordings, made, strict=True)]
    assert any(changed)


def test_a_mirror_in_a_mirror_is_the_log(recordings):
    for log in recordings:
        assert equal(vars(replace(variant_of(log, "mirrored+mirrored"), scene_id=log.scene_id)), vars(log))


def test_who_drives_and_the_ego_are_kept_without_parked_vehicles(recordings):
    for log in recordings:
        other = variant_of(log, "unparked")
        assert np.array_equal(other.states[:, other.ego], log.states[:, log.ego])
        for track, there in zip(other.states.swapaxes(0, 1), other.valid.T, strict=True):
            spread = np.ptp(track[there, :2], axis=0) if there.any() else np.array([np.inf])
            others = other.agent_type[[np.array_equal(track, each) for each in other.states.swapaxes(0, 1)]]
            assert (
                np.linalg.norm(spread) > PARKED
                or (others != VEHICLE).any()
                or np.array_equal(track, other.states[:, other.ego])
            )


def test_maps_are_shifted_and_cropped_by_as_much_as_they_say(recordings):
    for log in recordings:
        moved = variant_of(log, "shifted")
        steps = [np.linalg.norm(moved.lanes[k].points - lane.points, axis=1) for k, lane in log.lanes.items()]
        assert np.allclose(np.concatenate(steps), SHIFT)
        path = log.states[log.valid[:, log.ego], log.ego, :2]
        for lane in variant_of(log, "cropped").lanes.values():
            assert (lane.points > path.min(0) - CROP).all() and (lane.points < path.max(0) + CROP).all()


def test_unknown_variants_are_named():
    with pytest.raises(InputError, match="'unlighted' is none of recorded, mirrored"):
        e2rl.load_scenes("bundled", num_scenes=1, variants=["unlit+unlighted"])
