"""From a Recording to a Scene: who takes part, from which start state, on which routes, on which map."""

from dataclasses import dataclass

import numpy as np
import torch
from tensordict import TensorDict

from e2rl.errors import InputError
from e2rl.scene.drivable import drivable_field
from e2rl.scene.interaction import overlap
from e2rl.scene.lane_graph import LaneGraph, Route, believed_width
from e2rl.scene.log_route import route_from_log
from e2rl.scene.paths import wrap
from e2rl.scene.recording import VEHICLE, Recording
from e2rl.scene.route import SPACING, project
from e2rl.scene.smoothing import PAST, causal_past, causal_state, drop_jumps, smooth

STANDING = 0.5  # m/s
FIT = 2.0  # m: mean distance of a recorded future to a candidate that still counts as the way driven
PASSED = 1.0  # m behind the vehicle's centre beyond which a stop line no longer counts


@dataclass(frozen=True)
class BuildSettings:
    """Sizes of a scene: simulated steps, vehicles (with the ego), other agents, route candidates and their vertices,
    cells of the drivable field."""

    steps: int = 80
    vehicles: int = 32
    others: int = 16
    routes: int = 6
    vertices: int = 150
    field_cells: int = 320


def build_scene(recording: Recording, settings: BuildSettings) -> TensorDict:
    """The Scene of a recording from its start frame (schema: e2rl/scene/scene.py).

    Raises InputError where the recording makes none (no ego, no lanes, NaN states, the ego overlapped at the start).
    """
    recording.validate()
    valid = drop_jumps(recording.states, recording.valid)
    valid[:, recording.ego] = recording.valid[:, recording.ego]  # whoever drops the ego drops the scene
    states = smooth(recording.states, valid)
    frame = recording.current
    start, accel, yaw_rate = causal_state(recording.states, valid, frame)
    start = np.where(valid[frame, :, None], start, 0.0)
    agents = _participants(recording, states, valid, settings)
    origin = np.round(start[recording.ego, :2])
    graph = LaneGraph(recording.lanes)
    if not graph.ids:
        raise InputError(f"scene {recording.scene_id!r}: no lane is at least 0.5 m long; leave the scene out")
    rows = np.flatnonzero(agents >= 0)
    chosen = agents[rows]
    count = settings.vehicles + settings.others
    scene = {
        "start": np.zeros((count, 4)),
        "start_accel": np.zeros(count),
        "start_yaw_rate": np.zeros(count),
        "valid": np.zeros(count, bool),
        "size": np.ones((count, 2)),
        "agent_type": np.zeros(count, np.int64),
        "parked": np.zeros(count, bool),
        "logged": np.zeros((settings.steps + 1, count, 4)),
        "logged_valid": np.zeros((settings.steps + 1, count), bool),
    }
    present = valid[frame, chosen]
    scene["start"][rows] = (start[chosen] - [*origin, 0, 0]) * present[:, None]
    scene["start_accel"][rows], scene["start_yaw_rate"][rows] = accel[chosen] * present, yaw_rate[chosen] * present
    scene["valid"][rows], scene["size"][rows] = present, recording.size[chosen]
    scene["agent_type"][rows] = recording.agent_type[chosen]
    last = min(settings.steps + 1, len(valid) - frame)
    known = valid[frame : frame + last, chosen]
    scene["logged"][:last, rows] = np.where(known[..., None], states[frame : frame + last, chosen] - [*origin, 0, 0], 0)
    scene["logged_valid"][:last, rows] = known
    scene["past"] = np.zeros((settings.vehicles, PAST, 3))
    cars = rows[rows < settings.vehicles]
    scene["past"][cars] = causal_past(recording.states, valid, frame, start[:, 3])[agents[cars]]
    scene |= _routes(scene, graph, recording, origin, settings)
    scene |= _lights(recording, frame, origin, settings.steps)
    scene |= _map(recording, graph, scene, origin, settings)
    return TensorDict({key: _tensor(value) for key, value in scene.items()}, batch_size=[])


def _tensor(value: np.ndarray) -> torch.Tensor:
    value = torch.from_numpy(np.ascontiguousarray(value))
    return value.float() if value.dtype == torch.float64 else value


def _participants(recording: Recording, states, valid, settings: BuildSettings) -> np.ndarray:
    """Track of each agent row, -1 for padding: the ego, the vehicles nearest to it at the start frame, then the others
    that come nearest to it."""
    frame, ego = recording.current, recording.ego
    vehicle = recording.agent_type == VEHICLE
    apart = np.linalg.norm(states[:, :, :2] - states[:, [ego], :2], axis=-1)
    now = np.where(valid[frame] & vehicle, apart[frame], np.inf)
    now[ego] = -1.0
    cars = np.argsort(now, kind="stable")[: settings.vehicles]
    span = slice(frame, frame + settings.steps + 1)
    nearest = np.where(valid[span] & valid[span, [ego]], apart[span], np.inf).min(0, initial=np.inf)
    nearest[vehicle] = nearest[ego] = np.inf
    rest = np.argsort(nearest, kind="stable")[: settings.others]
    agents = np.full(settings.vehicles + settings.others, -1)
    cars, rest = cars[np.isfinite(now[cars])], rest[np.isfinite(nearest[rest])]
    agents[: len(cars)] = cars
    agents[settings.vehicles : settings.vehicles + len(rest)] = rest
    return agents


def _routes(scene: dict, graph: LaneGraph, recording: Recording, origin, settings: BuildSettings) -> dict:
    """Route candidates of every vehicle, the one driven, the lights on them, and who is parked."""
    shape = (settings.vehicles, settings.routes)
    out = {
        "route_points": np.zeros((*shape, settings.vertices, 2)),
        "route_length": np.zeros(shape),
        "route_open": np.zeros(shape, bool),
        "route_valid": np.zeros(shape, bool),
        "route_limit": np.zeros((*shape, settings.vertices), np.float32),
        "route_light": np.full((*shape, 2), -1),
        "route_light_s": np.zeros((*shape, 2)),
    }
    lights = {name: index for index, name in enumerate(recording.lights)}
    reach = (settings.vertices - 1) * SPACING
    for row in range(settings.vehicles):
        x, y, heading, speed = scene["start"][row]
        ahead = np.arange(settings.vertices)[:, None] * SPACING - 20.0
        out["route_points"][row] = np.array([x, y]) + ahead * np.array([np.cos(heading), np.sin(heading)])
        out["route_length"][row] = reach
        if not scene["valid"][row]:
            continue
        found = graph.candidates(np.array([x, y]) + origin, heading, speed, settings.routes, settings.vertices)
        for index, route in enumerate(found):
            _write_route(out, (row, index), route, origin, lights)
        scene["parked"][row] = speed < STANDING and not _on_lane(graph, found, scene["start"][row], origin)
    out["route_log"] = _driven(scene, out, settings)
    if out["route_log"][0] < 0:
        _add_mission(out, scene, graph, origin, lights)
    return out


def _write_route(out: dict, at: tuple[int, int], route: Route, origin, lights: dict[str, int]) -> None:
    out["route_points"][at], out["route_length"][at] = route.points - origin, route.length
    out["route_open"][at], out["route_valid"][at], out["route_limit"][at] = route.open, True, route.limit
    ahead = [(lights[name], s) for name, s in route.lanes if name in lights and s > route.here - PASSED][:2]
    out["route_light"][at], out["route_light_s"][at] = -1, 0.0
    for k, (index, s) in enumerate(ahead):
        out["route_light"][at][k], out["route_light_s"][at][k] = index, s


def _on_lane(graph: LaneGraph, found: list[Route], state, origin) -> bool:
    """Whether a vehicle stands within the lane of one of its candidates."""
    if not found:
        return False
    point = torch.from_numpy(state[None, :2] + origin)
    for route in found:
        s, d, _ = project(point, torch.from_numpy(route.points), torch.full((1,), 20.0))
        lane = [name for name, start in route.lanes if start <= s.item() + 1e-6][-1:] or [route.lanes[0][0]]
        if abs(d.item()) < believed_width(graph.lanes[lane[0]].width) / 2 + 0.3:
            return True
    return False


def _driven(scene: dict, routes: dict, settings: BuildSettings) -> np.ndarray:
    """The candidate nearest to each vehicle's recorded future, -1 where none is near."""
    rows = slice(0, settings.vehicles)
    track = torch.from_numpy(scene["logged"][:, rows, :2].swapaxes(0, 1).copy())
    known = torch.from_numpy(scene["logged_valid"][:, rows].T.copy())
    points = torch.from_numpy(routes["route_points"])
    s, d, heading = project(track[:, None], points)
    turned = wrap(heading - torch.from_numpy(scene["logged"][:, rows, 2].T.copy())[:, None])
    over = (s - torch.from_numpy(routes["route_length"])[..., None]).clamp(min=0) * torch.from_numpy(
        ~routes["route_open"]
    )[..., None]
    cost = d.abs() + 2.0 * turned.abs() + over
    weight = known[:, None].double()
    mean = (cost * weight).sum(-1) / weight.sum(-1).clamp(min=1)
    mean[~torch.from_numpy(routes["route_valid"])] = torch.inf
    driven = torch.where((mean.min(1).values < FIT) & (weight.sum(-1) > 0).squeeze(1), mean.argmin(1), -1).numpy()
    return driven


def _add_mission(out: dict, scene: dict, graph: LaneGraph, origin, lights: dict[str, int]) -> None:
    """The ego's recorded way becomes its last candidate and its mission, where no lane route fits it."""
    track = scene["logged"][scene["logged_valid"][:, 0], 0] + [*origin, 0.0, 0.0]
    slot = min(int(out["route_valid"][0].sum()), out["route_valid"].shape[1] - 1)
    _write_route(out, (0, slot), route_from_log(graph, track, out["route_points"].shape[2]), origin, lights)
    out["route_log"][0] = slot


def _lights(recording: Recording, frame: int, origin, steps: int) -> dict:
    """Light states over the simulated steps (the last known one goes on) and the points where their lanes begin."""
    if not recording.lights:
        return {"light_state": np.zeros((steps + 1, 0), np.int64), "light_points": np.zeros((0, 2))}
    frames = np.minimum(frame + np.arange(steps + 1), len(next(iter(recording.lights.values()))) - 1)
    points = [recording.lanes[name].points[0] for name in recording.lights]
    return {
        "light_state": np.stack([state[frames] for state in recording.lights.values()], 1).astype(np.int64),
        "light_points": np.stack(points) - origin,
    }


def _map(recording: Recording, graph: LaneGraph, scene: dict, origin, settings: BuildSettings) -> dict:
    """Lane centrelines at 1 m with widths and neighbours, polygons, and the drivable field."""
    number = {name: index for index, name in enumerate(graph.ids)}
    lines = [graph.line[name] - origin for name in graph.ids]
    widths = np.array([believed_width(graph.lanes[name].width) for name in graph.ids])
    exits = np.full((len(lines), 6), -1)
    for index, name in enumerate(graph.ids):
        nexts = [number[other] for other in graph.graph.successors(name)][:6]
        exits[index, : len(nexts)] = nexts
    neighbour = {
        side: np.array(
            [next((number[n] for n in getattr(graph.lanes[name], side) if n in number), -1) for name in graph.ids]
        )
        for side in ("left", "right")
    }
    rings = [ring - origin for ring in recording.drivable if len(ring) >= 3]
    ego = scene["logged"][scene["logged_valid"][:, 0], 0, :2]
    field, field_origin = drivable_field(lines, widths, rings, (ego.min(0) + ego.max(0)) / 2, settings.field_cells)
    points = lambda parts: np.concatenate(parts) if parts else np.zeros((0, 2))  # noqa: E731
    index = lambda parts: np.repeat(np.arange(len(parts)), [len(part) for part in parts])  # noqa: E731
    return {
        "lane_points": points(lines),
        "lane_index": index(lines),
        "lane_width": widths,
        "lane_exits": exits,
        "lane_left": neighbour["left"],
        "lane_right": neighbour["right"],
        "drivable_points": points(rings),
        "drivable_index": index(rings),
        "field": field,
        "field_origin": field_origin,
    }


def ego_overlaps(scene: TensorDict) -> bool:
    """Whether the ego's box overlaps another vehicle's at the start frame."""
    others = scene["valid"] & (scene["agent_type"] == VEHICLE)
    others[0] = False
    pose, size = scene["start"].double().numpy(), scene["size"].double().numpy()
    return bool((overlap(pose[:1], size[:1], pose, size) & others.numpy()).any())
