"""CommonRoad XML: what a scenario says arrives in the Recording, entities and nonsense
are refused by name."""

import re

import numpy as np
import pytest

from e2rl.run.errors import InputError
from e2rl.scenes.recording import (
    LIGHT_GREEN,
    LIGHT_RED,
    OTHER,
    PEDESTRIAN,
    VEHICLE,
)

pytest.importorskip("commonroad", reason="data=commonroad needs the extra commonroad")
from e2rl.scenes.commonroad import CommonRoadSource, read_scenario
from tests.scenes.descriptions import recordings_in

LANELETS_FOR_OTHERS = {
    "sidewalk",
    "crosswalk",
    "bicycleLane",
    "busStop",
    "border",
    "parking",
    "restricted",
    "shoulder",
}
LANELETS_FOR_OTHERS |= {"busLane", "restricted_area"}


def exact(name: str, value: float) -> str:
    return f"<{name}><exact>{value}</exact></{name}>"


def state(
    name: str,
    step: int,
    x: float,
    y: float,
    heading: float = 0.0,
    speed: float = 8.0,
) -> str:
    position = f"<position><point><x>{x}</x><y>{y}</y></point></position>"
    values = (
        exact("orientation", heading) + exact("time", step) + exact("velocity", speed)
    )
    return f"<{name}>{position}{values}</{name}>"


def obstacle(
    number: int,
    y: float,
    speed: float,
    steps: int,
    dt: float,
    kind="car",
    size=(4.5, 1.9),
    x=20.0,
) -> str:
    """A dynamic obstacle that drives along +x from (x, y)."""
    states = [
        state(
            "state",
            step,
            x + speed * dt * step,
            y,
            0.0,
            speed,
        )
        for step in range(1, steps)
    ]
    shape = f"<rectangle><length>{size[0]}</length><width>{size[1]}</width></rectangle>"
    return (
        f'<dynamicObstacle id="{number}"><type>{kind}</type><shape>{shape}</shape>'
        f"{state('initialState', 0, x, y, 0.0, speed)}"
        f"<trajectory>{''.join(states)}</trajectory></dynamicObstacle>"
    )


def lanelet(
    number: int,
    ends: tuple[float, float],
    y: float,
    links: str = "",
    kind: str = "urban",
) -> str:
    """A lanelet of 3.6 m along +x with its middle at y."""
    bounds = ""
    for name, side in (("leftBound", y + 1.8), ("rightBound", y - 1.8)):
        points = [f"<point><x>{x}</x><y>{side}</y></point>" for x in ends]
        bounds += f"<{name}>{''.join(points)}</{name}>"
    return f'<lanelet id="{number}">{bounds}{links}<laneletType>{kind}</laneletType></lanelet>'


LIGHT = """<trafficLight id="50"><cycle>
  <cycleElement><duration>30</duration><color>red</color></cycleElement>
  <cycleElement><duration>20</duration><color>green</color></cycleElement><timeOffset>0</timeOffset></cycle>
  <direction>all</direction><active>true</active></trafficLight>"""
SIGN = """<trafficSign id="60"><trafficSignElement><trafficSignID>274</trafficSignID>
  <additionalValue>13.5</additionalValue></trafficSignElement></trafficSign>"""
ONCOMING = '<adjacentLeft ref="{}" drivingDir="opposite"/>'
ROAD = [
    lanelet(
        1,
        (0, 100),
        0,
        '<successor ref="2"/><adjacentLeft ref="3" drivingDir="same"/>',
    ).replace(
        "<laneletType>",
        '<trafficSignRef ref="60"/><trafficLightRef ref="50"/><laneletType>',
        1,
    ),
    lanelet(
        2,
        (100, 400),
        0,
        '<predecessor ref="1"/>',
    ),
    lanelet(
        3,
        (0, 100),
        3.6,
        '<adjacentLeft ref="4" drivingDir="opposite"/><adjacentRight ref="1" drivingDir="same"/>',
    ),
    lanelet(
        4,
        (100, 0),
        7.2,
        '<adjacentLeft ref="3" drivingDir="opposite"/>',
    ),
    lanelet(
        5,
        (0, 100),
        -4.0,
        kind="sidewalk",
    ),
]


def scenario(
    obstacles: list[str] | None = None,
    dt: float = 0.1,
    steps: int = 91,
    problem: str = "",
) -> bytes:
    """A scenario of format 2020a: a car on lanelet 1, a faster one on 3, a pedestrian."""
    moving = obstacles or [
        obstacle(
            10,
            0,
            6,
            steps,
            dt,
        ),
        obstacle(
            11,
            3.6,
            8,
            steps,
            dt,
            kind="truck",
            size=(8.0, 2.5),
        ),
        obstacle(
            12,
            -5,
            1,
            steps // 2,
            dt,
            kind="pedestrian",
            size=(0.5, 0.5),
        ),
    ]
    parked = (
        '<staticObstacle id="20"><type>unknown</type><shape><rectangle>'
        "<length>2</length><width>1</width>"
        f"</rectangle></shape>{state('initialState', 0, 70, -4, 0.0, 0.0)}</staticObstacle>"
    )
    if problem:
        goal = f"<goalState>{exact('time', 50)}</goalState>"
        problem = f'<planningProblem id="90">{problem}{goal}</planningProblem>'
        problem = problem.replace("<goalState><time><exact>50</exact></time>", GOAL)
    return (
        f'<?xml version="1.0"?><commonRoad timeStepSize="{dt}" '
        'commonRoadVersion="2020a" benchmarkID="DEU_Made-7_1_T-1"'
        ' author="a" affiliation="b" source="c" date="2020-01-01">'
        "<location><geoNameId>1</geoNameId>"
        "<gpsLatitude>1</gpsLatitude><gpsLongitude>1</gpsLongitude></location><scenarioTags><urban/></scenarioTags>"
        f"{''.join(ROAD)}{SIGN}{LIGHT}{parked}{''.join(moving)}{problem}</commonRoad>"
    ).encode()


GOAL = "<goalState><time><intervalStart>40</intervalStart><intervalEnd>50</intervalEnd></time>"


def begin(x: float, y: float) -> str:
    return state(
        "initialState",
        0,
        x,
        y,
    ).replace("</initialState>", exact("yawRate", 0) + exact("slipAngle", 0)) + (
        "</initialState>"
    )


def test_tracks_map_and_lights_arrive():
    recording = read_scenario(scenario())
    assert (recording.scene_id, recording.location, recording.dataset) == (
        "DEU_Made-7_1_T-1",
        "DEU_Made",
        "commonroad",
    )
    assert recording.agent_type.tolist() == [VEHICLE, VEHICLE, PEDESTRIAN, OTHER]
    assert recording.size.tolist() == [[4.5, 1.9], [8.0, 2.5], [0.5, 0.5], [2.0, 1.0]]
    assert recording.valid.sum(0).tolist() == [91, 91, 45, 91]
    driven = np.stack(
        [20 + 0.6 * np.arange(91), np.zeros(91), np.zeros(91), np.full(91, 6.0)], 1
    )
    assert np.allclose(recording.states[:, 0], driven)
    assert np.allclose(recording.states[:, 3], [70, -4, 0, 0])
    lanes = recording.lanes
    assert set(lanes) == {"1", "2", "3", "4"}  # no sidewalk
    assert np.allclose(lanes["1"].points, [[0, 0], [100, 0]])
    assert np.isclose(lanes["1"].width, 3.6)
    assert lanes["1"].exits == ["2"]
    assert lanes["1"].left == ["3"]
    assert lanes["3"].right == ["1"]
    assert lanes["3"].left == [] == lanes["4"].left  # oncoming
    assert lanes["1"].speed_limit == 13.5
    assert lanes["2"].speed_limit == 0
    assert len(recording.drivable) == 4
    assert recording.drivable[0].shape == (4, 2)
    assert recording.lights.keys() == {"2"}  # behind the stop line
    assert (
        recording.lights["2"].tolist()
        == [LIGHT_RED] * 30 + [LIGHT_GREEN] * 20 + [LIGHT_RED] * 30 + [LIGHT_GREEN] * 11
    )


@pytest.mark.parametrize(("dt", "steps"), [(0.2, 46), (0.04, 226), (0.1, 91)])
def test_every_time_step_makes_the_same_recording_at_10_hz(dt, steps):
    recording = read_scenario(
        scenario(
            dt=dt,
            steps=steps,
        )
    )
    assert recording.states.shape[0] == 91
    assert recording.valid[:, 0].all()
    assert np.allclose(recording.states[:, 0, 0], 20 + 0.6 * np.arange(91))


def test_the_ego_is_who_starts_where_the_planning_problem_does_else_who_moves_longest():
    assert read_scenario(scenario(problem=begin(20.3, 0.2))).ego == 0
    assert (
        read_scenario(scenario(problem=begin(35, 0))).ego == 1
    )  # nobody near: both move, 1 is faster
    assert read_scenario(scenario()).ego == 1
    shorter = [
        obstacle(
            10,
            0,
            6,
            91,
            0.1,
        ),
        obstacle(
            11,
            3.6,
            20,
            60,
            0.1,
        ),
        obstacle(
            12,
            -5,
            9,
            91,
            0.1,
            "bicycle",
        ),
    ]
    assert read_scenario(scenario(shorter)).ego == 0
    gone = [
        obstacle(
            10,
            0,
            6,
            5,
            0.1,
        ),
        obstacle(
            11,
            3.6,
            1,
            60,
            0.1,
        ),
    ]
    assert read_scenario(scenario(gone)).ego == 1  # who is there at the start frame
    with pytest.raises(InputError, match="no ego"):
        read_scenario(
            scenario(
                [
                    obstacle(
                        12,
                        -5,
                        1,
                        91,
                        0.1,
                        kind="pedestrian",
                    )
                ]
            )
        ).validate_log()


def test_every_window_of_a_long_scenario_has_an_ego_that_is_there():
    """Cars come and go; in the third window nobody has come yet, in the last one nobody
    moves but the bicycle."""

    def present(
        number: int,
        begin: int,
        end: int,
        speed: float = 6.0,
    ) -> str:
        text = obstacle(
            number,
            0,
            speed,
            end - begin,
            0.1,
        )
        return re.sub(
            r"<time><exact>(\d+)",
            lambda found: f"<time><exact>{int(found[1]) + begin}",
            text,
        )

    cars = [
        present(10, 0, 150),
        present(11, 5, 90),
        present(
            12,
            80,
            190,
            9.0,
        ),
        present(13, 250, 400),
    ]
    (*windows,) = recordings_in(CommonRoadSource, scenario(cars), "made.xml")
    assert [window.current for window in windows] == [10, 101, 192, 283]
    assert [window.scene_id for window in windows] == [
        f"DEU_Made-7_1_T-1@{start}" for start in (10, 101, 192, 283)
    ]
    assert [window.ego for window in windows] == [0, 2, -1, 3]
    assert [window.has_ego() for window in windows] == [True, True, False, True]


@pytest.mark.parametrize("kind", sorted(LANELETS_FOR_OTHERS))
def test_lanelets_for_others_are_no_lanes_and_paved_ones_are_drivable(kind):
    text = scenario().replace(b"<laneletType>sidewalk", f"<laneletType>{kind}".encode())
    recording = read_scenario(text)
    assert set(recording.lanes) == {"1", "2", "3", "4"}
    assert len(recording.drivable) == 4 + (kind in ("shoulder", "busLane"))


@pytest.mark.parametrize(
    ("users", "lanes"),
    [("", 5), ("vehicle", 5), ("car", 5), ("bus", 4), ("pedestrian", 4)],
)
def test_whom_a_lanelet_is_for_decides(users, lanes):
    use = f"<userOneWay>{users}</userOneWay>" if users else ""
    text = scenario().replace(
        b"<laneletType>sidewalk</laneletType>",
        f"<laneletType>urban</laneletType>{use}".encode(),
    )
    assert len(read_scenario(text).lanes) == lanes


def turned(text: bytes, angle: bytes) -> bytes:
    """With another first orientation, in which commonroad-io would turn round and
    round."""
    return re.sub(
        rb"<orientation><exact>[^<]*",
        b"<orientation><exact>" + angle,
        text,
        count=1,
    )


ENTITY = b'<!DOCTYPE x [<!ENTITY e SYSTEM "file:///etc/hostname">]>'
BOMB = b'<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;">]>'


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda text: text.replace(b"<commonRoad", ENTITY + b"<commonRoad", 1),
            "document type",
        ),
        (
            lambda text: (
                text.decode()
                .replace("<commonRoad", BOMB.decode() + "<commonRoad", 1)
                .encode("utf-16")
            ),
            "document type",
        ),
        (lambda text: text[: len(text) // 2], "is none of CommonRoad scenarios"),
        (
            lambda text: text.replace(b'timeStepSize="0.1"', b'timeStepSize="nan"'),
            "timeStepSize=nan",
        ),
        (
            lambda text: text.replace(
                b"<time><exact>90</exact>", b"<time><exact>9000000000</exact>", 1
            ),
            "frames x agents|is none of CommonRoad scenarios",
        ),
        (
            lambda text: text.replace(b"<x>20.0</x>", b"<x>1e400</x>", 1),
            "point/x is 1e400; repair it",
        ),
        (lambda text: turned(text, b"99999999999"), "orientation/exact is 99999999999"),
        (
            lambda text: text.replace(b"</commonRoad>", b"<a>" * 9999),
            "nests deeper than 32 elements",
        ),
    ],
)
def test_what_is_wrong_is_named_with_the_file(change, message):
    with pytest.raises(InputError, match=rf"^made\.xml: .*({message})"):
        recordings_in(CommonRoadSource, change(scenario()), "made.xml")
