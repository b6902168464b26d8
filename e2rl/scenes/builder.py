"""From a Recording to a Scene: who takes part, from which start state, on which routes,
on which map."""

from collections import Counter
from collections.abc import Callable
from dataclasses import (
    dataclass,
    replace,
)

import numpy as np
import torch
from numpy import ndarray
from scipy.spatial import cKDTree
from tensordict import TensorDict

from e2rl.run.config import (
    configured,
    setting,
)
from e2rl.run.errors import InputError
from e2rl.scenes import boxes
from e2rl.scenes.drivable_area import DrivableArea
from e2rl.scenes.headings import (
    hold_headings,
    mend_headings,
)
from e2rl.scenes.lane_graph import (
    LaneGraph,
    Route,
)
from e2rl.scenes.levels import Levels
from e2rl.scenes.limits import known_limits
from e2rl.scenes.log_route import route_from_log
from e2rl.scenes.paths import (
    direction,
    part_of,
    stacked,
    wrap,
)
from e2rl.scenes.plausibility import (
    check,
    extent,
    map_fit,
    motion,
)
from e2rl.scenes.recording import (
    AGENT_WORDS,
    VEHICLE,
    Recording,
)
from e2rl.scenes.route import (
    BEHIND,
    SPACING,
    project,
    project_track,
)
from e2rl.scenes.smoothing import (
    PAST,
    causal_past,
    causal_state,
    drop_jumps,
    smooth,
)

Arrays = dict[str, ndarray]
STANDING = 0.5  # m/s
MOVES = 2.0  # m from where it was, of a vehicle that moves
NEAR = 10.0  # m between the paths of centres that come near
FIT = 2.0  # m on average from a recorded future to the candidate that is driven
PASSED = 1.0  # m behind the vehicle's centre beyond which a stop line no longer counts
BORDER = 0.3  # m beyond a lane's border where a vehicle still stands on it
OTHER_LEVEL = "agents on another level than the ego, on a bridge or below one, left out"
MAX_EXITS = 6  # successors of a lane that a scene keeps
MAX_LIGHTS = 2  # lights of a route that it keeps


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
        self.settings = settings
        self.repairs = Counter(recording.repairs)
        check(extent(recording), recording.scene_id)
        self.valid = drop_jumps(recording.states, recording.valid)
        egos = recording.all_egos()  # without the ego there is no scene
        self.valid[:, egos] = recording.valid[:, egos]
        kinds = recording.agent_type
        self.mended, turned = mend_headings(recording.states, recording.valid, kinds)
        recording = replace(recording, states=self.mended)
        check(motion(recording), recording.scene_id)
        held, count = hold_headings(self.mended, self.valid, kinds)
        self.states = smooth(held, self.valid)
        self.repairs += Counter(turned)
        self.repairs["headings held while standing"] += count
        lanes, limits = known_limits(recording)
        self.graph = LaneGraph(lanes)
        self.repairs += limits + self.graph.repairs
        if not self.graph.ids:
            raise InputError(
                f"scene {recording.scene_id!r}: no lane is at least 0.5 m long; "
                "leave the scene out"
            )
        check(map_fit(recording, self.graph), recording.scene_id)
        self.levels = Levels(recording, self.graph, valid=self.valid)
        self.elsewhere = {recording.ego: self.levels.elsewhere(recording.ego)}
        self.repairs[OTHER_LEVEL] += int(self.elsewhere[recording.ego].sum())
        self.repairs = +self.repairs
        rings = [ring for ring in recording.drivable if len(ring) >= 3]
        lines = list(self.graph.line.values())
        self.drivable = DrivableArea(lines, self.graph.widths, polygons=rings)

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
        past = slice(frame + 1)
        kinds = recording.agent_type
        held, _ = hold_headings(self.mended[past], self.valid[past], kinds)
        agents = _Agents(
            recording,
            self.settings,
            states=self.states,
            valid=valid,
        )
        scene, origin = agents.at(frame, held)
        away = self.levels.lanes_elsewhere(agents.heights(frame))
        lights = {name: index for index, name in enumerate(recording.lights)}
        routes = _Routes(
            self.graph,
            self.settings,
            origin=origin,
            lights=lights,
        )
        scene |= routes.of(scene, away)
        scene |= _lights(
            recording,
            frame,
            origin=origin,
            steps=self.settings.steps,
        )
        scene |= self._map(scene, origin)
        tensors = {
            key: torch.from_numpy(np.ascontiguousarray(value))
            for key, value in scene.items()
        }
        floats = {
            key: value.float() if value.dtype == torch.float64 else value
            for key, value in tensors.items()
        }
        left_out = torch.tensor(agents.left_out)
        return TensorDict(floats | {"left_out": left_out}, batch_size=[])

    def _map(self, scene: Arrays, origin: ndarray) -> Arrays:
        """Lane centrelines at 1 m with widths and neighbours, polygons, and the
        drivable field."""
        graph = self.graph
        exits = np.full((len(graph.ids), MAX_EXITS), -1)
        sides = np.full((2, len(graph.ids)), -1)
        for index, (name, lane) in enumerate(graph.lanes.items()):
            nexts = list(graph.graph.successors(name))[:MAX_EXITS]
            exits[index, : len(nexts)] = [graph.number[other] for other in nexts]
            for side, names in enumerate((lane.left, lane.right)):
                inside = [graph.number[name] for name in names if name in graph.number]
                sides[side, index] = inside[0] if inside else -1
        rings = [ring - origin for ring in self.drivable.polygons]
        ego = scene["logged"][scene["logged_valid"][:, 0], 0, :2]
        center = (ego.min(0) + ego.max(0)) / 2
        field, corner = self.drivable.field(origin, center, self.settings.field_cells)
        return {
            "lane_points": graph.points - origin,
            "lane_index": graph.lane_of,
            "lane_width": graph.widths,
            "lane_exits": exits,
            "lane_left": sides[0],
            "lane_right": sides[1],
            "drivable_points": stacked(rings),
            "drivable_index": part_of(rings),
            "field": field,
            "field_origin": corner,
        }


@dataclass
class _Agents:
    """Who takes part in a scene.

    recording: with the start frame and the ego; states, valid: the smoothed tracks;
    tracks [N]: of each agent, -1 for padding; left_out: how many vehicles come near
    that no traffic drives.
    """

    recording: Recording
    settings: BuildSettings
    states: ndarray
    valid: ndarray

    def __post_init__(self) -> None:
        settings = self.settings
        self.tracks = np.full(settings.vehicles + settings.others, -1)
        self.left_out = self._choose()
        self.rows = np.flatnonzero(self.tracks >= 0)
        self.chosen = self.tracks[self.rows]

    def at(self, frame: int, held: ndarray) -> tuple[Arrays, ndarray]:
        """Start states, past and recorded future from a start frame on, and the scene's
        origin [2]; held: the recorded tracks until then."""
        valid = self.valid
        settings = self.settings
        chosen = self.chosen
        start, accel, yaw_rate = causal_state(held, valid, frame=frame)
        start = np.where(valid[frame, :, None], start, 0.0)
        origin = np.round(start[self.recording.ego, :2])
        shift = np.array([*origin, 0.0, 0.0])
        frames = frame + np.arange(settings.steps + 1)
        recorded = np.minimum(frames, len(valid) - 1)
        logged_valid = valid[recorded][:, chosen] & (frames < len(valid))[:, None]
        logged = self.states[recorded][:, chosen] - shift
        logged = np.where(logged_valid[..., None], logged, 0.0)
        present = valid[frame, chosen]
        cars = self.rows < settings.vehicles
        tracks = chosen[cars]
        past = np.zeros((settings.vehicles, PAST, 3))
        past[self.rows[cars]] = causal_past(
            held[:, tracks],
            valid[:, tracks],
            frame=frame,
            speed=start[tracks, 3],
        )
        padded = self._padded
        kinds = self.recording.agent_type[chosen]
        scene = {
            "start": padded((start[chosen] - shift) * present[:, None]),
            "start_accel": padded(accel[chosen] * present),
            "start_yaw_rate": padded(yaw_rate[chosen] * present),
            "valid": padded(present),
            "size": padded(self.recording.size[chosen].astype(float), fill=1),
            "agent_type": padded(kinds.astype(np.int64)),
            "parked": np.zeros(len(self.tracks), bool),
            "logged": padded(logged.swapaxes(0, 1)).swapaxes(0, 1),
            "logged_valid": padded(logged_valid.T).T,
            "past": past,
        }
        return scene, origin

    def heights(self, frame: int) -> ndarray:
        """Heights of the agents [N] m at a frame, NaN unknown."""
        heights = self.recording.heights
        if heights is None:
            return np.full(len(self.tracks), np.nan)
        return self._padded(heights[frame, self.chosen])

    def _padded(self, values: ndarray, fill: float = 0) -> ndarray:
        out = np.full((len(self.tracks), *values.shape[1:]), fill, values.dtype)
        out[self.rows] = values
        return out

    def _choose(self) -> int:
        """Set the track of each agent; returns how many vehicles come near and are none.

        Rows of vehicles hold the ego, the vehicles at the start frame by their
        distance, then those that appear later and come near, which only a replay shows.
        Where the rows do not suffice, vehicles that stand leave theirs to those that
        move, first those farthest from the ego's path; of those that move, the ones
        whose paths come near it are taken first, the nearest of them at the start.
        Other agents follow, those that come nearest to the ego.
        """
        ego = self.recording.ego
        vehicles = self.settings.vehicles
        others = self.settings.others
        frame = self.recording.current
        assert frame is not None
        span = slice(frame, frame + self.settings.steps + 1)
        states = self.states[span]
        valid = self.valid[span]
        vehicle = self.recording.agent_type == VEHICLE
        offset = states[..., :2] - states[:, [ego], :2]
        distance = np.linalg.norm(offset, axis=-1)
        path_distance, moves = _approach(
            states,
            valid & vehicle,
            valid[:, ego],
            ego,
        )
        present = valid[0] & vehicle
        start_distance = np.where(present, distance[0], np.inf)
        start_distance[ego] = path_distance[ego] = -1.0
        moves[ego] = True
        rank = np.argsort(np.argsort(start_distance, kind="stable"))
        waits = (rank >= vehicles) & ~moves
        near = vehicle & (path_distance < NEAR)
        rank = np.where(moves, start_distance, path_distance)
        priority = np.lexsort((rank, ~near, waits, ~moves, ~present))
        cars = priority[: min(vehicles, present.sum())]
        cars = cars[np.argsort(start_distance[cars], kind="stable")]
        late = np.flatnonzero(near & ~present)
        late = late[np.argsort(path_distance[late], kind="stable")]
        cars = np.concatenate([cars, late])[:vehicles]
        both = valid & valid[:, [ego]]
        nearest = np.where(both, distance, np.inf).min(0, initial=np.inf)
        nearest[vehicle] = np.inf
        rest = np.argsort(nearest, kind="stable")[:others]
        rest = rest[np.isfinite(nearest[rest])]
        self.tracks[: len(cars)] = cars
        self.tracks[vehicles : vehicles + len(rest)] = rest
        near[cars[present[cars]]] = False
        return int(near.sum())


def _approach(
    states: ndarray,
    valid: ndarray,
    ego_valid: ndarray,
    ego: int,
) -> tuple[ndarray, ndarray]:
    """Returns how near the path of each vehicle comes to the ego's [A] m, at whatever
    times, and whether it moves [A].

    states, valid: [F, A, 4], [F, A] of vehicles, from the start frame on; others are
    infinitely far, and do not move; ego_valid: [F] of the track `ego`.
    """
    path_distance = np.full(valid.shape[1], np.inf)
    moves = np.zeros(valid.shape[1], bool)
    frame, track = valid.nonzero()
    points = states[frame, track, :2]
    path = states[ego_valid, ego, :2]
    if len(path) and len(points):
        np.minimum.at(path_distance, track, cKDTree(path).query(points)[0])
    first = states[valid.argmax(0), np.arange(valid.shape[1]), :2]
    moves[track[np.linalg.norm(points - first[track], axis=-1) > MOVES]] = True
    return path_distance, moves


@dataclass
class _Routes:
    """Route candidates of the vehicles of a scene, as arrays; lights: lane id ->
    index."""

    graph: LaneGraph
    settings: BuildSettings
    origin: ndarray
    lights: dict[str, int]

    def __post_init__(self) -> None:
        settings = self.settings
        shape = (settings.vehicles, settings.routes)
        reach = (settings.vertices - 1) * SPACING
        self.arrays: Arrays = {
            "route_points": np.zeros((*shape, settings.vertices, 2)),
            "route_length": np.full(shape, reach),
            "route_open": np.zeros(shape, bool),
            "route_valid": np.zeros(shape, bool),
            "route_recorded": np.zeros(shape, bool),
            "route_limit": np.zeros((*shape, settings.vertices), np.float32),
            "route_light": np.full((*shape, MAX_LIGHTS), -1),
            "route_light_s": np.zeros((*shape, MAX_LIGHTS)),
        }

    def of(self, scene: Arrays, away: Callable[[int], ndarray | None]) -> Arrays:
        """The candidates of every vehicle and the one driven; sets scene["parked"].

        away: the points of lanes on another level than a vehicle, by its row.
        """
        graph = self.graph
        arrays = self.arrays
        vertices = self.settings.vertices
        slots = self.settings.routes
        poses = scene["start"][: self.settings.vehicles]
        ahead = np.arange(vertices)[:, None] * SPACING - BEHIND
        straight = poses[:, None, :2] + ahead * direction(poses[:, 2])[:, None]
        arrays["route_points"][:] = straight[:, None]
        standing: list[tuple[int, Route]] = []  # whose candidates, one by one
        for row in np.flatnonzero(scene["valid"][: len(poses)]).tolist():
            pose = poses[row] + [*self.origin, 0.0, 0.0]
            routes = graph.candidates(
                pose,
                slots,
                vertices=vertices,
                away=away(row),
            )
            for slot, route in enumerate(routes):
                self._write((row, slot), route)
            if abs(pose[3]) < STANDING:
                scene["parked"][row] = True
                standing += [(row, route) for route in routes]
        if standing:
            rows = np.array([row for row, _ in standing])
            position = poses[rows, :2] + self.origin
            on_lane = _on_lane(graph, [route for _, route in standing], position)
            scene["parked"][rows[on_lane]] = False
        arrays["route_log"] = _driven(scene, arrays)
        if arrays["route_log"][0] < 0:
            # no lane fits the ego's recorded path: it becomes the last candidate
            slot = min(int(arrays["route_valid"][0].sum()), slots - 1)
            track = scene["logged"][scene["logged_valid"][:, 0], 0]
            track = track + [*self.origin, 0.0, 0.0]
            self._write((0, slot), route_from_log(graph, track, vertices=vertices))
            arrays["route_log"][0] = slot
            arrays["route_recorded"][0, slot] = True
        return arrays

    def _write(self, place: tuple[int, int], route: Route) -> None:
        for name, value in (
            ("points", route.points - self.origin),
            ("length", route.length),
            ("open", route.open),
            ("valid", True),
            ("limit", route.limit),
            ("light", -1),
            ("light_s", 0.0),
        ):
            self.arrays[f"route_{name}"][place] = value
        lights = [
            (self.lights[name], s)
            for name, s in route.lanes
            if name in self.lights and s > route.vehicle_s - PASSED
        ]
        for k, (index, s) in enumerate(lights[:MAX_LIGHTS]):
            self.arrays["route_light"][place][k] = index
            self.arrays["route_light_s"][place][k] = s


def _on_lane(
    graph: LaneGraph,
    routes: list[Route],
    position: ndarray,
) -> ndarray:
    """Whether positions [R, 2] on the map lie within the lane of the route of each
    there [R]."""
    along, across, _ = project(
        torch.from_numpy(position[:, None]),
        torch.from_numpy(np.stack([route.points for route in routes])),
        hint=torch.full((len(routes), 1), BEHIND),
    )
    widths = []
    for route, s in zip(routes, along[:, 0].tolist(), strict=True):
        passed = [name for name, start in route.lanes if start <= s + 1e-6]
        lane = passed[-1] if passed else route.lanes[0][0]
        widths.append(graph.widths[graph.number[lane]])
    return np.abs(across[:, 0].numpy()) < np.array(widths) / 2 + BORDER


def _driven(scene: Arrays, routes: Arrays) -> ndarray:
    """The candidate [V] nearest to each vehicle's recorded future, -1 where none is
    near."""
    shape = routes["route_valid"].shape
    vehicles = slice(shape[0])
    recorded = torch.from_numpy(scene["logged_valid"][:, vehicles].T.copy())
    logged = torch.from_numpy(scene["logged"][:, vehicles].swapaxes(0, 1).copy())
    valid = torch.from_numpy(routes["route_valid"]) & recorded.any(1, keepdim=True)
    vehicle = valid.nonzero()[:, 0]
    track = logged[vehicle]
    recorded = recorded[vehicle]
    points = torch.from_numpy(routes["route_points"])[valid]
    length = torch.from_numpy(routes["route_length"])[valid]
    closed = ~torch.from_numpy(routes["route_open"])[valid]
    s, d, heading = project_track(
        track[..., :2].contiguous(),
        points,
        known=recorded,
        start=BEHIND,
    )
    beyond = (s - length[:, None]).clamp(min=0) * closed[:, None]
    weight = recorded.double()
    distance = d.abs() + 2.0 * wrap(heading - track[..., 2]).abs() + beyond
    mean = torch.full(shape, torch.inf, dtype=torch.float64)
    mean[valid] = (distance * weight).sum(-1) / weight.sum(-1).clamp(min=1)
    return torch.where(mean.min(1).values < FIT, mean.argmin(1), -1).numpy()


def _lights(
    recording: Recording,
    frame: int,
    *,
    origin: ndarray,
    steps: int,
) -> Arrays:
    """Light states over the simulated steps (the last known one goes on) and the points
    where their lanes begin."""
    lanes = [recording.lanes[name] for name in recording.lights]
    points = [lane.points[:1] - origin for lane in lanes]
    frames = np.minimum(frame + np.arange(steps + 1), len(recording.states) - 1)
    states = [light[frames] for light in recording.lights.values()]
    shape = (len(states), steps + 1)
    return {
        "light_state": np.array(states, np.int64).reshape(shape).T,
        "light_points": stacked(points),
    }


def ego_overlaps(scene: TensorDict) -> str:
    """Returns what the ego's box overlaps at the start frame of one scene, in words and
    vehicles first; "" for nobody."""
    others = scene["valid"].clone()
    others[0] = False
    pose = scene["start"].double()
    size = scene["size"].double()
    overlap = (
        boxes.overlap(
            pose[:1],
            size[:1],
            second=pose,
            second_size=size,
        )
        & others
    )
    return AGENT_WORDS[int(scene["agent_type"][overlap].min())] if overlap.any() else ""
