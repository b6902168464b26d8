"""From a Recording to a Scene: who takes part, from which start state, on which routes,
on which map."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import cKDTree
from tensordict import TensorDict

from e2rl.run.errors import InputError
from e2rl.run.settings import configured, setting
from e2rl.scenes import boxes
from e2rl.scenes.drivable_area import DrivableArea
from e2rl.scenes.headings import hold_headings, mend_headings
from e2rl.scenes.lane_graph import LaneGraph, Route
from e2rl.scenes.levels import Levels
from e2rl.scenes.limits import known_limits
from e2rl.scenes.links import plausible_width
from e2rl.scenes.log_route import route_from_log
from e2rl.scenes.paths import wrap
from e2rl.scenes.plausibility import check, extent, map_fit, motion
from e2rl.scenes.recording import AGENT_WORDS, VEHICLE, Recording
from e2rl.scenes.route import BEHIND, SPACING, project, project_track
from e2rl.scenes.smoothing import PAST, causal_past, causal_state, drop_jumps, smooth

Arrays = dict[str, np.ndarray]
STANDING = 0.5  # m/s
MOVES, NEAR = (
    2.0,
    10.0,
)  # m: from where it was, of a vehicle that moves; between paths of centres that come near
FIT = 2.0  # m: mean distance of a recorded future from a candidate that still counts as the route driven
PASSED = 1.0  # m behind the vehicle's centre beyond which a stop line no longer counts
OTHER_LEVEL = "agents on another level than the ego, on a bridge or below one, left out"
MAX_EXITS, MAX_LIGHTS = (
    6,
    2,
)  # successors of a lane, lights of a route that a scene keeps


@configured("data/source", "build")
@dataclass
class BuildSettings:
    """Sizes of a scene: simulated steps, vehicles (with the ego), other agents, route
    candidates and their vertices, cells of the drivable field."""

    steps: int = setting(low=1)
    vehicles: int = setting(low=2)
    others: int = setting(low=0)
    routes: int = setting(low=1)
    vertices: int = setting(low=20)
    field_cells: int = setting(low=8)


def build_scene(recording: Recording, settings: BuildSettings) -> TensorDict:
    """The Scene of a recording from its start frame (schema: e2rl/scenes/scene.py).

    Raises InputError where the recording makes none (no ego, no lanes, NaN states), and
    where it is not plausible.
    """
    return SceneBuilder(recording, settings).scene(recording)


class SceneBuilder:
    """The scenes of one log from any start frames: what does not depend on these is
    computed once.

    repairs: what was mended or left out of its tracks and map, by a phrase in the
    plural.
    """

    def __init__(self, recording: Recording, settings: BuildSettings) -> None:
        """Raises InputError for what `build_scene` does, the start frame apart."""
        recording.validate_log()
        self.repairs = Counter(recording.repairs)
        check(extent(recording), recording.scene_id)
        self.valid = drop_jumps(recording.states, recording.valid)
        egos = recording.all_egos()
        self.valid[:, egos] = recording.valid[
            :, egos
        ]  # without the ego there is no scene
        self.mended, turned = mend_headings(
            recording.states, recording.valid, agent_type=recording.agent_type
        )
        recording = replace(recording, states=self.mended)
        check(motion(recording), recording.scene_id)
        held, count = hold_headings(
            self.mended, self.valid, agent_type=recording.agent_type
        )
        self.repairs += Counter(turned) + Counter(
            {"headings held while standing": count}
        )
        lanes, limits = known_limits(recording)
        self.graph = LaneGraph(lanes)
        self.repairs += limits + self.graph.repairs
        if not self.graph.ids:
            raise InputError(
                f"scene {recording.scene_id!r}: no lane is at least 0.5 m long; leave the scene out"
            )
        check(map_fit(recording, self.graph), recording.scene_id)
        self.levels = Levels(recording, self.graph, valid=self.valid)
        self.elsewhere = {recording.ego: self.levels.elsewhere(recording.ego)}
        self.repairs[OTHER_LEVEL] += int(self.elsewhere[recording.ego].sum())
        self.repairs = +self.repairs
        self.states = smooth(held, self.valid)
        widths = np.array(
            [plausible_width(lane.width) for lane in self.graph.lanes.values()]
        )
        rings = [ring for ring in recording.drivable if len(ring) >= 3]
        self.drivable = DrivableArea(
            list(self.graph.line.values()), widths, polygons=rings
        )
        self.settings = settings

    def scene(self, recording: Recording) -> TensorDict:
        """The Scene of the log from the start frame of `recording`, one of its
        `windows`; raises InputError where it is no start."""
        frame = recording.validate_start().current
        assert frame is not None
        if recording.ego not in self.elsewhere:
            self.elsewhere[recording.ego] = self.levels.elsewhere(recording.ego)
        valid = self.valid & ~self.elsewhere[recording.ego]
        valid[: frame + 1, [*recording.towed]] = False  # as of one that appears later
        # what stands is held by what was recorded of it until the start frame
        held, _ = hold_headings(
            self.mended[: frame + 1],
            self.valid[: frame + 1],
            agent_type=recording.agent_type,
        )
        scene, origin = _agents(
            replace(recording, states=held),
            frame,
            states=self.states,
            valid=valid,
            settings=self.settings,
        )
        elsewhere = self.levels.lanes_elsewhere(scene.pop("height"))
        lights = {name: index for index, name in enumerate(recording.lights)}
        scene |= _routes(
            scene,
            self.graph,
            origin=origin,
            lights=lights,
            settings=self.settings,
            elsewhere=elsewhere,
        )
        scene |= _lights(recording, frame, origin=origin, steps=self.settings.steps)
        scene |= _map(
            self.graph,
            self.drivable,
            scene=scene,
            origin=origin,
            settings=self.settings,
        )
        left_out = scene.pop("left_out")
        tensors = {
            key: torch.from_numpy(np.ascontiguousarray(value))
            for key, value in scene.items()
        }
        doubles = {
            key: value.float()
            for key, value in tensors.items()
            if value.dtype == torch.float64
        }
        numbers = {"left_out": torch.tensor(int(left_out))}
        return TensorDict(tensors | doubles | numbers, batch_size=[])


def _agents(
    recording: Recording,
    frame: int,
    states: np.ndarray,
    valid: np.ndarray,
    settings: BuildSettings,
) -> tuple[Arrays, np.ndarray]:
    """Start states, past and recorded future of the agents that take part, their
    heights at the start, which are not part of a scene, and the scene's origin [2];
    states, valid: the smoothed tracks; recording: its tracks until the start frame."""
    start, accel, yaw_rate = causal_state(recording.states, valid, frame=frame)
    start = np.where(valid[frame, :, None], start, 0.0)
    origin = np.round(start[recording.ego, :2])
    shift = np.array([*origin, 0.0, 0.0])
    tracks, left_out = _participants(
        recording, frame, states=states, valid=valid, settings=settings
    )
    rows = np.flatnonzero(tracks >= 0)
    chosen = tracks[rows]
    cars = rows[rows < settings.vehicles]
    frames = frame + np.arange(settings.steps + 1)
    recorded = np.minimum(frames, len(valid) - 1)
    present = valid[frame, chosen]
    known = valid[recorded][:, chosen] & (frames < len(valid))[:, None]
    logged = np.where(known[..., None], states[recorded][:, chosen] - shift, 0.0)

    def padded(values: np.ndarray, fill: float = 0) -> np.ndarray:
        out = np.full((len(tracks), *values.shape[1:]), fill, values.dtype)
        out[rows] = values
        return out

    scene = {
        "start": padded((start[chosen] - shift) * present[:, None]),
        "start_accel": padded(accel[chosen] * present),
        "start_yaw_rate": padded(yaw_rate[chosen] * present),
        "valid": padded(present),
        "size": padded(recording.size[chosen].astype(float), 1),
        "agent_type": padded(recording.agent_type[chosen].astype(np.int64)),
        "parked": np.zeros(len(tracks), bool),
        "logged": padded(logged.swapaxes(0, 1)).swapaxes(0, 1),
        "logged_valid": padded(known.T).T,
        "past": np.zeros((settings.vehicles, PAST, 3)),
        "left_out": np.array(left_out),
        "height": padded(
            np.full(len(rows), np.nan)
            if recording.heights is None
            else recording.heights[frame, chosen]
        ),
    }
    past = causal_past(
        recording.states[:, tracks[cars]],
        valid[:, tracks[cars]],
        frame=frame,
        speed=start[tracks[cars], 3],
    )
    scene["past"][cars] = past
    return scene, origin


def _participants(
    recording: Recording,
    frame: int,
    states: np.ndarray,
    valid: np.ndarray,
    settings: BuildSettings,
) -> tuple[np.ndarray, int]:
    """Returns the track of each agent [N], -1 for padding, and how many vehicles that
    come near no traffic drives.

    Rows of vehicles hold the ego, the vehicles at the start frame by their distance,
    then those that appear later and come near, which only a replay shows. Where the
    rows do not suffice, vehicles that stand leave theirs to those that move, first
    those farthest from the ego's path; of those that move, the ones whose paths come
    near it are taken first, the nearest of them at the start. Other agents follow,
    those that come nearest to the ego.

    Args:
        recording: of the log.
        frame: the start frame.
        states, valid: the smoothed tracks.
        settings: how many agents of which kind there are.
    """
    ego = recording.ego
    vehicle = recording.agent_type == VEHICLE
    span = slice(frame, frame + settings.steps + 1)
    distance = np.linalg.norm(states[span, :, :2] - states[span, [ego], :2], axis=-1)
    path_distance, moves = _approach(
        states[span], valid[span], vehicle=vehicle, ego=ego
    )
    present = valid[frame] & vehicle
    start_distance = np.where(present, distance[0], np.inf)
    start_distance[ego] = path_distance[ego] = -1.0
    moves[ego] = True
    beyond = np.argsort(np.argsort(start_distance, kind="stable")) >= settings.vehicles
    near = vehicle & (path_distance < NEAR)
    rank = np.where(moves, start_distance, path_distance)
    priority = np.lexsort((rank, ~near, beyond & ~moves, ~moves, ~present))
    cars = priority[: min(settings.vehicles, present.sum())]
    cars = cars[np.argsort(start_distance[cars], kind="stable")]
    late = np.flatnonzero(near & ~present)
    late = late[np.argsort(path_distance[late], kind="stable")][
        : settings.vehicles - len(cars)
    ]
    nearest = np.where(valid[span] & valid[span, [ego]], distance, np.inf).min(
        0, initial=np.inf
    )
    nearest[vehicle] = np.inf
    others = np.argsort(nearest, kind="stable")[: settings.others]
    others = others[np.isfinite(nearest[others])]
    tracks = np.full(settings.vehicles + settings.others, -1)
    tracks[: len(cars)] = cars
    tracks[len(cars) : len(cars) + len(late)] = late
    tracks[settings.vehicles : settings.vehicles + len(others)] = others
    near[cars] = False
    return tracks, int(near.sum())


def _approach(
    states: np.ndarray, valid: np.ndarray, vehicle: np.ndarray, ego: int
) -> tuple[np.ndarray, np.ndarray]:
    """Returns how near the path of each vehicle comes to the ego's [A] m, at whatever
    times, and whether it moves [A].

    Args:
        states, valid: [F, A, 4], [F, A], from the start frame on.
        vehicle: [A] bool; other agents are infinitely far, and do not move.
        ego: its track.
    """
    path_distance = np.full(len(vehicle), np.inf)
    moves = np.zeros(len(vehicle), bool)
    known = valid & vehicle
    frame, track = known.nonzero()
    points = states[frame, track, :2]
    path = states[valid[:, ego], ego, :2]
    if len(path) and len(points):
        np.minimum.at(path_distance, track, cKDTree(path).query(points)[0])
    first = states[known.argmax(0), np.arange(len(vehicle)), :2]
    moves[track[np.linalg.norm(points - first[track], axis=-1) > MOVES]] = True
    return path_distance, moves


def _routes(
    scene: Arrays,
    graph: LaneGraph,
    origin: np.ndarray,
    lights: dict[str, int],
    settings: BuildSettings,
    elsewhere: Callable[[int], np.ndarray | None],
) -> Arrays:
    """Route candidates of every vehicle and the one driven; sets scene["parked"].

    lights: lane id -> index; elsewhere: the points of lanes on another level than a
    vehicle, by its row.
    """
    shape = (settings.vehicles, settings.routes)
    reach = (settings.vertices - 1) * SPACING
    out = {
        "route_points": np.zeros((*shape, settings.vertices, 2)),
        "route_length": np.full(shape, reach),
        "route_open": np.zeros(shape, bool),
        "route_valid": np.zeros(shape, bool),
        "route_recorded": np.zeros(shape, bool),
        "route_limit": np.zeros((*shape, settings.vertices), np.float32),
        "route_light": np.full((*shape, MAX_LIGHTS), -1),
        "route_light_s": np.zeros((*shape, MAX_LIGHTS)),
    }
    standing: list[tuple[int, Route]] = []  # whose candidates, one by one
    for row in range(settings.vehicles):
        x, y, heading, speed = scene["start"][row]
        ahead = np.arange(settings.vertices)[:, None] * SPACING - BEHIND
        out["route_points"][row] = np.array([x, y]) + ahead * np.array(
            [np.cos(heading), np.sin(heading)]
        )
        if not scene["valid"][row]:
            continue
        position = np.array([x, y]) + origin
        found = graph.candidates(
            position,
            heading,
            max(speed, 0.0),
            settings.routes,
            settings.vertices,
            elsewhere(row),
        )
        for index, route in enumerate(found):
            _write_route(out, (row, index), route=route, origin=origin, lights=lights)
        scene["parked"][row] = abs(speed) < STANDING
        standing += [(row, route) for route in found if abs(speed) < STANDING]
    if standing:
        rows, routes = map(list, zip(*standing, strict=True))
        scene["parked"][
            np.array(rows)[
                _on_lane(graph, routes, position=scene["start"][rows, :2] + origin)
            ]
        ] = False
    out["route_log"] = _driven(scene, out)
    if (
        out["route_log"][0] < 0
    ):  # no lane route fits the ego's recorded path: it becomes the last candidate
        slot = min(int(out["route_valid"][0].sum()), settings.routes - 1)
        track = scene["logged"][scene["logged_valid"][:, 0], 0] + [*origin, 0.0, 0.0]
        _write_route(
            out,
            (0, slot),
            route=route_from_log(graph, track, vertices=settings.vertices),
            origin=origin,
            lights=lights,
        )
        out["route_log"][0], out["route_recorded"][0, slot] = slot, True
    return out


def _write_route(
    out: Arrays,
    at: tuple[int, int],
    route: Route,
    origin: np.ndarray,
    lights: dict[str, int],
) -> None:
    out["route_points"][at], out["route_length"][at] = (
        route.points - origin,
        route.length,
    )
    out["route_open"][at], out["route_valid"][at], out["route_limit"][at] = (
        route.open,
        True,
        route.limit,
    )
    ahead = [
        (lights[name], s)
        for name, s in route.lanes
        if name in lights and s > route.vehicle_s - PASSED
    ]
    out["route_light"][at], out["route_light_s"][at] = -1, 0.0
    for k, (index, s) in enumerate(ahead[:MAX_LIGHTS]):
        out["route_light"][at][k], out["route_light_s"][at][k] = index, s


def _on_lane(graph: LaneGraph, routes: list[Route], position: np.ndarray) -> np.ndarray:
    """Whether positions [R, 2] on the map lie within the lane of the route of each
    there [R]."""
    points = torch.from_numpy(np.stack([route.points for route in routes]))
    along, across, _ = project(
        torch.from_numpy(position[:, None]),
        points,
        hint=torch.full((len(routes), 1), BEHIND),
    )
    width = []
    for route, s in zip(routes, along[:, 0].tolist(), strict=True):
        lane = [name for name, start in route.lanes if start <= s + 1e-6][-1:] or [
            route.lanes[0][0]
        ]
        width.append(plausible_width(graph.lanes[lane[0]].width))
    return np.abs(across[:, 0].numpy()) < np.array(width) / 2 + 0.3


def _driven(scene: Arrays, routes: Arrays) -> np.ndarray:
    """The candidate [V] nearest to each vehicle's recorded future, -1 where none is
    near."""
    cars, candidates = routes["route_valid"].shape
    known = torch.from_numpy(scene["logged_valid"][:, :cars].T.copy())
    valid = torch.from_numpy(routes["route_valid"]) & known.any(1, keepdim=True)
    car = valid.nonzero()[:, 0]
    track = torch.from_numpy(scene["logged"][:, :cars].swapaxes(0, 1).copy())[car]
    points, length, closed = (
        torch.from_numpy(value)[valid]
        for value in (
            routes["route_points"],
            routes["route_length"],
            ~routes["route_open"],
        )
    )
    s, d, heading = project_track(
        track[..., :2].contiguous(), points, known=known[car], start=BEHIND
    )
    over = (s - length[:, None]).clamp(min=0) * closed[:, None]
    weight = known[car].double()
    distance = (d.abs() + 2.0 * wrap(heading - track[..., 2]).abs() + over) * weight
    mean = torch.full((cars, candidates), torch.inf, dtype=torch.float64)
    mean[valid] = distance.sum(-1) / weight.sum(-1).clamp(min=1)
    return torch.where(mean.min(1).values < FIT, mean.argmin(1), -1).numpy()


def _lights(recording: Recording, frame: int, origin: np.ndarray, steps: int) -> Arrays:
    """Light states over the simulated steps (the last known one goes on) and the points
    where their lanes begin."""
    if not recording.lights:
        return {
            "light_state": np.zeros((steps + 1, 0), np.int64),
            "light_points": np.zeros((0, 2)),
        }
    states = np.stack(list(recording.lights.values()), 1)
    frames = np.minimum(frame + np.arange(steps + 1), len(states) - 1)
    points = np.stack([recording.lanes[name].points[0] for name in recording.lights])
    return {
        "light_state": states[frames].astype(np.int64),
        "light_points": points - origin,
    }


def _map(
    graph: LaneGraph,
    drivable: DrivableArea,
    scene: Arrays,
    origin: np.ndarray,
    settings: BuildSettings,
) -> Arrays:
    """Lane centrelines at 1 m with widths and neighbours, polygons, and the drivable
    field."""
    number = {name: index for index, name in enumerate(graph.ids)}
    lanes = [graph.lanes[name] for name in graph.ids]
    lines = [graph.line[name] - origin for name in graph.ids]
    widths = np.array([plausible_width(lane.width) for lane in lanes])
    exits = np.full((len(lines), MAX_EXITS), -1)
    for index, name in enumerate(graph.ids):
        nexts = [number[other] for other in graph.graph.successors(name)][:MAX_EXITS]
        exits[index, : len(nexts)] = nexts
    rings = [ring - origin for ring in drivable.polygons]
    ego = scene["logged"][scene["logged_valid"][:, 0], 0, :2]
    field, field_origin = drivable.field(
        origin, (ego.min(0) + ego.max(0)) / 2, settings.field_cells
    )
    lane_points, lane_index = _joined(lines)
    drivable_points, drivable_index = _joined(rings)
    return {
        "lane_points": lane_points,
        "lane_index": lane_index,
        "lane_width": widths,
        "lane_exits": exits,
        "lane_left": np.array(
            [next((number[n] for n in lane.left if n in number), -1) for lane in lanes]
        ),
        "lane_right": np.array(
            [next((number[n] for n in lane.right if n in number), -1) for lane in lanes]
        ),
        "drivable_points": drivable_points,
        "drivable_index": drivable_index,
        "field": field,
        "field_origin": field_origin,
    }


def _joined(parts: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The points of polylines in a row [P, 2], and which polyline each belongs to [P]."""
    index = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    return np.concatenate([np.zeros((0, 2)), *parts]), index


def ego_overlaps(scene: TensorDict) -> str:
    """Returns what the ego's box overlaps at the start frame, in words and vehicles
    first; "" for nobody.

    Args:
        scene: one scene (e2rl/scenes/scene.py).
    """
    others = scene["valid"].clone()
    others[0] = False
    pose = scene["start"].double()
    size = scene["size"].double()
    overlap = boxes.overlap(pose[:1], size[:1], second=pose, second_size=size) & others
    return AGENT_WORDS[int(scene["agent_type"][overlap].min())] if overlap.any() else ""
