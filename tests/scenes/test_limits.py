"""Placeholders of speed limits: what no road has, and a high one that map and traffic
contradict."""

import numpy as np
import pytest

from e2rl.scenes.limits import known_limits
from e2rl.scenes.recording import (
    VEHICLE,
    Lane,
    Recording,
)

ARC = np.linspace(-np.pi / 2, 0, 16)


def bend(radius: float) -> np.ndarray:
    """A quarter of a circle [16, 2]."""
    return radius * np.stack([np.cos(ARC), np.sin(ARC)], 1)


STRAIGHT = np.array([[-100.0, 0], [100, 0]])


def limits(
    *lanes: tuple[np.ndarray, float], speed: float
) -> tuple[list[float], list[int]]:
    """What is left of the limits [km/h] of lanes on which a car drives at `speed` m/s,
    and the numbers of those that are not."""
    states = np.zeros((91, 1, 4))
    states[:, 0, 0], states[:, 0, 3] = 0.1 * speed * np.arange(91), speed
    recording = Recording(
        scene_id="made",
        location="",
        dataset="",
        states=states,
        valid=np.ones((91, 1), bool),
        size=np.array([[4.5, 1.9]]),
        agent_type=np.array([VEHICLE]),
        ego=0,
        lanes={
            str(k): Lane(points, speed_limit=limit / 3.6)
            for k, (points, limit) in enumerate(lanes)
        },
    )
    limited, repairs = known_limits(recording)
    return [round(3.6 * lane.speed_limit, 1) for lane in limited.values()], list(
        repairs.values()
    )


@pytest.mark.parametrize("value", [255.0, 1000.0])
def test_a_limit_beyond_any_is_none_and_others_of_the_map_stay(value):
    assert limits((STRAIGHT, value), (STRAIGHT, 50), speed=12) == ([0.0, 50.0], [1])


def test_the_one_high_limit_of_a_map_that_stands_on_turns_of_an_intersection_is_none():
    assert limits(
        (STRAIGHT, 0),
        (bend(10), 100),
        (STRAIGHT, 100),
        speed=9,
    ) == (
        [0.0, 0.0, 0.0],
        [2],
    )
    assert limits((bend(10), 100), speed=20)[0] == [0.0], (
        "no car takes that bend so fast, whoever drives fast beside"
    )


def test_more_than_nearly_all_roads_have_is_none_where_nobody_drives_so_fast():
    assert limits((STRAIGHT, 136.8), (STRAIGHT, 136.8), speed=12)[0] == [0.0, 0.0]
    assert limits((STRAIGHT, 136.8), (STRAIGHT, 136.8), speed=30)[0] == [136.8, 136.8]


@pytest.mark.parametrize("speed", [0, 3, 28])
def test_a_motorway_keeps_its_limit_in_a_jam_too(speed):
    assert limits((STRAIGHT, 100), (bend(400), 100), speed=speed) == (
        [100.0, 100.0],
        [],
    )


LONG = np.array([[-300.0, 0], [900, 0]])
RAMP = 60 * np.stack(
    [np.cos(np.linspace(0, 1.5 * np.pi, 60)), np.sin(np.linspace(0, 1.5 * np.pi, 60))],
    1,
)
KINKED = np.array([[-300.0, 0], [500, 0], [499, 0.1], [512, 0], [520, 0], [900, 0]])


@pytest.mark.parametrize("further", [RAMP, KINKED], ids=["a loop", "a kink"])
@pytest.mark.parametrize("speed", [12, 25])
def test_a_motorway_keeps_its_limit_beside_a_ramp_or_a_kink_of_its_map(further, speed):
    assert limits(*[(LONG, 100)] * 3, (further, 100), speed=speed) == ([100.0] * 4, [])


@pytest.mark.parametrize("turns", [1, 3])
def test_connectors_of_an_intersection_lead_straight_on_too(turns):
    straight = np.array([[0.0, 0], [25, 0]])
    lanes = [(straight, 100)] * 2 + [(bend(12), 100)] * turns
    assert limits(*lanes, (LONG, 0), speed=15)[0] == [0.0] * (turns + 3)


def test_a_map_with_several_limits_knows_them():
    """Converters give the turns of an intersection the limit of their road."""
    assert limits(
        (STRAIGHT, 90),
        (bend(10), 90),
        (STRAIGHT, 50),
        speed=9,
    ) == (
        [90.0, 90.0, 50.0],
        [],
    )
    assert limits((STRAIGHT, 50), (bend(8), 50), speed=5) == ([50.0, 50.0], [])
