"""ASAM OpenDRIVE 1.7 of an episode's lanes, by scenariogeneration: a road with one lane
for each lane.

A road's reference line is the lane's centreline, fitted by clothoids. Roads and
junctions are those of road_plan.py.
"""

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from pyclothoids import Clothoid
from scenariogeneration import xodr

from e2rl.report.export.episode import Episode
from e2rl.report.export.road_plan import RoadPlan, Span, road_plan
from e2rl.scenes.paths import arc_length, resample, tangent_angle
from e2rl.scenes.recording import Lane

FIT = 0.05  # m that the reference line may lie beside the centreline
SHORT = 2.0  # m: pieces up to this length are fitted as they are
SEAM = 0.2  # m: points of the next lane that are nearer to the end of the one before are left out
LANE = -1  # the only lane of a road, right of the (offset) reference line


def write_roads(episode: Episode, path: Path) -> None:
    """Write the lanes of an episode; the header's userData tells the scene's origin."""
    root = road_network(episode).get_element()
    header = root.find("header")
    points = episode.rollout.lane_points
    header.set("north", f"{points[:, 1].max():.3f}")
    header.set("south", f"{points[:, 1].min():.3f}")
    header.set("east", f"{points[:, 0].max():.3f}")
    header.set("west", f"{points[:, 0].min():.3f}")
    if episode.origin is not None:
        origin = " ".join(f"{part:.0f}" for part in episode.origin)
        ElementTree.SubElement(header, "userData", {"code": "origin", "value": origin})
    for element in root.iterfind("road"):
        add_lane_speeds(element)
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(path, "utf-8", xml_declaration=True)


def road_network(episode: Episode) -> Any:
    """Returns the xodr.OpenDrive of an episode; roads are named after their lanes."""
    rollout = episode.rollout
    network = xodr.OpenDrive(rollout.location or rollout.scene_id, revMinor="7")
    plan = road_plan(episode.lanes)
    number = {name: index for index, name in enumerate(plan.roads, 1)}
    for name in plan.roads:
        network.add_road(road(episode.lanes, plan, name=name, number=number))
    for index, names in enumerate(plan.junctions, 1):
        junction = xodr.Junction(f"junction {index}", index)
        for name in names:
            before, _ = plan.connecting[name]
            connection = xodr.Connection(
                number[before],
                number[name],
                xodr.ContactPoint.start,
            )
            connection.add_lanelink(LANE, LANE)
            junction.add_connection(connection)
        network.add_junction(junction)
    return network


def road(
    lanes: dict[str, Lane],
    plan: RoadPlan,
    name: str,
    number: dict[str, int],
) -> Any:
    """Returns the xodr.Road called `name`, with limits and widths from where each of
    its lanes begins.

    Args:
        lanes: by id.
        plan: the roads.
        name: of a road of the plan.
        number: the id in the file by road.
    """
    spans = plan.roads[name]
    places = [span_places(lanes[span.lane], span) for span in spans]
    joined = np.concatenate(joined_places(places))
    pieces = geometries(joined[:, :2], joined[:, 2])
    plan_view = xodr.PlanView()
    for piece, x, y, heading in pieces:
        plan_view.add_fixed_geometry(piece, x, y, heading)
    lengths = [span.end - span.begin for span in spans]
    scale = sum(piece.length for piece, *_ in pieces) / sum(lengths)
    starts = scale * np.cumsum([0.0, *lengths[:-1]])
    driving = xodr.Lane(a=lanes[spans[0].lane].width)
    section = xodr.LaneSection(0, xodr.Lane()).add_right_lane(driving)
    profile = xodr.Lanes().add_lanesection(section)
    junctions = [
        index for index, names in enumerate(plan.junctions, 1) if name in names
    ]
    element = xodr.Road(
        number[name],
        plan_view,
        profile,
        road_type=junctions[0] if junctions else -1,
        name=", ".join(span.lane for span in spans),
    )
    for start, span in zip(starts.tolist(), spans, strict=True):
        lane = lanes[span.lane]
        profile.add_laneoffset(xodr.LaneOffset(s=start, a=lane.width / 2))
        if start > 0:
            driving.add_lane_width(a=lane.width, soffset=start)
        if lane.speed_limit > 0:
            limit = round(lane.speed_limit, 3)
            element.add_type(xodr.RoadType.town, s=start, speed=limit, speed_unit="m/s")
        elif start > 0:
            element.add_type(xodr.RoadType.town, s=start)
    add_links(element, driving, plan=plan, name=name, number=number)
    return element


def add_links(
    element: Any,
    driving: Any,
    plan: RoadPlan,
    name: str,
    number: dict[str, int],
) -> None:
    """Link a road and its lane with what comes before and after it.

    Args:
        element: the xodr.Road.
        driving: its xodr.Lane.
        plan: the roads.
        name: of the road in the plan.
        number: the id in the file by road.
    """
    before, after = plan.connecting.get(name, (None, None))
    before = before or next((a for a, b in plan.plain if b == name), None)
    after = after or next((b for a, b in plan.plain if a == name), None)
    if before is not None:
        element.add_predecessor(
            xodr.ElementType.road,
            number[before],
            xodr.ContactPoint.end,
        )
        driving.add_link("predecessor", LANE)
    if after is not None:
        element.add_successor(
            xodr.ElementType.road,
            number[after],
            xodr.ContactPoint.start,
        )
        driving.add_link("successor", LANE)
    for index, names in enumerate(plan.junctions, 1):
        ends = [plan.connecting[other] for other in names]
        if name in (b for _, b in ends):
            element.add_predecessor(xodr.ElementType.junction, index)
        if name in (a for a, _ in ends):
            element.add_successor(xodr.ElementType.junction, index)


def add_lane_speeds(element: ElementTree.Element) -> None:
    """Repeat the limits of a road's types in its lane: some tools read the one, some
    the other."""
    lane = element.find("lanes/laneSection/right/lane")
    assert lane is not None
    for kind in element.iterfind("type"):
        speed = kind.find("speed")
        if speed is not None:
            limit = {
                "sOffset": kind.attrib["s"],
                "max": speed.attrib["max"],
                "unit": speed.attrib["unit"],
            }
            ElementTree.SubElement(lane, "speed", limit)


def span_places(lane: Lane, span: Span) -> np.ndarray:
    """Returns x, y [m], direction [rad], [P, 3], of a part of a lane's centreline."""
    arc = arc_length(lane.points)
    inside = (arc > span.begin) & (arc < span.end)
    at = np.concatenate([[span.begin], arc[inside], [span.end]])
    columns = [*lane.points.T, np.unwrap(tangent_angle(lane.points))]
    return np.stack([np.interp(at, arc, column) for column in columns], 1)


def joined_places(parts: list[np.ndarray]) -> list[np.ndarray]:
    """Returns parts [P, 3] of one line without the points of each that lie at the end
    of the part before it."""
    joined = parts[:1]
    for part in parts[1:]:
        away = np.linalg.norm(part[:, :2] - joined[-1][-1, :2], axis=1) > SEAM
        first = min(int(away.argmax()), len(part) - 1)
        joined.append(part[first:])
    return joined


def geometries(
    points: np.ndarray, angle: np.ndarray
) -> list[tuple[Any, float, float, float]]:
    """(geometry, x, y, heading) of clothoids through some of the points [P, 2] of a
    centreline, in the directions [P] that it has there: one clothoid, or, where that
    lies more than FIT beside the centreline, those of both halves."""
    count = len(points)
    x, y = points[0].tolist()
    x_end, y_end = points[-1].tolist()
    heading = float(angle[0])
    curve = Clothoid.G1Hermite(x, y, heading, x_end, y_end, float(angle[-1]))
    length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    if count > 2 and length > SHORT:
        centreline = resample(points, length / (count - 1))[:count]
        offsets = np.array(curve.SampleXY(count)).T - centreline
        if np.linalg.norm(offsets, axis=1).max() > FIT:
            half = count // 2
            return [
                *geometries(points[: half + 1], angle[: half + 1]),
                *geometries(points[half:], angle[half:]),
            ]
    piece: Any = xodr.Spiral(curve.KappaStart, curve.KappaEnd, curve.length)
    if curve.length > 1.5 * length:  # a tangent that is noise bends it back
        piece = xodr.Line(float(np.hypot(x_end - x, y_end - y)))
        heading = float(np.arctan2(y_end - y, x_end - x))
    elif max(abs(curve.KappaStart), abs(curve.KappaEnd)) < 1e-6:
        piece = xodr.Line(curve.length)
    return [(piece, x, y, heading)]
