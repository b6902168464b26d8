"""Training windows of the prior: the features of vehicles at a frame, and the x that
reproduces their next 5 s."""

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from e2rl.prior import free_space, lane_relative
from e2rl.prior.features import edge_features, leaders_ahead, node_features
from e2rl.prior.lane_relative import HORIZON, KNOT_STEPS, KNOTS, LaneState, locate
from e2rl.prior.routes import RoutedScene, route_scene
from e2rl.run.terminal import Bar
from e2rl.scenes.recording import DT
from e2rl.scenes.route import project
from e2rl.sim.dynamics import wrap
from e2rl.traffic.motion import take

OFFSETS = (0, 5, 10, 15)  # frames after a scene's start frame at which a window begins
ROWS = 16  # vehicles of a window: the modelled ones nearest to the ego
MAX_ERROR = 0.5  # m of representation: beyond it the route is wrong or crosses itself
STANDING_WEIGHT = 0.25


def derivative(values: Tensor, valid: Tensor) -> Tensor:
    """Central difference over time of values [B, T, V] (one-sided at the ends of a
    recorded piece), per second."""
    last = torch.zeros_like(valid[:, :1])
    recorded = torch.cat([valid[:, 1:] & valid[:, :-1], last], 1)
    change = torch.cat([values.diff(dim=1), torch.zeros_like(values[:, :1])], 1)
    ahead = torch.where(recorded, change, 0.0)
    behind = torch.roll(ahead, 1, 1)
    count = recorded.float() + torch.roll(recorded, 1, 1).float()
    return (ahead + behind) / count.clamp(min=1) / DT


def make_windows(scenes: TensorDictBase, chunk: int = 32) -> TensorDict:
    """Windows [W] of scenes [S] (see `_window` for the keys), without empty ones."""
    parts = []
    for scene in Bar(scenes.split(chunk), "training windows"):
        vehicles = scene["route_log"].shape[1]
        routed = route_scene(scene, scene["route_log"].clamp(min=0))
        logged = scene["logged"][:, :, :vehicles]
        valid = scene["logged_valid"][:, :, :vehicles]
        accel = derivative(logged[..., 3], valid).clamp(-6.0, 4.0)
        heading = torch.where(valid, logged[..., 2], 0.0)
        turns = torch.cat([heading[:, :1], wrap(heading.diff(dim=1))], 1)
        yaw_rate = derivative(turns.cumsum(1), valid).clamp(-1.0, 1.0)
        parts += [
            _window(
                scene,
                routed,
                offset=offset,
                accel=accel[:, offset],
                yaw_rate=yaw_rate[:, offset],
                causal=False,
            )
            for offset in OFFSETS
        ]
        estimates = _window(
            scene,
            routed,
            offset=0,
            accel=scene["start_accel"][:, :vehicles],
            yaw_rate=scene["start_yaw_rate"][:, :vehicles],
            causal=True,
        )
        parts.append(estimates)
    windows = TensorDict.cat(parts)
    return windows[windows["weight"].sum(-1) > 0]


def _window(
    scene: TensorDictBase,
    routed: RoutedScene,
    *,
    offset: int,
    accel: Tensor,
    yaw_rate: Tensor,
    causal: bool,
) -> TensorDict:
    """Windows [B] of R rows at frame `offset`, where accelerations and yaw rates [B, V]
    are given.

    nodes [R, NODE], pairs [R, R, EDGE], present [R], x0 [R, SIZE]; weight [R] of a
    vehicle in the loss, knot_weight [R, SIZE]: knots inside the recorded future; v, a,
    d, d1, d2 [R]: the start state; ahead, aside [R, KNOTS]: recorded distance and
    offset at the knots, known [R, KNOTS]: recorded there, on_lane [R]: aside counts (in
    free space the lateral knots are no offsets); causal []: start states are a causal
    observer's estimates, otherwise exact.
    """
    vehicles = routed.route.shape[1]
    logged = scene["logged"][:, offset]
    valid = scene["logged_valid"][:, offset] & scene["valid"]
    agents = scene["start"] if causal else logged
    state = locate(agents[:, :vehicles], accel, yaw_rate=yaw_rate, points=routed.points)
    step = torch.full((len(logged),), offset, dtype=torch.long, device=logged.device)
    estimated = torch.full_like(step, causal, dtype=torch.bool)
    tracks, recorded = _future(scene, offset, vehicles=vehicles)
    x0, error, ahead, d = _targets(routed, state, tracks=tracks, recorded=recorded)
    ends = slice(KNOT_STEPS - 1, HORIZON, KNOT_STEPS)
    at_knots = recorded[..., ends]
    lateral_knots = (recorded[..., [24]], recorded[..., [44]])
    speed = torch.where(recorded, tracks[..., 3], 0.0)
    moving = speed.amax(-1).clamp(min=state.v) > 0.5
    present = valid[:, :vehicles]
    on_route = (scene["route_log"] >= 0) | ~routed.has_lane
    long = recorded.sum(-1) >= KNOT_STEPS
    use = present & routed.modelled & on_route & (error < MAX_ERROR) & long
    leaders = leaders_ahead(routed, state.s, agents=agents, present=valid)
    columns = {
        **{name: getattr(state, name) for name in ("v", "a", "d", "d1", "d2")},
        "nodes": node_features(routed, state, leaders, step, estimated),
        "present": present,
        "x0": x0,
        "weight": use * torch.where(moving, 1.0, STANDING_WEIGHT),
        "knot_weight": torch.cat([at_knots, *lateral_knots], -1).float(),
        "on_lane": routed.has_lane,
        "ahead": ahead[..., ends],
        "aside": d[..., ends],
        "known": at_knots,
    }
    distance = (logged[:, :vehicles, :2] - logged[:, :1, :2]).norm(dim=-1)
    distance[:, 0] = -1e6  # the ego comes first
    order = (distance + 1e3 * ~use + 1e4 * ~present).argsort(1)[:, :ROWS]
    pairs = take(edge_features(routed, state), order).transpose(1, 2)
    return TensorDict(
        {
            **{key: take(value, order) for key, value in columns.items()},
            "pairs": take(pairs, order).transpose(1, 2),
            "causal": estimated,
        },
        batch_size=[len(logged)],
    )


def _future(scene: TensorDictBase, offset: int, vehicles: int) -> tuple[Tensor, Tensor]:
    """States [B, V, HORIZON, 4] recorded after frame `offset`, and a mask [B, V,
    HORIZON] of the recorded ones, up to the first gap."""
    future = slice(offset + 1, offset + 1 + HORIZON)
    tracks = scene["logged"][:, future, :vehicles].transpose(1, 2)
    valid = scene["logged_valid"][:, future, :vehicles].transpose(1, 2)
    missing = HORIZON - valid.shape[2]
    recorded = F.pad(valid, (0, missing)).cumprod(-1).bool()
    return F.pad(tracks, (0, 0, 0, missing)), recorded


def _targets(
    routed: RoutedScene,
    state: LaneState,
    tracks: Tensor,
    recorded: Tensor,
) -> tuple[Tensor, ...]:
    """x0 [B, V, SIZE] of tracks [B, V, HORIZON, 4], its error [B, V], recorded distance
    and offset [B, V, HORIZON]."""
    travelled = (torch.where(recorded, tracks[..., 3], 0.0) * DT).cumsum(-1)
    hint = state.s[..., None] + travelled
    s, d, _ = project(tracks[..., :2], routed.points, hint=hint)
    weight = recorded.float()
    motion = LaneState.from_states(tracks, s, d=d)
    x0, error = lane_relative.fit(motion, weight, state=state)
    ahead = s - state.s[..., None]
    lane = routed.has_lane
    if bool(lane.all()):
        return x0, error, ahead, d
    longitudinal = x0[..., :KNOTS]
    knots = lane_relative.ACCEL_SCALE * longitudinal
    lateral = free_space.fit(tracks[..., 2], weight, state=state, knots=knots)
    free = torch.cat([longitudinal, lateral], -1)
    decoded = free_space.decode(free, state)
    gap = torch.hypot(decoded.x - tracks[..., 0], decoded.y - tracks[..., 1])
    free_error = (gap * recorded).sum(-1) / recorded.sum(-1).clamp(min=1) / 2
    before = torch.cat([state.v[..., None], tracks[..., :-1, 3]], -1)
    speed = torch.where(recorded, (tracks[..., 3] + before) / 2, 0.0)
    return (
        torch.where(lane[..., None], x0, free),
        torch.where(lane, error, free_error),
        torch.where(lane[..., None], ahead, (speed * DT).cumsum(-1)),
        d,
    )
