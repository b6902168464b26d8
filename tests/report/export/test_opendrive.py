"""OpenDRIVE: roads that lie where the lanes do, with their widths, limits and links."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

pytest.importorskip(
    "scenariogeneration", reason="--to openscenario needs the extra openscenario"
)
from e2rl.report.export import opendrive  # noqa: E402
from e2rl.report.export.opendrive import FIT, add_lane_speeds  # noqa: E402
from e2rl.report.export.road_plan import road_plan  # noqa: E402
from e2rl.scenes.paths import resample, tangent_angle  # noqa: E402
from e2rl.scenes.recording import Lane  # noqa: E402
from tests.report.export.small_run import exported  # noqa: E402


@pytest.fixture(scope="module")
def roads(run, tmp_path_factory):
    """(root of the OpenDRIVE file, its path) of the first rollout."""
    path = exported(run, tmp_path_factory.mktemp("opendrive") / "out", "openscenario")[
        0
    ].with_suffix(".xodr")
    return ElementTree.parse(path).getroot(), path


def drawn(road) -> np.ndarray:
    """Points [Q, 2] of a road's reference line: its clothoids and lines, integrated
    step by step."""
    points = []
    for piece in road.iterfind("planView/geometry"):
        x, y, heading, length = (
            float(piece.get(name)) for name in ("x", "y", "hdg", "length")
        )
        spiral = piece.find("spiral")
        first, last = (
            (0.0, 0.0)
            if spiral is None
            else (float(spiral.get(name)) for name in ("curvStart", "curvEnd"))
        )
        s = (np.arange(2000) + 0.5) * length / 2000
        angle = heading + first * s + (last - first) / length * s**2 / 2
        steps = np.stack([np.cos(angle), np.sin(angle)], -1) * length / 2000
        points.append(np.concatenate([[[x, y]], [x, y] + np.cumsum(steps, 0)]))
    for before, after in zip(points, points[1:], strict=False):
        assert np.linalg.norm(before[-1] - after[0]) < 1e-3  # pieces join
    return np.concatenate(points)


def test_reference_lines_are_the_centrelines(roads):
    root, _ = roads
    arc = np.linspace(-np.pi / 2, 0, 16)
    left = np.concatenate(
        [np.stack([100 + 20 * np.cos(arc), 20 + 20 * np.sin(arc)], 1), [[120.0, 320.0]]]
    )
    lanes = {
        "in": [[0, 0], [100, 0]],
        "on": [[100, 0], [400, 0]],
        "left": left,
        "near": [[0, 3.5], [100, 3.5]],
    }
    names = [road.get("name") for road in root.iterfind("road")]
    assert names == [
        "in",
        "on",
        "left",
        "near",
        "on",
        "left",
    ]  # the last two connect `in` with the others
    for name, corners in lanes.items():
        points = resample(np.array(corners, float), 1.0) - [28, 0]
        line = np.concatenate(
            [drawn(road) for road in root.iterfind("road") if road.get("name") == name]
        )
        beside = np.linalg.norm(points[:, None] - line[None], axis=-1).min(1)
        assert beside.max() < 1.5 * FIT
        lengths = [
            float(road.get("length"))
            for road in root.iterfind("road")
            if road.get("name") == name
        ]
        assert abs(sum(lengths) - len(points) + 1) < 1
        whole = next(
            road for road in reversed(root.findall("road")) if road.get("name") == name
        )
        assert (
            abs(
                float(whole.find("planView/geometry").get("hdg"))
                - tangent_angle(points)[0]
            )
            < 0.05
        )


def test_a_road_has_its_lane_s_width_around_the_line_and_its_limit_twice(roads):
    for road in roads[0].iterfind("road"):
        lane = road.find("lanes/laneSection/right/lane")
        width = float(lane.find("width").get("a"))
        assert (
            width
            == pytest.approx(3.6, abs=1e-5)
            == 2 * float(road.find("lanes/laneOffset").get("a"))
        )
        assert lane.find("speed").get("max") == road.find("type/speed").get("max")
        assert lane.find("speed").get("unit") == "m/s"
    assert {
        float(road.find("type/speed").get("max")) for road in roads[0].iterfind("road")
    } == {20, 13.889}


def test_a_turn_in_two_pieces_changes_width_and_limit_where_the_second_begins():
    arc = np.linspace(0, np.pi / 2, 25)
    turn = np.stack([50 + 15 * np.sin(arc), 15 - 15 * np.cos(arc)], 1)
    second = turn[9:] + [0.05, 0.0]  # begins a little beside the end of the first
    lanes = {
        "in": Lane(
            np.array([[0.0, 0.0], [50.0, 0.0]]),
            3.5,
            speed_limit=10.0,
            exits=["t", "on"],
        ),
        "t": Lane(turn[:10], 3.0, speed_limit=5.0, exits=["u"]),
        "u": Lane(second, 3.2, speed_limit=0.0, exits=["up"]),
        "on": Lane(np.array([[50.0, 0.0], [90.0, 0.0]]), 3.5, speed_limit=10.0),
        "side": Lane(
            np.array([[65.0, -20.0], [65.0, 15.0]]), 3.5, speed_limit=10.0, exits=["up"]
        ),
        "up": Lane(np.array([[65.0, 15.0], [65.0, 90.0]]), 3.5, speed_limit=10.0),
    }
    plan = road_plan(lanes)
    element = opendrive.road(
        lanes,
        plan,
        name="t",
        number={name: index for index, name in enumerate(plan.roads, 1)},
    ).get_element()
    add_lane_speeds(element)
    line = drawn(element)
    beside = np.linalg.norm(
        np.concatenate([turn[:10], second])[:, None] - line[None], axis=-1
    ).min(1)
    assert element.get("name") == "t, u"
    assert beside.max() < 0.1
    lane = element.find("lanes/laneSection/right/lane")
    widths = [
        (float(item.get("sOffset")), float(item.get("a")))
        for item in lane.iterfind("width")
    ]
    (_, first), (start, other) = widths
    assert (first, other) == (3.0, 3.2)
    assert start == pytest.approx(15 * arc[9], abs=0.1)
    offsets = [float(item.get("a")) for item in element.iterfind("lanes/laneOffset")]
    assert offsets == [1.5, 1.6]
    limits = [kind.find("speed") for kind in element.iterfind("type")]
    assert limits[0].get("max") == lane.find("speed").get("max") == "5.0"
    assert limits[1] is None  # the second has no known limit


def test_the_file_follows_the_standard_s_schema(roads):
    import scenariogeneration
    from lxml import etree

    schema = (
        Path(scenariogeneration.__file__).parents[1]
        / "schemas"
        / "opendrive_17_core.xsd"
    )
    etree.XMLSchema(etree.parse(str(schema))).assertValid(etree.parse(str(roads[1])))
    certain = {
        item.get("code"): item.get("value")
        for item in roads[0].iterfind("header/userData")
    }
    assert certain == {"origin": "28 0"}
