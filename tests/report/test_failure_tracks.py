"""Replays of failures: everybody where the rollout has them, the competent driver as
its verdict says, small; whole numbers come back from their text."""

import base64
import zlib

import numpy as np
import pytest

from e2rl.metrics.preventable import AFTER
from e2rl.metrics.score import score_rollouts
from e2rl.report.failure_tracks import CHANNELS, encode, encoded_map, failure_replay
from e2rl.sim.rollout_file import Failure
from tests.metrics.random_rollouts import random_rollouts
from tests.metrics.test_contact import course, scene
from tests.report.failed_run import planned


def decoded(text: str) -> np.ndarray:
    """What decode.js does."""
    planes = (
        np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8)
        .reshape(4, -1)
        .astype(np.uint32)
    )
    code = sum(plane << 8 * k for k, plane in enumerate(planes))
    return (code >> 1).astype(np.int64) ^ -(code & 1).astype(np.int64)


def replays_of(rollouts):
    """[(rollout, its row, its replay)] of the failures among rollouts."""
    rows = score_rollouts(rollouts)[0]
    result = [
        Failure(rollouts.rollout(index), row)
        for index, row in enumerate(rows)
        if row["cfr"] == 1
    ]
    return [
        (failure.rollout, failure.row, failure_replay(failure)) for failure in result
    ]


def motion_of(replay) -> dict[str, np.ndarray]:
    """{channel: [tracks, K]} of a replay."""
    values = (
        decoded(replay["motion"])
        .reshape(len(CHANNELS), len(replay["tracks"]), -1)
        .cumsum(-1)
        .cumsum(-1)
    )
    return {
        name: part * quantum
        for (name, quantum), part in zip(CHANNELS.items(), values, strict=True)
    }


def track_of(replay, role) -> int:
    return [track[0] for track in replay["tracks"]].index(role)


def test_everybody_is_where_the_rollout_has_them():
    result = replays_of(random_rollouts(8, seed=21))
    assert len(result) > 2
    for rollout, row, replay in result:
        motion = motion_of(replay)
        steps = motion["x"].shape[1]
        assert steps == min(int(row["contact_step"]) + AFTER + 1, len(rollout.states))
        agents = np.flatnonzero(rollout.valid[:steps].any(0))
        present = rollout.valid[:steps, agents].T
        np.testing.assert_array_equal(motion["present"][: len(agents)], present)
        for index, name in enumerate(("x", "y")):
            place = rollout.states[:steps, agents, index].T
            np.testing.assert_allclose(
                motion[name][: len(agents)][present], place[present], atol=0.0051
            )
        turn = motion["heading"][: len(agents)] - rollout.states[:steps, agents, 2].T
        assert np.abs(np.sin(turn / 2)[present]).max() < 0.001
        assert agents[replay["partner"]] == row["partner"]


@pytest.mark.parametrize(("gap", "preventable"), [(30.5, 1), (6.0, 0)])
def test_the_competent_driver_does_what_the_verdict_says(gap, preventable):
    """It brakes for a slower vehicle 30 m ahead; 1 m of gap is too late for it."""
    ((_, row, replay),) = replays_of(
        scene(
            course(0, 0, heading=0, speed=12),
            course(gap, 0, heading=0, speed=5),
            adversaries=[1],
        )
    )
    motion = motion_of(replay)
    driver = track_of(replay, "driver")
    ego = track_of(replay, "ego")
    assert row["preventable"] == preventable
    assert (motion["gap"][driver].min() > 0) == (preventable == 1)
    assert motion["gap"][ego, replay["contact"]] == 0
    assert (motion["gap"][ego, : replay["contact"]] > 0).all()
    np.testing.assert_allclose(motion["gap"][ego, 0], gap - 4.8, atol=0.01)


def test_plans_and_the_evasion_are_those_of_the_file():
    rollout, _, replay = replays_of(planned(random_rollouts(8, seed=20)))[0]
    motion = motion_of(replay)
    plans = replay["plans"]
    steps = motion["x"].shape[1]
    np.testing.assert_allclose(
        motion["y"][track_of(replay, "evasion")],
        rollout.evasion[:steps, 1],
        atol=0.0051,
    )
    agents = np.flatnonzero(rollout.valid[:steps].any(0))
    certain = np.isin(rollout.planners, agents)
    assert agents[plans["agents"]].tolist() == rollout.planners[certain].tolist()
    points = (
        decoded(plans["points"]).reshape(certain.sum(), -1, 2, 10).cumsum(-1).cumsum(-1)
        * CHANNELS["x"]
    )
    np.testing.assert_allclose(
        points.transpose(1, 0, 3, 2), rollout.plans[:, certain], atol=0.0051
    )
    assert (
        decoded(plans["targets"]).reshape(certain.sum(), -1)[1:]
        == track_of(replay, "ego")
    ).all()


def test_the_map_is_the_rollout_s():
    rollout = random_rollouts(4).rollout(2)
    drawn = encoded_map(rollout)
    for name in ("lane", "drivable"):
        points = (
            decoded(drawn[f"{name}_points"]).reshape(2, -1).cumsum(-1).cumsum(-1) * 0.05
        )
        np.testing.assert_allclose(
            points.T, getattr(rollout, f"{name}_points"), atol=0.0255
        )
        np.testing.assert_array_equal(
            decoded(drawn[f"{name}_counts"]),
            np.diff(getattr(rollout, f"{name}_offsets")),
        )


def test_numbers_of_31_bits_come_back_whatever_their_sign():
    numbers = np.array(
        [0, -1, 1, 2**30, -(2**30), 2**31 - 1, -(2**31), *range(-300, 300, 7)]
    )
    np.testing.assert_array_equal(decoded(encode(numbers)), numbers)
