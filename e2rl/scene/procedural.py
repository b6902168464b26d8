"""Source `procedural`: fresh traffic on the bundled lane graphs, made at run time.

Vehicles with random routes follow the IDM along them, keep to red lights, yield at crossing routes to whoever arrives
first, and wander a little within their lanes. Draws with overlaps are repaired by leaving a vehicle out, or discarded.
"""

from dataclasses import dataclass

import numpy as np

from e2rl.errors import InputError
from e2rl.scene.bundled import CURRENT, FRAMES, SceneMap, load_maps
from e2rl.scene.interaction import interaction_score, lateral_acceleration, overlap, overlapping_pairs
from e2rl.scene.lane_graph import LaneGraph
from e2rl.scene.paths import WHEELBASE, arc_length, offset, tractrix, whittaker
from e2rl.scene.recording import DT, LIGHT_RED, LIGHT_YELLOW, VEHICLE, Recording
from e2rl.scene.traffic_flow import STEP, Fleet, roll

WARM_UP = 15  # frames before the recorded ones, in which drivers settle
ROUTE = 420.0  # m at most
RADIUS = 120.0  # m around the focus in which vehicles are spawned
MOVED, BORDER, LATERAL = 20.0, 25.0, 5.0  # m the ego drives, m of way it must have left, m/s^2
PATH_PENALTY = 300.0
JUNCTIONS = 0.75  # share of scenes that are centred on a junction
REPAIRS, ATTEMPTS = 4, 40
MOST, MOST_PARKED = 28, 8


@dataclass
class Ground:
    """A bundled map ready for traffic: its lane graph, and where each point of it lies on its lane."""

    place: SceneMap
    graph: LaneGraph

    def route(self, lane: str, rng: np.random.Generator) -> list[str]:
        """A random way along the lane graph from `lane`, ROUTE m long or to the map's end."""
        way, length = [lane], self.graph.arc[lane]
        while length < ROUTE:
            nexts = [name for name in self.graph.graph.successors(way[-1]) if name not in way]
            if not nexts:
                break
            way.append(nexts[rng.integers(len(nexts))])
            length += self.graph.arc[way[-1]]
        return way


def generate_recordings(count: int, seed: int, split: str) -> list[Recording]:
    """`count` recordings of fresh traffic on the maps of a bundled split, the same for the same seed.

    Each has 11 frames of history (the last is the start frame) and 100 to come, an ego that drives more than 20 m, and
    no overlapping boxes. Raises InputError for a count below 1 or an unknown split.
    """
    if count < 1:
        raise InputError(f"data.count={count}: expected at least 1 scene to generate")
    maps = load_maps(split)
    grounds: dict[int, Ground] = {}
    made = []
    for index in range(count):
        for attempt in range(ATTEMPTS):
            rng = np.random.default_rng([seed, index, attempt])
            pick = int(rng.integers(len(maps)))
            if pick not in grounds:
                grounds[pick] = Ground(maps[pick], LaneGraph(maps[pick].lanes))
            recording = generate(grounds[pick], f"procedural_{seed}_{index:05d}", rng)
            if recording is not None:
                made.append(recording)
                break
        else:
            raise InputError(f"procedural scene {index}: no sound traffic in {ATTEMPTS} draws; use another data.seed")
    return made


def generate(ground: Ground, scene_id: str, rng: np.random.Generator) -> Recording | None:
    """One recording of fresh traffic, or None where this draw gives none."""
    fleet, ways = draw_fleet(ground, rng)
    if fleet is None:
        return None
    place = ground.place
    span = next(iter(place.lights.values())).shape[0] if place.lights else 0
    total = WARM_UP + FRAMES
    first = int(rng.integers(span - total + 1)) if span else 0
    lights = {lane: state[first : first + total] for lane, state in place.lights.items()}
    fleet.lights = stop_lines(ground, ways, fleet, lights)
    for _ in range(REPAIRS):
        progress = roll(fleet, total)[WARM_UP:]
        states, valid = poses(fleet, progress)
        pairs = overlapping_pairs(states, valid, fleet.size)
        harsh = np.flatnonzero(np.abs(lateral_acceleration(states, valid)).max(0) > LATERAL)
        if not len(pairs) and not len(harsh):
            break
        bad = np.unique(np.concatenate([pairs.max(1, initial=-1), harsh]))
        fleet = fleet.subset(np.setdiff1d(np.arange(len(fleet.size)), bad))
        if len(fleet.size) < 4:
            return None
    else:
        return None
    ego = choose_ego(fleet, progress, states, valid, rng)
    if ego is None:
        return None
    states, valid, size = add_parked(place, states, valid, fleet.size, ego, rng)
    recorded = {lane: state[WARM_UP:] for lane, state in lights.items()}
    return Recording(
        scene_id,
        place.name,
        "procedural",
        states,
        valid,
        size,
        np.full(len(size), VEHICLE),
        ego,
        place.lanes,
        place.drivable,
        recorded,
        CURRENT,
    ).validate()


def draw_fleet(ground: Ground, rng: np.random.Generator) -> tuple[Fleet | None, list[list[str]]]:
    """Vehicles on random lanes near a random focus, with safe gaps, and the lanes of their routes."""
    graph = ground.graph
    inside = np.flatnonzero([graph.ids[lane].startswith(":") for lane in graph.lane_of])  # points within junctions
    pool = inside if len(inside) and rng.random() < JUNCTIONS else np.arange(len(graph.points))
    focus = graph.points[pool[rng.integers(len(pool))]]
    near = np.flatnonzero(np.linalg.norm(graph.points - focus, axis=1) < RADIUS)
    wanted = int(rng.integers(8, MOST + 1))
    drawn: list[tuple[str, float]] = []
    pose, body = np.zeros((0, 3)), np.zeros((0, 2))
    for point in rng.permutation(near)[: 4 * wanted]:
        lane = graph.ids[graph.lane_of[point]]
        here = np.array([[*graph.points[point], graph.heading[point]]])
        size = np.array([[rng.uniform(4.0, 5.6), rng.uniform(1.72, 2.05)]])
        room = np.array([rng.uniform(4.0, 16.0), 0.6])
        if lane.startswith(":") or overlap(here, size + 2 * room, pose, body).any():
            continue
        arc = float(point - graph.first_point[graph.lane_of[point]]) * graph.spacing(graph.lane_of[point])
        drawn.append((lane, arc))
        pose, body = np.concatenate([pose, here]), np.concatenate([body, size])
        if len(drawn) == wanted:
            break
    if len(drawn) < 4:
        return None, []
    ways = [ground.route(lane, rng) for lane, _ in drawn]
    return make_fleet(ground, ways, np.array([arc for _, arc in drawn]), body, rng), ways


def make_fleet(ground: Ground, ways: list[list[str]], start: np.ndarray, size: np.ndarray, rng) -> Fleet:
    """Paths, speed bounds and drivers of the vehicles that follow `ways` from arc length `start` of the first lane."""
    count = len(ways)
    steps = int(1.1 * ROUTE / STEP)
    front = np.zeros((count, steps, 2))
    limit, length = np.full((count, steps), 8.0), np.zeros(count)
    for k, way in enumerate(ways):
        line = np.concatenate([ground.graph.line[name] for name in way])
        line = line[np.concatenate([[True], np.linalg.norm(np.diff(line, axis=0), axis=1) > 0.05])]
        arc = arc_length(line)
        at = np.arange(steps) * STEP
        path = np.stack([np.interp(at, arc, line[:, axis]) for axis in (0, 1)], -1)
        unit = (line[-1] - line[-2]) / np.linalg.norm(line[-1] - line[-2])
        path[at > arc[-1]] = line[-1] + (at[at > arc[-1]] - arc[-1])[:, None] * unit
        aside = rng.normal(0, 0.12) + 0.13 * np.sin(at / rng.uniform(9, 16) + rng.uniform(0, 2 * np.pi))
        front[k] = whittaker(offset(path, np.clip(aside, -0.35, 0.35)), PATH_PENALTY)
        begins = np.cumsum([0.0, *[ground.graph.arc[name] for name in way]])
        speeds = [ground.place.lanes[name].speed_limit or 13.9 for name in way]
        limit[k] = np.array(speeds)[np.clip(np.searchsorted(begins, at, "right") - 1, 0, len(way) - 1)]
        length[k] = min(begins[-1], (steps - 1) * STEP)
    centre, heading = tractrix(front, WHEELBASE * size[:, 0])
    bend = np.abs(np.gradient(heading, STEP, axis=1))
    factor = np.clip(rng.normal(1.0, 0.1, count), 0.75, 1.2)[:, None]
    limit = np.minimum(factor * limit, np.sqrt(rng.uniform(1.4, 2.6, (count, 1)) / np.maximum(bend, 1e-4)))
    here = limit[np.arange(count), np.minimum((start / STEP).astype(int), steps - 1)]
    return Fleet(
        front,
        centre,
        heading,
        limit,
        length,
        start,
        size,
        accel=rng.uniform(1.2, 2.2, count),
        brake=rng.uniform(1.6, 2.6, count),
        headway=np.clip(rng.lognormal(np.log(1.3), 0.3, count), 0.8, 2.3),
        gap=rng.uniform(1.8, 3.5, count),
        speed=rng.uniform(0.1, 1.0, count) * here,
    )


def stop_lines(ground: Ground, ways, fleet: Fleet, lights) -> list[tuple[int, float, np.ndarray]]:
    """(vehicle, arc length of the stop line, [T] whether it is red or yellow) of all lights on the routes; lights: lane
    id -> [T] states."""
    found = []
    for k, way in enumerate(ways):
        begins = np.cumsum([0.0, *[ground.graph.arc[name] for name in way]])
        found += [
            (k, float(begins[j]), np.isin(lights[name], (LIGHT_RED, LIGHT_YELLOW)))
            for j, name in enumerate(way)
            if name in lights and begins[j] > fleet.start[k]
        ]
    return found


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
    heading = (heading + np.pi) % (2 * np.pi) - np.pi
    return np.where(valid[..., None], np.concatenate([xy, heading[..., None], speed[..., None]], -1), 0.0), valid


def choose_ego(fleet: Fleet, progress, states, valid, rng) -> int | None:
    """The vehicle with the most to do among those that stay on the map and drive; None where there is none."""
    way = progress[CURRENT + 80] - progress[CURRENT]
    good = valid.all(0) & (way > MOVED) & (progress[-1] < fleet.length - BORDER)
    if not good.any():
        return None
    score = interaction_score(states, valid) + rng.gumbel(size=len(way))
    return int(np.where(good, score, -np.inf).argmax())


def add_parked(place: SceneMap, states, valid, size, ego: int, rng) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The traffic and some of the map's parked cars, where nobody touches them."""
    apart = np.linalg.norm(place.parked[:, :2] - states[CURRENT, ego, :2], axis=-1)
    chosen = np.argsort(apart, kind="stable")[: int(rng.integers(0, MOST_PARKED + 1))]
    pose, body = place.parked[chosen], place.parked_size[chosen]
    hit = (overlap(states[:, :, None, :3], size[:, None] + 0.2, pose, body) & valid[..., None]).any((0, 1))
    pose, body = pose[~hit], body[~hit]
    still = np.tile(np.concatenate([pose, np.zeros((len(pose), 1))], -1), (len(states), 1, 1))
    return (
        np.concatenate([states, still], 1),
        np.concatenate([valid, np.ones(still.shape[:2], bool)], 1),
        np.concatenate([size, body]),
    )
