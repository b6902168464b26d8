"""Trailers: what is towed at one distance is one vehicle with its tractor, or shown by
a replay alone."""

import numpy as np
import pytest

from e2rl.scenes.builder import BuildSettings, build_scene
from e2rl.scenes.recording import Lane, Recording
from e2rl.scenes.trailers import (
    JOINED,
    TURNING,
    couple,
)

FRAMES = 91
TIME = 0.1 * np.arange(FRAMES)


def recording(*tracks: np.ndarray, sizes: list[tuple[float, float]]) -> Recording:
    """An ego at 12 m/s beside tracks [F, 4] of vehicles, on a straight road of two
    lanes."""
    states = np.stack([driving(-60.0, 0.0, speed=12.0), *tracks], 1)
    lanes = {
        name: Lane(np.array([[-300.0, y], [600.0, y]]), 3.5)
        for name, y in (("0", 0.0), ("1", 3.5))
    }
    valid = np.ones(states.shape[:2], bool)
    kinds = np.zeros(states.shape[1], int)
    return Recording(
        "towed",
        "road",
        dataset="made",
        states=states,
        valid=valid,
        size=np.array([(4.5, 1.9), *sizes]),
        agent_type=kinds,
        ego=0,
        lanes=lanes,
    )


def driving(
    x: float,
    y: float,
    speed,
) -> np.ndarray:
    """A track [F, 4] along +x at a speed, or at speeds [F]."""
    speed = np.broadcast_to(speed, FRAMES)
    way = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * 0.1)])
    return np.stack([x + way, np.full(FRAMES, y), np.zeros(FRAMES), speed], 1)


def on_a_circle(
    behind: float,
    radius: float,
    speed: float = 8.0,
) -> np.ndarray:
    """A track [F, 4] to the left on a circle around (0, radius), so many metres behind
    the first."""
    angle = (speed * TIME - behind) / radius
    return np.stack(
        [
            radius * np.sin(angle),
            radius * (1 - np.cos(angle)),
            angle,
            np.full(FRAMES, speed),
        ],
        1,
    )


@pytest.mark.parametrize("gap", [-0.3, 0.1, 0.4, 1.5])
@pytest.mark.parametrize(
    "speed", [15.0, np.clip(15 - 2 * TIME, 0, None), 8 + 3 * np.sin(TIME)]
)
def test_a_trailer_is_one_vehicle_with_its_tractor(gap, speed):
    log = recording(
        driving(10, 3.5, speed=speed),
        driving(1 - gap, 3.5, speed=speed),
        sizes=[(6, 2.4), (12, 2.6)],
    )
    coupled = couple(log)
    assert coupled.repairs == {JOINED: 1}
    assert coupled.valid.any(0).tolist() == [
        True,
        True,
        False,
    ]
    assert coupled.size[1].tolist() == pytest.approx([18 + gap, 2.6])
    middle = (log.states[:, 1, 0] + 3 + log.states[:, 2, 0] - 6) / 2
    assert coupled.states[:, 1, 0] == pytest.approx(middle)
    assert coupled.states[:, 1, 3] == pytest.approx(log.states[:, 1, 3])
    assert build_scene(coupled, BuildSettings(field_cells=32))["valid"].sum() == 2


def test_a_road_train_is_one_vehicle_and_stays_where_it_is_while_one_part_is_hidden():
    tracks = [driving(10 - behind, 3.5, speed=15.0) for behind in (0.0, 8.5, 17.0)]
    log = recording(*tracks, sizes=[(6, 2.4), (10, 2.5), (6, 2.5)])
    log.valid[40:50, 3] = log.valid[60:70, 1] = False
    coupled = couple(log)
    assert coupled.repairs == {JOINED: 2}
    assert coupled.valid[:, 1].all()
    assert not coupled.valid[:, 2:].any()
    assert np.diff(coupled.states[:, 1, 0]) == pytest.approx(np.full(FRAMES - 1, 1.5))


@pytest.mark.parametrize("part", [1, 2])
def test_a_long_box_stays_on_its_bend_while_one_part_is_hidden(part):
    whole = recording(
        on_a_circle(0, 70), on_a_circle(9.3, 70), sizes=[(6, 2.4), (12, 2.6)]
    )
    log = recording(
        on_a_circle(0, 70), on_a_circle(9.3, 70), sizes=[(6, 2.4), (12, 2.6)]
    )
    log.valid[40:55, part] = log.valid[62:64, part] = False
    expected = couple(whole).states[:, 1]
    coupled = couple(log).states[:, 1]
    assert np.abs(coupled[:, 2] - expected[:, 2]).max() < 0.01
    assert np.linalg.norm(coupled[:, :2] - expected[:, :2], axis=-1).max() < 0.05


def test_a_trailer_that_is_lost_from_sight_comes_in_line_within_two_seconds():
    log = recording(
        on_a_circle(0, 70), on_a_circle(9.3, 70), sizes=[(6, 2.4), (12, 2.6)]
    )
    log.valid[50:, 2] = False
    angle = couple(log).states[:, 1, 2] - log.states[:, 1, 2]
    assert angle[49] < -0.05
    assert np.abs(np.diff(angle)).max() < 0.01
    assert np.allclose(angle[69:], 0)


def test_a_trailer_that_turns_is_shown_by_a_replay_alone_and_counted():
    log = recording(
        on_a_circle(0, 15), on_a_circle(9.3, 15), sizes=[(6, 2.4), (12, 2.6)]
    )
    coupled = couple(log)
    assert coupled.repairs == {TURNING: 1}
    assert coupled.towed == (2,)
    scene = build_scene(coupled, BuildSettings(field_cells=32))
    assert scene["valid"].sum() == 2
    assert scene["logged_valid"].any(0).sum() >= 2
    ego_pulls = couple(Recording(**{**vars(log), "ego": 1}))
    assert not ego_pulls.valid[:, 2].any()
    assert ego_pulls.repairs == {TURNING: 1}


@pytest.mark.parametrize(
    ("speed", "distance"),
    [(15.0, 6.0), (2.0, 1.5), (0.0, 0.3), (np.clip(TIME, 0, 4), 1.5)],
    ids=["follows", "creeps in a queue", "stands", "queue begins to drive"],
)
def test_vehicles_that_follow_each_other_are_two(speed, distance):
    log = recording(
        driving(10, 3.5, speed=speed),
        driving(10 - 4.5 - distance, 3.5, speed=speed),
        sizes=[(4.5, 1.9)] * 2,
    )
    assert not couple(log).repairs
    assert couple(log).valid.all()


def test_who_comes_nearer_is_no_trailer():
    log = recording(
        driving(10, 3.5, speed=10.0),
        driving(4.8, 3.5, speed=9.9),
        sizes=[(4.5, 1.9)] * 2,
    )
    assert not couple(log).repairs


@pytest.mark.parametrize(("aside", "back"), [(1.2, 0.0), (1.6, 1.0)])
def test_who_rides_beside_another_is_no_trailer(aside, back):
    log = recording(
        driving(10, 3.5, speed=12.0),
        driving(10 - back, 3.5 + aside, speed=12.0),
        sizes=[(2.2, 0.8)] * 2,
    )
    assert not couple(log).repairs


def test_the_ego_of_another_window_is_no_trailer():
    log = recording(
        driving(10, 3.5, speed=15.0),
        driving(0.7, 3.5, speed=15.0),
        sizes=[(6, 2.4), (12, 2.6)],
    )
    assert couple(log).repairs == {JOINED: 1}
    assert not couple(Recording(**{**vars(log), "egos": {40: 2}})).repairs


@pytest.mark.parametrize("gaps", [(0.3, 0.5), (0.5, 0.3)])
def test_both_trailers_of_a_road_train_that_turns_are_shown_by_a_replay_alone(gaps):
    first = 6 / 2 + gaps[0] + 6 / 2
    second = first + 6 / 2 + gaps[1] + 6 / 2
    log = recording(
        on_a_circle(0, 15),
        on_a_circle(first, 15),
        on_a_circle(second, 15),
        sizes=[(6, 2.4)] * 3,
    )
    assert sorted(couple(log).towed) == [2, 3]
