"""Replays of failures: everybody where the rollout has them, the competent driver as its verdict says, small."""

import json

import numpy as np
import pytest

from e2rl.evaluation.rollout_files import Source, write_rollouts
from e2rl.evaluation.rollout_reader import as_rollout_dict, read_rollout
from e2rl.metrics.preventable import AFTER
from e2rl.metrics.score import score_rollouts
from e2rl.report.failure_tracks import CHANNELS, encoded_map, failure_replay
from tests.metrics.random_rollouts import random_rollouts
from tests.metrics.test_contact import course, scene
from tests.report.failed_run import planned
from tests.report.test_encoding import decoded


def replay_of(folder, rollouts):
    """[(rollout, its row, its replay)] of the failures among rollouts, by way of their files."""
    paths = write_rollouts(folder, rollouts, Source("s", "t", "e2", "idm"))
    read = [read_rollout(path) for path in paths]
    rows, _ = score_rollouts(as_rollout_dict(read))
    return [
        (rollout, row, failure_replay(rollout, int(row["contact_step"]), row["partner"]))
        for rollout, row in zip(read, rows, strict=True)
        if row["cfr"] == 1
    ]


def motion_of(replay) -> dict[str, np.ndarray]:
    """{channel: [tracks, K]} of a replay."""
    values = decoded(replay["motion"]).reshape(len(CHANNELS), len(replay["tracks"]), -1).cumsum(-1).cumsum(-1)
    return {name: part * quantum for (name, quantum), part in zip(CHANNELS.items(), values, strict=True)}


def track_of(replay, role) -> int:
    return [track[0] for track in replay["tracks"]].index(role)


def test_everybody_is_where_the_rollout_has_them(tmp_path):
    found = replay_of(tmp_path, random_rollouts(8, seed=21))
    assert len(found) > 2
    for rollout, row, replay in found:
        motion = motion_of(replay)
        steps = motion["x"].shape[1]
        assert steps == min(int(row["contact_step"]) + AFTER + 1, len(rollout["states"]))
        agents = np.flatnonzero(rollout["valid"][:steps].any(0))
        present = rollout["valid"][:steps, agents].T
        np.testing.assert_array_equal(motion["present"][: len(agents)], present)
        for index, name in enumerate(("x", "y")):
            there = rollout["states"][:steps, agents, index].T
            np.testing.assert_allclose(motion[name][: len(agents)][present], there[present], atol=0.0051)
        turn = motion["heading"][: len(agents)] - rollout["states"][:steps, agents, 2].T
        assert np.abs(np.sin(turn / 2)[present]).max() < 0.001
        assert agents[replay["partner"]] == row["partner"]


@pytest.mark.parametrize(("gap", "preventable"), [(30.5, 1), (6.0, 0)])
def test_the_competent_driver_does_what_the_verdict_says(tmp_path, gap, preventable):
    """It brakes for a slower vehicle 30 m ahead; 1 m of gap is too late for it."""
    ((_, row, replay),) = replay_of(tmp_path, scene(course(0, 0, 0, 12), course(gap, 0, 0, 5), adversaries=[1]))
    motion, driver, ego = motion_of(replay), track_of(replay, "driver"), track_of(replay, "ego")
    assert row["preventable"] == preventable
    assert (motion["gap"][driver].min() > 0) == (preventable == 1)
    assert motion["gap"][ego, replay["contact"]] == 0 and (motion["gap"][ego, : replay["contact"]] > 0).all()
    np.testing.assert_allclose(motion["gap"][ego, 0], gap - 4.8, atol=0.01)


def test_roles_say_who_drives(tmp_path):
    courses = course(0, 0, 0, 12), course(30.5, 0, 0, 5), course(-30, 8, 0, 0), course(5, 20, 0, 1)
    rollouts = scene(*courses, kinds=[0, 0, 0, 1], adversaries=[1])
    rollouts["simulated"][0, 2:] = False
    ((_, _, replay),) = replay_of(tmp_path, rollouts)
    roles = [track[0] for track in replay["tracks"]]
    assert roles == ["ego", "adversary", "replayed", "pedestrian", "driver", "recorded"]


def test_plans_and_the_evasion_are_those_of_the_file(tmp_path):
    rollouts = planned(random_rollouts(8, seed=20))
    for rollout, _, replay in replay_of(tmp_path, rollouts):
        motion, plans = motion_of(replay), replay["plans"]
        steps = motion["x"].shape[1]
        np.testing.assert_allclose(motion["y"][track_of(replay, "evasion")], rollout["evasion"][:steps, 1], atol=0.0051)
        agents = np.flatnonzero(rollout["valid"][:steps].any(0))
        known = np.isin(rollout["planners"], agents)
        assert agents[plans["agents"]].tolist() == rollout["planners"][known].tolist()
        points = decoded(plans["points"]).reshape(known.sum(), -1, 2, 10).cumsum(-1).cumsum(-1) * CHANNELS["x"]
        np.testing.assert_allclose(points.transpose(1, 0, 3, 2), rollout["plans"][:, known], atol=0.0051)
        targets = decoded(plans["targets"]).reshape(known.sum(), -1)
        assert (targets[0] == -1).all() and (targets[1:] == track_of(replay, "ego")).all()


def test_the_map_is_the_rollout_s(tmp_path):
    for path in write_rollouts(tmp_path, random_rollouts(4), Source("s", "t", "e2", "idm")):
        rollout = read_rollout(path)
        drawn = encoded_map(rollout)
        for name in ("lane", "drivable"):
            points = decoded(drawn[f"{name}_points"]).reshape(2, -1).cumsum(-1).cumsum(-1) * 0.05
            np.testing.assert_allclose(points.T, rollout[f"{name}_points"], atol=0.0255)
            np.testing.assert_array_equal(decoded(drawn[f"{name}_counts"]), np.diff(rollout[f"{name}_offsets"]))


def test_a_replay_of_48_agents_takes_less_than_25_kb(tmp_path):
    sizes = [len(json.dumps(replay)) for *_, replay in replay_of(tmp_path, planned(random_rollouts(8, seed=20)))]
    assert sizes and max(sizes) < 25_000
