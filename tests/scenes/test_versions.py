"""Versions of logs: each makes scenes, and takes away what it says and nothing else."""

from dataclasses import fields, replace

import numpy as np
import pytest

import e2rl
from e2rl.run.errors import InputError
from e2rl.scenes.builder import BuildSettings, build_scene
from e2rl.scenes.bundled import BundledSource
from e2rl.scenes.recording import (
    VEHICLE,
    Lane,
    Recording,
)
from e2rl.scenes.scene import validate
from e2rl.scenes.versions import (
    MOVES,
    VERSIONS,
    version_of,
)

CHANGED = {  # fields of a Recording that a version may change
    "mirrored": {"states", "lanes", "drivable"},
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


def differing(a: object, b: object) -> set[str]:
    return {
        item.name
        for item in fields(a)
        if not equal(getattr(a, item.name), getattr(b, item.name))
    }


@pytest.mark.parametrize("name", VERSIONS)
def test_a_version_is_a_scene_and_differs_where_it_says(recordings, name):
    changed = [version_of(item, name) for item in recordings]
    for log, other in zip(recordings, changed, strict=True):
        assert other.scene_id == f"{log.scene_id}~{name}"
        assert differing(log, other) <= CHANGED[name] | {"scene_id"}
        validate(build_scene(other, BuildSettings()), other.scene_id)
    assert any(
        differing(a, b) - {"scene_id"} for a, b in zip(recordings, changed, strict=True)
    )


def test_a_mirror_in_a_mirror_is_the_log(recordings):
    for log in recordings:
        assert not differing(
            replace(
                version_of(version_of(log, "mirrored"), "mirrored"),
                scene_id=log.scene_id,
            ),
            log,
        )


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
        "mirrored",
        lambda log: replace(log, states=log.states + [1e5, 0, 0, 0]),
    )
    settings = {"cache": str(tmp_path), "workers": 1}
    both = e2rl.load_scenes(
        "bundled",
        num_scenes=3,
        versions=["recorded", "mirrored"],
        **settings,
    )
    assert len(both) == 3
    assert not any("~" in name for name in both.scene_id)
    with pytest.raises(InputError, match="plausible"):
        e2rl.load_scenes(
            "bundled",
            num_scenes=3,
            versions=["mirrored"],
            **settings,
        )


@pytest.mark.parametrize(
    ("versions", "message"),
    [
        (["mirror"], "'mirror' is none of recorded, mirrored"),
        (["mirrored", "mirrored"], "several different ones"),
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
