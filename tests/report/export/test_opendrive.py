"""OpenDRIVE: which links of the lane graph it says, and roads that lie where the lanes do."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("scenariogeneration", reason="--to openscenario needs the extra openscenario")
from e2rl.report.export.opendrive import FIT, junctions_of, left_out, links  # noqa: E402
from e2rl.scenes.paths import resample, tangent_angle  # noqa: E402
from e2rl.scenes.recording import Lane  # noqa: E402
from tests.report.export.small_run import exported  # noqa: E402


def graph(**exits: str) -> dict[str, Lane]:
    return {name: Lane(np.zeros((2, 2)), exits=list(others)) for name, others in exits.items()}


def test_a_crossing_s_connectors_are_one_junction_and_a_fork_without_connectors_is_left_out():
    lanes = graph(a="xy", b="z", x="c", y="d", z="d", c="", d="e", e="")
    plain, connecting = links(lanes)
    assert connecting == {"x": ("a", "c"), "y": ("a", "d"), "z": ("b", "d")} and plain == [("d", "e")]
    assert junctions_of(connecting) == [["x", "y", "z"]] and left_out(lanes) == 0
    lanes = graph(a="xc", x="b", b="", c="")  # one way on has a connector, the other has none
    assert links(lanes) == ([("x", "b")], {}) and left_out(lanes) == 2


@settings(max_examples=100, deadline=None)
@given(st.sets(st.tuples(st.sampled_from("abcdefgh"), st.sampled_from("abcdefgh")), max_size=14))
def test_said_links_are_links_and_every_end_has_at_most_one_partner(pairs):
    lanes = graph(**{name: "".join(b for a, b in sorted(pairs) if a == name != b) for name in "abcdefgh"})
    plain, connecting = links(lanes)
    said = plain + [link for name, (before, after) in connecting.items() for link in ((before, name), (name, after))]
    assert len(said) == len(set(said)) and all(b in lanes[a].exits for a, b in said)
    index = {name: number for number, names in enumerate(junctions_of(connecting)) for name in names}
    for name in lanes:  # a road's end is linked with one road or one junction
        into = {index[lane] for lane, (before, _) in connecting.items() if before == name}
        out_of = {index[lane] for lane, (_, after) in connecting.items() if after == name}
        assert len(into) + sum(a == name for a, _ in plain) <= 1 and len(out_of) + sum(b == name for _, b in plain) <= 1
        assert not (name in connecting and (into or out_of))


@pytest.fixture(scope="module")
def roads(run, tmp_path_factory):
    """(root of the OpenDRIVE file, its path) of the first rollout."""
    path = exported(run, tmp_path_factory.mktemp("opendrive") / "out", "openscenario")[0].with_suffix(".xodr")
    return ElementTree.parse(path).getroot(), path


def drawn(road) -> np.ndarray:
    """Points [Q, 2] of a road's reference line: its clothoids and lines, integrated step by step."""
    points = []
    for piece in road.iterfind("planView/geometry"):
        x, y, heading, length = (float(piece.get(name)) for name in ("x", "y", "hdg", "length"))
        spiral = piece.find("spiral")
        first, last = (0.0, 0.0) if spiral is None else (float(spiral.get(name)) for name in ("curvStart", "curvEnd"))
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
    left = np.concatenate([np.stack([100 + 20 * np.cos(arc), 20 + 20 * np.sin(arc)], 1), [[120.0, 320.0]]])
    lanes = {"in": [[0, 0], [100, 0]], "on": [[100, 0], [400, 0]], "left": left, "near": [[0, 3.5], [100, 3.5]]}
    assert [road.get("name") for road in root.iterfind("road")] == list(lanes)
    for road in root.iterfind("road"):
        points = resample(np.array(lanes[road.get("name")], float), 1.0) - [28, 0]
        line = drawn(road)
        beside = np.linalg.norm(points[:, None] - line[None], axis=-1).min(1)
        assert beside.max() < 1.5 * FIT and abs(float(road.get("length")) - len(points) + 1) < 1
        heading = tangent_angle(points)[0]
        assert abs(float(road.find("planView/geometry").get("hdg")) - heading) < 0.05


def test_a_road_has_its_lane_s_width_around_the_line_and_its_limit(roads):
    for road in roads[0].iterfind("road"):
        width = float(road.find("lanes/laneSection/right/lane/width").get("a"))
        assert width == pytest.approx(3.6, abs=1e-5) == 2 * float(road.find("lanes/laneOffset").get("a"))
    assert {float(road.find("type/speed").get("max")) for road in roads[0].iterfind("road")} == {20, 13.889}


def test_the_file_follows_the_standard_s_schema(roads):
    import scenariogeneration
    from lxml import etree

    schema = Path(scenariogeneration.__file__).parents[1] / "schemas" / "opendrive_17_core.xsd"
    etree.XMLSchema(etree.parse(str(schema))).assertValid(etree.parse(str(roads[1])))
    known = {item.get("code"): item.get("value") for item in roads[0].iterfind("header/userData")}
    assert known == {"links_left_out": "2", "origin": "28 0"}
