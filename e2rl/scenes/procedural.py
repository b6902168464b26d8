"""Source of fresh traffic on the bundled lane graphs, generated when it is loaded.

Vehicles follow random routes by the IDM, stop at red lights, give way at crossing routes to the vehicle that arrives
first, and drift a little within their lanes. A draw with overlaps is repaired by leaving a vehicle out, or discarded.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np

from e2rl.run.errors import InputError
from e2rl.run.settings import check_range
from e2rl.scenes.bundled import CURRENT, FRAMES, SceneMap, load_maps
from e2rl.scenes.interaction import interaction_score, lateral_acceleration, overlap, overlapping_pairs
from e2rl.scenes.lane_graph import LaneGraph
from e2rl.scenes.paths import WHEELBASE, arc_length, points_at, shift_left, tractrix, whittaker, wrap
from e2rl.scenes.recording import DT, LIGHT_RED, LIGHT_YELLOW, Recording
from e2rl.scenes.source import Source
from e2rl.scenes.traffic_flow import STEP, Fleet, StopLine, roll

WARM_UP = 15  # frames before the recorded ones, in which drivers settle
ROUTE = 420.0  # m at most
RADIUS = 120.0  # m around the focus in which vehicles are spawned
TRAVEL, BORDER, LATERAL = 20.0, 25.0, 5.0  # m that the ego drives; m of route left at the end; m/s^2
PATH_PENALTY = 300.0
JUNCTIONS = 0.75  # share of scenes that are centred on a junction
REPAIRS, ATTEMPTS = 4, 40
LEAST, MOST, MOST_PARKED = 4, 28, 8  # vehicles, parked cars


@dataclass
class ProceduralSource(Source):
    """`count` scenes of fresh traffic on the maps of a bundled split, the same for the same seed.

    Each has 11 frames of history (the last is the start frame) and 100 to come, an ego that drives more than 20 m, and
    no overlapping boxes.
    """

    split: str | None = "test"
    count: int = 60
    seed: int = 0

    has_splits = True

    def logs(self) -> list[str]:
        check_range("data.count", self.count, 1)
        load_maps(self.split_name)  # an unknown split is refused before any work
        return [f"procedural_{self.seed}_{index:05d}" for index in range(self.count)]

    def read(self, log: str) -> Iterator[Recording]:
        maps, index = load_maps(self.split_name), int(log.rpartition("_")[2])
        for attempt in range(ATTEMPTS):
            rng = np.random.default_rng([self.seed, index, attempt])
            pick = int(rng.integers(len(maps)))
            recording = generate(maps[pick], _lane_graph(self.split_name, pick), log, rng)
            if recording is not None:
                yield recording
                return
        raise InputError(f"{log}: no sound traffic in {ATTEMPTS} draws; use another data.seed")


@cache
def _lane_graph(split: str, index: int) -> LaneGraph:
    return LaneGraph(load_maps(split)[index].lanes)


def generate(scene_map: SceneMap, graph: LaneGraph, scene_id: str, rng: np.random.Generator) -> Recording | None:
    """One recording of fresh traffic, or None where this draw gives none."""
    drawn = draw_fleet(graph, rng)
    if drawn is None:
        return None
    fleet, routes = drawn
    programme = len(next(iter(scene_map.lights.values()))) if scene_map.lights else 0
    total = WARM_UP + FRAMES
    first = int(rng.integers(programme - total + 1)) if programme else 0
    closed = {
        lane: np.isin(state[first : first + total], (LIGHT_RED, LIGHT_YELLOW))
        for lane, state in scene_map.lights.items()
    }
    fleet.lights = stop_lines(graph, routes, fleet, closed)
    for _ in range(REPAIRS):
        progress = roll(fleet, total)[WARM_UP:]
        states, valid = poses(fleet, progress)
        pairs = overlapping_pairs(states, valid, fleet.size)
        harsh = np.flatnonzero(np.abs(lateral_acceleration(states, valid)).max(0) > LATERAL)
        if not len(pairs) and not len(harsh):
            break
        bad = np.unique(np.concatenate([pairs.max(1, initial=-1), harsh]))
        fleet = fleet.subset(np.setdiff1d(np.arange(len(fleet.size)), bad))
        if len(fleet.size) < LEAST:
            return None
    else:
        return None
    ego = choose_ego(fleet, progress, states, valid, rng)
    if ego is None:
        return None
    traffic = add_parked(scene_map, states, valid, fleet.size, ego, rng)
    return scene_map.recording("procedural", scene_id, first + WARM_UP, *traffic, ego).validate()


def draw_fleet(graph: LaneGraph, rng: np.random.Generator) -> tuple[Fleet, list[list[str]]] | None:
    """Vehicles on random lanes near a random focus, with safe gaps, and the lanes of their routes; None: too few."""
    junction = np.flatnonzero([graph.ids[lane].startswith(":") for lane in graph.lane_of])  # points within junctions
    pool = junction if len(junction) and rng.random() < JUNCTIONS else np.arange(len(graph.points))
    focus = graph.points[pool[rng.integers(len(pool))]]
    near = np.flatnonzero(np.linalg.norm(graph.points - focus, axis=1) < RADIUS)
    wanted = int(rng.integers(8, MOST + 1))
    lanes, starts = [], []
    pose, size = np.zeros((0, 3)), np.zeros((0, 2))
    for point in rng.permutation(near)[: 4 * wanted]:
        lane = graph.ids[graph.lane_of[point]]
        new_pose = np.array([[*graph.points[point], graph.heading[point]]])
        new_size = np.array([[rng.uniform(4.0, 5.6), rng.uniform(1.72, 2.05)]])
        room = np.array([rng.uniform(4.0, 16.0), 0.6])
        if lane.startswith(":") or overlap(new_pose, new_size + 2 * room, pose, size).any():
            continue
        lanes.append(lane)
        starts.append(graph.arc_of(point))
        pose, size = np.concatenate([pose, new_pose]), np.concatenate([size, new_size])
        if len(lanes) == wanted:
            break
    if len(lanes) < LEAST:
        return None
    routes = [random_route(graph, lane, rng) for lane in lanes]
    return make_fleet(graph, routes, np.array(starts), size, rng), routes


def random_route(graph: LaneGraph, lane: str, rng: np.random.Generator) -> list[str]:
    """A random lane sequence from `lane`, ROUTE m long or to the map's end."""
    route, length = [lane], graph.arc[lane]
    while length < ROUTE:
        nexts = [name for name in graph.graph.successors(route[-1]) if name not in route]
        if not nexts:
            break
        route.append(nexts[rng.integers(len(nexts))])
        length += graph.arc[route[-1]]
    return route


def make_fleet(
    graph: LaneGraph, routes: list[list[str]], start: np.ndarray, size: np.ndarray, rng: np.random.Generator
) -> Fleet:
    """Paths, speed bounds and drivers of vehicles on routes [A], from arc length start [A] of the first lane."""
    count, at = len(routes), np.arange(int(1.1 * ROUTE / STEP)) * STEP
    front = np.zeros((count, len(at), 2))
    limit, length = np.zeros((count, len(at))), np.zeros(count)
    for k, route in enumerate(routes):
        line = graph.centreline(route)
        drift = rng.normal(0, 0.12) + 0.13 * np.sin(at / rng.uniform(9, 16) + rng.uniform(0, 2 * np.pi))
        path = shift_left(points_at(line, arc_length(line), at), np.clip(drift, -0.35, 0.35))
        front[k] = whittaker(path, PATH_PENALTY)
        lane_starts = graph.lane_starts(route)
        speeds = np.array([graph.lanes[name].speed_limit or 13.9 for name in route])
        limit[k] = speeds[np.clip(np.searchsorted(lane_starts, at, "right") - 1, 0, len(route) - 1)]
        length[k] = min(lane_starts[-1], at[-1])
    centre, heading = tractrix(front, WHEELBASE * size[:, 0])
    bend = np.abs(np.gradient(heading, STEP, axis=1))
    factor = np.clip(rng.normal(1.0, 0.1, count), 0.75, 1.2)[:, None]
    limit = np.minimum(factor * limit, np.sqrt(rng.uniform(1.4, 2.6, (count, 1)) / np.maximum(bend, 1e-4)))
    initial = limit[np.arange(count), np.minimum((start / STEP).astype(int), len(at) - 1)]
    drivers = {
        "accel": rng.uniform(1.2, 2.2, count),
        "brake": rng.uniform(1.6, 2.6, count),
        "headway": np.clip(rng.lognormal(np.log(1.3), 0.3, count), 0.8, 2.3),
        "gap": rng.uniform(1.8, 3.5, count),
        "speed": rng.uniform(0.1, 1.0, count) * initial,
    }
    return Fleet(front, centre, heading, limit, length, start, size, **drivers)


def stop_lines(
    graph: LaneGraph, routes: list[list[str]], fleet: Fleet, closed: dict[str, np.ndarray]
) -> list[StopLine]:
    """The stop lines of all lights on the routes, ahead of the vehicles; closed: lane id -> [T] red or yellow."""
    return [
        (k, float(s), closed[name])
        for k, route in enumerate(routes)
        for name, s in zip(route, graph.lane_starts(route)[:-1], strict=True)
        if name in closed and s > fleet.start[k]
    ]


def poses(fleet: Fleet, progress: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """States [F, A, 4] and valid [F, A] of the fleet at `progress` [F, A] on its paths; speed is displacement."""
    index = np.clip(progress / STEP, 0, fleet.centre.shape[1] - 2)
    low = index.astype(int)
    part = (index - low)[..., None]
    own = np.arange(progress.shape[1])
    xy = (1 - part) * fleet.centre[own, low] + part * fleet.centre[own, low + 1]
    heading = (1 - part[..., 0]) * fleet.heading[own, low] + part[..., 0] * fleet.heading[own, low + 1]
    velocity = np.gradient(xy, DT, axis=0)
    speed = np.maximum(velocity[..., 0] * np.cos(heading) + velocity[..., 1] * np.sin(heading), 0.0)
    valid = progress < fleet.length
    states = np.concatenate([xy, wrap(heading)[..., None], speed[..., None]], -1)
    return np.where(valid[..., None], states, 0.0), valid


def choose_ego(
    fleet: Fleet, progress: np.ndarray, states: np.ndarray, valid: np.ndarray, rng: np.random.Generator
) -> int | None:
    """The vehicle that interacts most among those that drive and stay on the map; None where there is none."""
    travelled = progress[CURRENT + 80] - progress[CURRENT]
    good = valid.all(0) & (travelled > TRAVEL) & (progress[-1] < fleet.length - BORDER)
    if not good.any():
        return None
    score = interaction_score(states, valid) + rng.gumbel(size=len(good))
    return int(np.where(good, score, -np.inf).argmax())


def add_parked(
    scene_map: SceneMap, states: np.ndarray, valid: np.ndarray, size: np.ndarray, ego: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States, valid and size of the traffic and of some of the map's parked cars, those that no vehicle touches."""
    distance = np.linalg.norm(scene_map.parked[:, :2] - states[CURRENT, ego, :2], axis=-1)
    chosen = np.argsort(distance, kind="stable")[: int(rng.integers(0, MOST_PARKED + 1))]
    pose, body = scene_map.parked[chosen], scene_map.parked_size[chosen]
    hit = (overlap(states[:, :, None, :3], size[:, None] + 0.2, pose, body) & valid[..., None]).any((0, 1))
    pose, body = pose[~hit], body[~hit]
    still = np.tile(np.concatenate([pose, np.zeros((len(pose), 1))], -1), (len(states), 1, 1))
    known = np.ones(still.shape[:2], bool)
    return np.concatenate([states, still], 1), np.concatenate([valid, known], 1), np.concatenate([size, body])
