"""ASAM OpenDRIVE 1.7 of an episode's lanes, by scenariogeneration: a road with one lane for each lane.

A road's reference line is the lane's centreline, fitted by clothoids. Links follow the lane graph as far as OpenDRIVE
can say it: a lane between two others is a connecting road of a junction where one of these forks or merges.
"""

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import networkx as nx
import numpy as np
from pyclothoids import Clothoid
from scenariogeneration import xodr

from e2rl.report.export.episode import Episode
from e2rl.scenes.paths import resample, tangent_angle
from e2rl.scenes.recording import Lane

FIT = 0.05  # m that the reference line may lie beside the centreline
SHORT = 2.0  # m: pieces up to this length are fitted as they are
LANE = -1  # the only lane of a road, right of the (offset) reference line

Link = tuple[str, str]
End = tuple[int | None, int | None]  # of a road: the road and the junction that it is linked with, None for none


def write_roads(episode: Episode, path: Path) -> None:
    """Write the lanes of an episode; userData of the header tell the scene's origin and how many links are left out."""
    root = road_network(episode).get_element()
    header = root.find("header")
    (west, south), (east, north) = (edge(episode.rollout.lane_points, axis=0) for edge in (np.min, np.max))
    for name, side in {"north": north, "south": south, "east": east, "west": west}.items():
        header.set(name, f"{side:.3f}")
    known = {"links_left_out": str(left_out(episode.lanes))}
    if episode.origin is not None:
        known["origin"] = " ".join(f"{part:.0f}" for part in episode.origin)
    for code, value in known.items():
        ElementTree.SubElement(header, "userData", {"code": code, "value": value})
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(path, "utf-8", xml_declaration=True)


def road_network(episode: Episode) -> Any:
    """The xodr.OpenDrive of an episode; road n + 1 is lane n."""
    made = xodr.OpenDrive(episode.rollout.location or episode.rollout.scene_id, revMinor="7")
    number = {name: index for index, name in enumerate(episode.lanes, 1)}
    plain, connecting = links(episode.lanes)
    junctions = junctions_of(connecting)
    junction_of = {name: index for index, names in enumerate(junctions, 1) for name in names}
    precedes = {b: a for a, b in plain} | {name: before for name, (before, _) in connecting.items()}
    follows = dict(plain) | {name: after for name, (_, after) in connecting.items()}
    into = {before: junction_of[name] for name, (before, _) in connecting.items()}
    out_of = {after: junction_of[name] for name, (_, after) in connecting.items()}
    for name, lane in episode.lanes.items():
        begin = number.get(precedes.get(name, "")), out_of.get(name)
        end = number.get(follows.get(name, "")), into.get(name)
        made.add_road(road(lane, number[name], junction_of.get(name, -1), begin, end, name))
    for index, names in enumerate(junctions, 1):
        junction = xodr.Junction(f"junction {index}", index)
        for name in names:
            connection = xodr.Connection(number[connecting[name][0]], number[name], xodr.ContactPoint.start)
            connection.add_lanelink(LANE, LANE)
            junction.add_connection(connection)
        made.add_junction(junction)
    return made


def links(lanes: dict[str, Lane]) -> tuple[list[Link], dict[str, Link]]:
    """Links that OpenDRIVE can say: pairs of lanes of which one follows the other and both have no further link there;
    and {connecting lane: (the lane before it, the lane after it)}.

    A connecting lane has one lane before and one after it, neither of them connecting, of which one has further links
    at that end. An end belongs to a junction only where all its links are connecting lanes.
    """
    graph = nx.DiGraph()
    graph.add_nodes_from(lanes)
    graph.add_edges_from((name, other) for name, lane in lanes.items() for other in lane.exits)
    ends = {name: (list(graph.predecessors(name)), list(graph.successors(name))) for name in lanes}
    between = {
        name: (before[0], after[0])
        for name, (before, after) in ends.items()
        if len(before) == len(after) == 1 and (len(ends[before[0]][1]) > 1 or len(ends[after[0]][0]) > 1)
    }
    found = len(between) + 1
    while len(between) < found:  # until every end of a junction is one of junctions alone
        found = len(between)
        between = {
            name: (before, after)
            for name, (before, after) in between.items()
            if before not in between
            and after not in between
            and all(other in between for other in (*ends[before][1], *ends[after][0]))
        }
    plain = [
        (a, b)
        for a, b in graph.edges
        if len(ends[a][1]) == len(ends[b][0]) == 1 and a not in between and b not in between
    ]
    return plain, between


def junctions_of(connecting: dict[str, Link]) -> list[list[str]]:
    """The connecting lanes of each junction: those that share an end with each other."""
    graph = nx.Graph()
    for lane, (before, after) in connecting.items():
        graph.add_edges_from([(("lane", lane), ("end", before)), (("lane", lane), ("start", after))])
    parts = nx.connected_components(graph)
    return sorted(sorted(name for kind, name in part if kind == "lane") for part in parts)


def road(lane: Lane, number: int, junction: int, before: End, after: End, name: str) -> Any:
    """The xodr.Road of a lane."""
    plan = xodr.PlanView()
    for geometry, x, y, heading in geometries(lane.points, tangent_angle(lane.points)):
        plan.add_fixed_geometry(geometry, x, y, heading)
    centre, driving = xodr.Lane(), xodr.Lane(a=lane.width)
    section = xodr.LaneSection(0, centre).add_right_lane(driving)
    lanes = xodr.Lanes().add_lanesection(section).add_laneoffset(xodr.LaneOffset(a=lane.width / 2))
    made = xodr.Road(number, plan, lanes, road_type=junction, name=name)
    if lane.speed_limit > 0:
        made.add_type(xodr.RoadType.town, speed=round(lane.speed_limit, 3), speed_unit="m/s")
    for side, link, contact, (other, through) in (
        ("predecessor", made.add_predecessor, xodr.ContactPoint.end, before),
        ("successor", made.add_successor, xodr.ContactPoint.start, after),
    ):
        if through is not None:
            link(xodr.ElementType.junction, through)
        elif other is not None:
            link(xodr.ElementType.road, other, contact)
            driving.add_link(side, LANE)
    return made


def geometries(points: np.ndarray, angle: np.ndarray) -> list[tuple[Any, float, float, float]]:
    """(geometry, x, y, heading) of clothoids through some of the points [P, 2] of a centreline, in the directions [P]
    that it has there: one clothoid, or, where that lies more than FIT beside the centreline, those of both halves."""
    (x0, y0), (x1, y1) = points[0].tolist(), points[-1].tolist()
    curve = Clothoid.G1Hermite(x0, y0, float(angle[0]), x1, y1, float(angle[-1]))
    length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    if len(points) > 2 and length > SHORT:
        drawn = np.array(curve.SampleXY(len(points))).T
        beside = np.linalg.norm(drawn - resample(points, length / (len(points) - 1))[: len(points)], axis=1).max()
        if beside > FIT:
            middle = len(points) // 2
            return geometries(points[: middle + 1], angle[: middle + 1]) + geometries(points[middle:], angle[middle:])
    if curve.length > 1.5 * length:  # a tangent that is noise bends it back: straight on
        return [(xodr.Line(float(np.hypot(x1 - x0, y1 - y0))), x0, y0, float(np.arctan2(y1 - y0, x1 - x0)))]
    if max(abs(curve.KappaStart), abs(curve.KappaEnd)) < 1e-6:
        return [(xodr.Line(curve.length), x0, y0, float(angle[0]))]
    return [(xodr.Spiral(curve.KappaStart, curve.KappaEnd, curve.length), x0, y0, float(angle[0]))]


def left_out(lanes: dict[str, Lane]) -> int:
    """How many links of the lane graph OpenDRIVE does not say."""
    plain, connecting = links(lanes)
    return sum(len(lane.exits) for lane in lanes.values()) - len(plain) - 2 * len(connecting)
