"""Route choice, a distribution over each vehicle's route candidates, and scenes whose
vehicles are assigned one."""

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from e2rl.prior.lane_relative import LaneState, locate
from e2rl.run.fused import fused
from e2rl.scenes.boxes import angle_of
from e2rl.scenes.recording import LIGHT_GREEN, LIGHT_RED
from e2rl.scenes.route import BEHIND, SPACING, interpolate, project
from e2rl.sim.dynamics import wrap
from e2rl.sim.mission import light_state_at

CONFLICT_STRIDE = 2  # vertices: conflicts are looked for every 4 m
CONFLICT_RANGE = 80  # vertices from the route's start on
CONFLICT_GAP = 2.5  # m: routes nearer than this are in conflict
FEATURES = 16
TURN_AT = (10.0, 20.0, 35.0, 55.0, 80.0)  # m ahead
# scene["route_..."] of the assigned candidate.
ROUTE_FIELDS = ("points", "length", "open", "limit", "light", "light_s")


@dataclass
class RoutedScene:
    """Tensors of B scenes that stay the same while these run. It holds no map, so that
    it is cheap to copy.

    Metadata `vehicle_axes`: axes of length V, None for one of all agents; 1 where
    nothing is said.

    size [B, N, 2]; light_state [B, T+1, L]; past [B, V, 10, 3]: see the scene. Of the
    assigned route candidates: route [B, V], their index; points [B, V, P, 2]; length
    [B, V]; open [B, V]: the route ends at the map's border; limit [B, V, P]; light,
    light_s [B, V, 2]. conflict [B, V, V] bool: the routes of i and j meet; conflict_s
    [B, V, V]: arc length on i's route where it first does, or 0; crossing [B, V, V]:
    angle between them there [rad], or 0. modelled [B, V]: the prior moves the vehicle or
    conditions on it; parked [B, V]; has_lane [B, V]: else it is represented in free
    space.
    """

    size: Tensor = field(metadata={"vehicle_axes": None})
    light_state: Tensor = field(metadata={"vehicle_axes": 0})
    past: Tensor
    route: Tensor
    points: Tensor
    length: Tensor
    open: Tensor
    limit: Tensor
    light: Tensor
    light_s: Tensor
    conflict: Tensor = field(metadata={"vehicle_axes": 2})
    conflict_s: Tensor = field(metadata={"vehicle_axes": 2})
    crossing: Tensor = field(metadata={"vehicle_axes": 2})
    modelled: Tensor
    parked: Tensor
    has_lane: Tensor


# Shapes of a RoutedScene's tensors, see `fused`; X agents in all.
ROUTED = (
    *("B X 2", "B T L:int64", "B V 10 3", "B V:int64"),
    *("B V P 2!", "B V", "B V:bool", "B V P", "B V 2:int64", "B V 2"),
    *("B V V:bool", "B V V", "B V V", "B V:bool", "B V:bool", "B V:bool"),
)


def take_route(values: Tensor, route: Tensor) -> Tensor:
    """values [B, V, R, ...] at route [B, V] -> [B, V, ...]."""
    index = route.reshape(*route.shape, *[1] * (values.ndim - 2)).expand(
        *route.shape,
        1,
        *values.shape[3:],
    )
    return values.gather(2, index).squeeze(2)


def route_scene(scene: TensorDictBase, route: Tensor) -> RoutedScene:
    """The RoutedScene of scenes [B] whose vehicles follow candidates route [B, V]."""
    vehicles = route.shape[1]
    assigned = {
        name: take_route(scene[f"route_{name}"], route) for name in ROUTE_FIELDS
    }
    valid = scene["valid"][:, :vehicles]
    parked = scene["parked"][:, :vehicles]
    has_lane = take_route(scene["route_valid"], route)
    modelled = valid & ~parked
    conflict = torch.zeros_like(modelled[..., None].expand(-1, -1, vehicles))
    conflict_s = torch.zeros_like(conflict, dtype=assigned["points"].dtype)
    crossing = torch.zeros_like(conflict_s)
    pairs = (conflict, conflict_s, crossing)
    for b, follows in enumerate(modelled & has_lane):
        rows = follows.nonzero()[:, 0]
        if len(rows) > 1:
            points = assigned["points"][b, rows]
            meetings, _ = _conflicts(
                points, torch.arange(len(rows), device=rows.device)
            )
            for value, of_rows in zip(pairs, meetings, strict=True):
                value[b, rows[:, None], rows] = of_rows
    return RoutedScene(
        size=scene["size"],
        light_state=scene["light_state"],
        past=scene["past"][:, :vehicles],
        route=route,
        **assigned,
        conflict=conflict,
        conflict_s=conflict_s,
        crossing=crossing,
        modelled=modelled,
        parked=parked,
        has_lane=has_lane,
    )


def start_state(scene: TensorDictBase, routed: RoutedScene) -> LaneState:
    """The lane states [B, V] of the vehicles at the start of scenes [B]."""
    start, accel, yaw_rate = (
        scene[key][:, : routed.route.shape[1]]
        for key in ("start", "start_accel", "start_yaw_rate")
    )
    return locate(
        start,
        accel,
        yaw_rate=yaw_rate,
        points=routed.points,
        hint=torch.full_like(routed.length, BEHIND),
    )


def on_map(routed: RoutedScene, s: Tensor) -> Tensor:
    """[B, V, H] bool: vehicles at arc lengths s [B, V, H] m have not come to the end of
    an open route yet."""
    ended = routed.open & routed.has_lane
    gone = ended[..., None] & (s >= routed.length[..., None])
    return ~(gone.cumsum(-1) > 0)


def reroute(
    routed: RoutedScene,
    scene: TensorDictBase,
    *,
    route: Tensor,
    moved: Tensor,
    off_lane: Tensor,
    off_lane_path: Tensor,
) -> RoutedScene:
    """`routed` with some vehicles on new lines.

    Args:
        routed: the scenes with their routes.
        scene: the same, with all candidates.
        route: [B, V], new candidates.
        moved: [B, V] bool, whose line changes.
        off_lane: [B, V] bool, who leaves the lanes.
        off_lane_path: [B, V, P, 2] m, along which; such a path has no lights; its limit
            is the highest of the candidate's.
    """
    off_lane = off_lane & moved
    lane = {
        name: take_route(scene[f"route_{name}"], route)
        for name in (*ROUTE_FIELDS, "valid")
    }
    path: dict[str, Any] = {
        "points": off_lane_path,
        "length": SPACING * (off_lane_path.shape[2] - 1),
        "open": False,
        "limit": lane["limit"].amax(-1, keepdim=True),
        "light": -1,
        "light_s": 0.0,
    }

    def changed(old: Tensor, on_lane: Tensor, on_path: Tensor | float) -> Tensor:
        shape = (*moved.shape, *[1] * (old.dim() - 2))
        on_path = torch.as_tensor(
            on_path,
            dtype=old.dtype,
            device=old.device,
        )
        new = torch.where(off_lane.view(shape), on_path, on_lane)
        return torch.where(moved.view(shape), new, old)

    lines = {
        name: changed(getattr(routed, name), lane[name], path[name])
        for name in ROUTE_FIELDS
    }
    pairs = [routed.conflict, routed.conflict_s, routed.crossing]
    meets, conflict_s, crossing = pairs = [value.clone() for value in pairs]
    for b in moved.any(1).nonzero()[:, 0].tolist():
        rows = moved[b].nonzero()[:, 0]
        of_rows, of_others = _conflicts(lines["points"][b], rows)
        for value, forth, back in zip(pairs, of_rows, of_others, strict=True):
            value[b][:, rows] = back.T
            value[b][rows] = forth
    both = routed.modelled & lane["valid"]
    conflict = meets & both[:, :, None] & both[:, None]
    return replace(
        routed,
        route=torch.where(moved, route, routed.route),
        has_lane=changed(routed.has_lane, lane["valid"], True),
        conflict=conflict,
        conflict_s=torch.where(conflict, conflict_s, 0.0),
        crossing=torch.where(conflict, crossing, 0.0),
        **lines,
    )


def _conflicts(
    points: Tensor, rows: Tensor
) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """Where the routes of vehicles rows [C] first meet every route of points [V, P, 2].

    Returns conflict, conflict_s and crossing (see RoutedScene) [C, V] twice: of each of
    rows with each route, and of each route with each of rows. One scene at a time, so
    that its pairs stay in the cache.
    """
    line = points[:, :CONFLICT_RANGE:CONFLICT_STRIDE]
    vehicles, count, _ = line.shape
    flat = line.reshape(-1, 2)
    flat = flat - flat.mean(0)
    apart = torch.cdist(flat.view(vehicles, count, 2)[rows].flatten(0, 1), flat)
    meets, first, other = first_conflicts(apart.view(len(rows), count, vehicles, count))
    conflict = meets & (rows[:, None] != torch.arange(vehicles, device=rows.device))
    tangent = torch.gradient(line, dim=1)[0]
    angle = angle_of(tangent)
    crossing = wrap(angle.gather(1, other.T).T - angle[rows].gather(1, first))
    crossing = torch.where(conflict, crossing, 0.0)
    spacing = torch.where(conflict, SPACING * CONFLICT_STRIDE, 0.0)
    return (conflict, first * spacing, crossing), (
        conflict,
        other * spacing,
        wrap(-crossing),
    )


@fused("C K V K")
def first_conflicts(apart: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Whether lines [C, V] are in conflict, of their distances [C, K, V, K], and the
    first vertex of each that is."""
    count = apart.shape[1]
    if torch.compiler.is_compiling():  # without truth values, which are slow
        left = torch.arange(
            count,
            0,
            -1,
            dtype=apart.dtype,
            device=apart.device,
        )
        near = apart < CONFLICT_GAP
        of_row = torch.where(near, left[:, None, None], 0.0).amax((1, 3))
        of_other = torch.where(near, left, 0.0).amax((1, 3))
        first = torch.where(of_row > 0, count - of_row, 0.0).long()
        return of_row > 0, first, torch.where(of_row > 0, count - of_other, 0.0).long()
    near = apart < CONFLICT_GAP
    # [C, K, V]: this vertex of a row's route meets the other route somewhere.
    meets = near.any(3)
    # The first of several points, where they share a stretch.
    return meets.any(1), meets.float().argmax(1), near.any(1).float().argmax(2)


class Moment(NamedTuple):
    """The first V vehicles at a moment: states [B, V, 4], yaw_rate [B, V] rad/s, step
    [B]."""

    states: Tensor
    yaw_rate: Tensor
    step: Tensor


def start_of(scene: TensorDictBase) -> Moment:
    """The vehicles at the start of scenes [B]."""
    vehicles = scene["route_log"].shape[1]
    step = torch.zeros(
        len(scene["start"]),
        dtype=torch.long,
        device=scene["start"].device,
    )
    return Moment(
        scene["start"][:, :vehicles],
        scene["start_yaw_rate"][:, :vehicles],
        step=step,
    )


def candidate_features(scene: TensorDictBase, moment: Moment) -> Tensor:
    """[B, V, R, FEATURES] of each route candidate as seen from the vehicles."""
    vehicles = moment.states.shape[1]
    routes = {
        name: scene[f"route_{name}"][:, :vehicles]
        for name in ("points", "length", "limit", "light")
    }
    points = routes["points"]
    place = project(moment.states[:, :, None, None, :2], points)
    s, d, heading = (value[..., 0] for value in place)
    v = moment.states[..., 3].clamp(min=0)[..., None].expand_as(s)
    ahead = torch.tensor((0.0, *TURN_AT), device=s.device)
    _, angle, _ = interpolate(points, s[..., None] + ahead)
    turn = wrap(angle[..., 1:] - angle[..., :1])
    bends = (
        turn.abs()
        .diff(
            dim=-1,
            prepend=torch.zeros_like(turn[..., :1]),
        )
        .abs()
    )
    tight = (bends / ahead.diff()).amax(-1)
    vertex = (s / SPACING).long().clamp(0, points.shape[3] - 1)
    limit = routes["limit"].gather(-1, vertex[..., None])[..., 0]
    light = routes["light"][..., 0]
    colour = light_state_at(scene["light_state"], light, step=moment.step)
    bend = moment.yaw_rate[..., None] / v.clamp(min=2.0) - turn[..., 0] / 10.0
    features = [
        d.abs(),
        d,
        wrap(moment.states[..., 2][..., None] - heading) * 3,
        *turn.unbind(-1),
        (routes["length"] - s).clamp(0, 100) / 50,
        v / 10,
        (v**2 * tight / 4 - 1).clamp(0, 4),
        bend * 10,
        ((light >= 0) & (colour == LIGHT_GREEN)).float(),
        ((light >= 0) & (colour == LIGHT_RED)).float(),
        torch.arange(s.shape[-1], device=s.device).expand_as(s) / 3,
        (v - limit) / 10,
    ]
    return torch.stack(features, -1)


class RouteChoice(nn.Module):
    """Logits over a vehicle's route candidates from their features."""

    def __init__(self, width: int = 64):
        super().__init__()
        self.net = nn.Sequential(
            nn.Linear(FEATURES, width),
            nn.GELU(),
            nn.Linear(width, width),
            nn.GELU(),
            nn.Linear(width, 1),
        )

    def forward(self, scene: TensorDictBase, moment: Moment | None = None) -> Tensor:
        """Logits [B, V, R] of the first V vehicles at a moment (None: of all at the
        start); -inf where there is no candidate, except for the first that is not
        recorded, straight ahead, of a vehicle without any."""
        moment = start_of(scene) if moment is None else moment
        vehicles = moment.states.shape[1]
        valid = scene["route_valid"][:, :vehicles]
        plain = scene["route_recorded"][:, :vehicles].int().argmin(-1, keepdim=True)
        first = torch.zeros_like(valid).scatter(-1, plain, True)
        possible = valid | (first & ~valid.any(-1, keepdim=True))
        logits = self.net(candidate_features(scene, moment))[..., 0]
        return logits.masked_fill(~possible, -torch.inf)


def sample_route(logits: Tensor, temperature: float, uniform: Tensor) -> Tensor:
    """A candidate [...] of logits [..., R] for each uniform number [...] in [0, 1), by
    inverting the distribution function; temperature 0: the most likely."""
    if temperature <= 0:
        return logits.argmax(-1)
    total = torch.softmax(logits / temperature, -1).cumsum(-1)
    # Never past the last possible one.
    below = uniform.clamp(max=1 - 1e-6)[..., None] * total[..., -1:]
    return (total <= below).sum(-1)
