"""SUMO and CommonRoad's tools: what they make of exported maps, lights and contacts."""

import csv
import subprocess
from xml.etree import ElementTree

import pytest

pytest.importorskip(
    "scenariogeneration", reason="--to openscenario needs the extra openscenario"
)
from e2rl.evaluation.rollout_files import TABLE, read_rows  # noqa: E402
from e2rl.report.export.opendrive import write_roads  # noqa: E402
from e2rl.report.export.road_plan import lane_digraph  # noqa: E402
from e2rl.report.export.scene_files import episodes_of  # noqa: E402
from tests.report.export.clients.environment import answer, environment  # noqa: E402

pytestmark = [pytest.mark.slow, pytest.mark.clients]


@pytest.fixture(scope="module")
def sumo():
    """The folder of SUMO's programs."""
    return environment("sumo") / "bin"


@pytest.fixture(scope="module")
def tools():
    """commonroad-sumo and the drivability checker."""
    return environment("commonroad")


def lane_pairs(lanes, outside):
    """(a, b) of lanes `outside` of junctions of which b is reached from a through lanes
    of junctions alone."""
    graph = lane_digraph(lanes)
    pairs = set()
    for name in outside:
        waiting = list(graph.successors(name))
        visited = set()
        while waiting:
            other = waiting.pop()
            if other in outside:
                pairs.add((name, other))
            elif other not in visited:
                visited.add(other)
                waiting += graph.successors(other)
    return pairs


def test_every_link_is_a_connection_at_its_lane_s_limit(places, sumo, tmp_path):
    count = 0
    for episode in episodes_of(
        places, read_rows(places / TABLE), plugins=[], scene=True
    ):
        roads = tmp_path / f"{count}.xodr"
        net = tmp_path / f"{count}.net.xml"
        write_roads(episode, roads)
        subprocess.run(
            [sumo / "netconvert", "--opendrive-files", roads, "-o", net],
            check=True,
            capture_output=True,
        )
        written = ElementTree.parse(roads).iterfind("road")
        lane_of = {
            f"-{road.get('id')}": road.get("name")
            for road in written
            if road.get("junction") == "-1"
        }
        root = ElementTree.parse(net).getroot()
        edges = [
            edge for edge in root.iterfind("edge") if edge.get("function") != "internal"
        ]
        assert {edge.get("id") for edge in edges} == set(lane_of)
        for edge in edges:
            limit = episode.lanes[lane_of[edge.get("id")]].speed_limit
            assert float(edge.find("lane").get("speed")) == pytest.approx(
                limit, abs=0.01
            )
        connections = [
            item for item in root.iterfind("connection") if item.get("from") in lane_of
        ]
        ways = {
            (lane_of[item.get("from")], lane_of[item.get("to")]) for item in connections
        }
        assert ways == lane_pairs(episode.lanes, set(lane_of.values()))
        count += 1
    assert count == 16


def test_the_designer_links_lanelets_as_the_lanes_are(places, tools, tmp_path):
    episodes = list(
        episodes_of(places, read_rows(places / TABLE), plugins=[], scene=True)
    )
    paths = [tmp_path / f"{index}.xodr" for index in range(len(episodes))]
    for episode, path in zip(episodes, paths, strict=True):
        write_roads(episode, path)
    for episode, read in zip(episodes, answer(tools, "designer", *paths), strict=True):
        lanes = episode.lanes.values()
        entries = episode.entries().values()
        assert read["forks"] == sorted(
            len(lane.exits) for lane in lanes if len(lane.exits) > 1
        )
        assert read["merges"] == sorted(
            len(others) for others in entries if len(others) > 1
        )
        limits = {round(lane.speed_limit, 2) for lane in lanes}
        assert set(read["limits"]) <= limits


def test_commonroad_sumo_takes_every_place_with_its_lights(
    places, tools, sumo, commonroad_files
):
    episodes = list(
        episodes_of(places, read_rows(places / TABLE), plugins=[], scene=True)
    )
    read = answer(
        tools, "lights_to_sumo", *commonroad_files(places, "places"), path=sumo
    )
    assert len(read) == len(episodes) == 16
    for episode, result in zip(episodes, read, strict=True):
        assert result["connections"] > 0
        assert (
            (result["lights"] > 0) == (result["signalled"] > 0) == bool(episode.lights)
        )


def test_the_drivability_checker_sees_contacts_at_the_same_step(
    run, tools, commonroad_files
):
    steps = answer(tools, "drivability", *commonroad_files(run, "contacts"))
    with (run / TABLE).open(newline="") as file:
        expected = [
            int(float(row["contact_step"])) if row["contact_step"] else None
            for row in csv.DictReader(file)
        ]
    assert steps == expected
    assert any(step is not None for step in steps)
