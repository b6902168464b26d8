"""Procedural traffic is physically sound, obeys lights, and is the same for the same seed."""

import numpy as np
import pytest

from e2rl.run.errors import InputError
from e2rl.scenes.bundled import CURRENT, load_maps
from e2rl.scenes.interaction import lateral_acceleration, overlapping_pairs
from e2rl.scenes.paths import WHEELBASE
from e2rl.scenes.procedural import ProceduralSource
from e2rl.scenes.recording import DT, LIGHT_RED, Recording
from e2rl.scenes.traffic_flow import Fleet, conflicts, roll


def generate(count: int, seed: int, split: str) -> list[Recording]:
    return list(ProceduralSource(split=split, count=count, seed=seed).recordings())


@pytest.fixture(scope="module")
def recordings():
    return generate(20, 5, "tune")


def straight(angle: float, start, limit: float = 12.0, steps: int = 200) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    path = np.array(start) + np.arange(steps)[:, None] * np.array([np.cos(angle), np.sin(angle)])
    return path, np.full(steps, angle), np.full(steps, limit)


def fleet(lines, begin, speed) -> Fleet:
    front, heading, limit = (np.stack(part) for part in zip(*lines, strict=True))
    count = len(lines)
    return Fleet(
        front,
        front,
        heading,
        limit,
        np.full(count, 190.0),
        np.array(begin, float),
        np.tile([4.6, 1.9], (count, 1)),
        np.full(count, 1.6),
        np.full(count, 2.0),
        np.full(count, 1.3),
        np.full(count, 2.0),
        np.array(speed, float),
    )


def test_free_vehicle_reaches_its_speed():
    progress = roll(fleet([straight(0, (0, 0))], [0], [4.0]), 150)
    assert np.diff(progress[:, 0])[-1] / DT == pytest.approx(12.0, rel=0.02)


def test_follower_stops_behind_a_standing_leader():
    lines = [straight(0, (0, 0)), straight(0, (0, 0), limit=0.0)]
    progress = roll(fleet(lines, [0, 80], [11.0, 0.0]), 250)
    gap = progress[-1, 1] - progress[-1, 0] - 4.6
    assert 1.0 < gap < 4.5


def test_red_light_stops_and_green_does_not():
    closed = np.ones(250, bool)
    for shut, stops in ((closed, True), (~closed, False)):
        made = fleet([straight(0, (0, 0))], [0], [10.0])
        made.lights = [(0, 90.0, shut)]
        end = roll(made, 150)[-1, 0]
        assert (end + 2.3 < 90.0) == stops


def test_crossing_vehicles_pass_one_after_another():
    made = fleet([straight(0, (0, 0)), straight(np.pi / 2, (70, -69))], [0, 0], [10.0, 10.0])
    enter, leave = conflicts(made)
    assert enter[0, 1] == pytest.approx(68, abs=3) and leave[0, 1] > enter[0, 1]
    progress = roll(made, 250)
    xy = np.stack([made.front[k, np.clip(progress[:, k].round().astype(int), 0, 199)] for k in range(2)], 1)
    states = np.concatenate([xy, np.broadcast_to([[[0.0], [np.pi / 2]]], (250, 2, 1)), np.zeros((250, 2, 1))], -1)
    assert not len(overlapping_pairs(states, np.ones((250, 2), bool), made.size))
    assert (progress[-1] > 100).all()


def test_recordings_are_sound(recordings):
    for recording in recordings:
        states, valid = recording.states, recording.valid
        assert not len(overlapping_pairs(states, valid, recording.size))
        assert np.abs(lateral_acceleration(states, valid)).max() <= 5.0
        inner = valid[2:] & valid[1:-1] & valid[:-2]
        velocity = (states[2:, :, :2] - states[:-2, :, :2]) / (2 * DT)
        heading, speed = states[1:-1, :, 2], states[1:-1, :, 3]
        along = velocity[..., 0] * np.cos(heading) + velocity[..., 1] * np.sin(heading)
        assert np.abs(along - speed)[inner].max() < 1e-6
        aside = velocity[..., 1] * np.cos(heading) - velocity[..., 0] * np.sin(heading)
        turned = (states[2:, :, 2] - states[:-2, :, 2] + np.pi) % (2 * np.pi) - np.pi
        yaw_rate = turned / (2 * DT)  # a rear axle without side slip, WHEELBASE / 2 lengths behind the centre
        assert np.abs(aside - WHEELBASE / 2 * recording.size[:, 0] * yaw_rate)[inner].max() < 0.1
        accel = np.diff(speed, axis=0)[inner[1:] & inner[:-1]] / DT
        assert np.abs(accel).max() < 8.0
        way = np.linalg.norm(np.diff(states[CURRENT : CURRENT + 81, recording.ego, :2], axis=0), axis=-1).sum()
        assert valid[:, recording.ego].all() and way > 19.0


def test_hardly_a_vehicle_enters_on_red(recordings):
    entries, on_red = 0, 0
    for recording in recordings:
        for name, state in recording.lights.items():
            lane = recording.lanes[name].points
            unit = (lane[1] - lane[0]) / np.linalg.norm(lane[1] - lane[0])
            ahead = (recording.states[..., :2] - lane[0]) @ unit
            aside = np.abs((recording.states[..., :2] - lane[0]) @ np.array([-unit[1], unit[0]]))
            facing = np.cos(recording.states[..., 2] - np.arctan2(unit[1], unit[0])) > 0.9
            crossed = (ahead[:-1] < 0) & (ahead[1:] >= 0) & (aside[1:] < 1.0) & facing[1:]
            crossed &= recording.valid[1:] & recording.valid[:-1]
            frames = np.nonzero(crossed)[0]
            entries += len(frames)
            on_red += int((state[frames + 1] == LIGHT_RED).sum())
    assert entries > 10 and on_red <= 0.1 * entries, (entries, on_red)


def test_seed_and_split_decide():
    first, again = generate(2, 9, "test"), generate(2, 9, "test")
    other = generate(1, 10, "test")
    for a, b in zip(first, again, strict=True):
        assert np.array_equal(a.states, b.states) and a.location == b.location and a.ego == b.ego
    assert first[0].states.shape != other[0].states.shape or not np.array_equal(first[0].states, other[0].states)
    assert {recording.location for recording in first} <= {scene_map.name for scene_map in load_maps("test")}


def test_bad_input():
    with pytest.raises(InputError, match="at least 1"):
        generate(0, 0, "test")
    with pytest.raises(InputError, match="expected one of"):
        generate(1, 0, "nowhere")
