"""Training windows of the prior: the features of vehicles at a frame, and the x that
reproduces their next 5 s."""

import torch
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
MAX_ERROR = 0.5  # m: vehicles with a larger representation error are not trained on (wrong or self-crossing route)
STANDING_WEIGHT = 0.25


def derivative(values: Tensor, valid: Tensor) -> Tensor:
    """Central difference over time of values [B, T, V] (one-sided at the ends of a
    recorded piece), per second."""
    ahead = torch.cat(
        [values[:, 1:] - values[:, :-1], torch.zeros_like(values[:, :1])], 1
    )
    known = torch.cat([valid[:, 1:] & valid[:, :-1], torch.zeros_like(valid[:, :1])], 1)
    ahead = torch.where(known, ahead, 0.0)
    behind = torch.roll(ahead, 1, 1)
    count = known.float() + torch.roll(known, 1, 1).float()
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
        unwrapped = torch.cumsum(
            torch.cat([heading[:, :1], wrap(heading.diff(dim=1))], 1), 1
        )
        yaw_rate = derivative(unwrapped, valid).clamp(-1.0, 1.0)
        exact = [
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
        observed = (
            scene["start_accel"][:, :vehicles],
            scene["start_yaw_rate"][:, :vehicles],
        )
        parts += [*exact, _window(scene, routed, 0, *observed, True)]
    windows = TensorDict.cat(parts)
    return windows[windows["weight"].sum(-1) > 0]


def _window(
    scene: TensorDictBase,
    routed: RoutedScene,
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
    tracks, known = _future(scene, offset, vehicles=vehicles)
    x0, error, ahead, d = _targets(routed, state, tracks=tracks, known=known)
    ends = slice(KNOT_STEPS - 1, HORIZON, KNOT_STEPS)
    at_knots = known[..., ends]
    moving = torch.where(known, tracks[..., 3], 0.0).amax(-1).clamp(min=state.v) > 0.5
    here = valid[:, :vehicles]
    fits = (scene["route_log"] >= 0) | ~routed.has_lane
    use = (
        here
        & routed.modelled
        & fits
        & (error < MAX_ERROR)
        & (known.sum(-1) >= KNOT_STEPS)
    )
    columns = {name: getattr(state, name) for name in ("v", "a", "d", "d1", "d2")} | {
        "nodes": node_features(
            routed,
            state,
            leaders_ahead(routed, state.s, agents=agents, present=valid),
            step,
            estimated,
        ),
        "present": here,
        "x0": x0,
        "weight": use * torch.where(moving, 1.0, STANDING_WEIGHT),
        "knot_weight": torch.cat(
            [at_knots, known[..., [24]], known[..., [44]]], -1
        ).float(),
        "on_lane": routed.has_lane,
        "ahead": ahead[..., ends],
        "aside": d[..., ends],
        "known": at_knots,
    }
    distance = (logged[:, :vehicles, :2] - logged[:, :1, :2]).norm(dim=-1)
    distance[:, 0] = -1e6  # the ego comes first
    order = (distance + 1e3 * ~use + 1e4 * ~here).argsort(1)[:, :ROWS]
    pairs = take(
        take(edge_features(routed, state), order).transpose(1, 2), order
    ).transpose(1, 2)
    window = {key: take(value, order) for key, value in columns.items()} | {
        "pairs": pairs,
        "causal": estimated,
    }
    return TensorDict(window, batch_size=[len(logged)])


def _future(scene: TensorDictBase, offset: int, vehicles: int) -> tuple[Tensor, Tensor]:
    """States [B, V, HORIZON, 4] recorded after frame `offset`, and a mask [B, V,
    HORIZON] of the known ones."""
    future = slice(offset + 1, offset + 1 + HORIZON)
    tracks = scene["logged"][:, future, :vehicles].transpose(1, 2)
    known = scene["logged_valid"][:, future, :vehicles].transpose(1, 2)
    short = HORIZON - known.shape[2]
    tracks = torch.nn.functional.pad(tracks, (0, 0, 0, short))
    known = torch.nn.functional.pad(known, (0, short))
    return tracks, known.cumprod(-1).bool()


def _targets(
    routed: RoutedScene, state: LaneState, tracks: Tensor, known: Tensor
) -> tuple[Tensor, ...]:
    """x0 [B, V, SIZE] of tracks [B, V, HORIZON, 4], its error [B, V], recorded distance
    and offset [B, V, HORIZON]."""
    hint = state.s[..., None] + (torch.where(known, tracks[..., 3], 0.0) * DT).cumsum(
        -1
    )
    s, d, _ = project(tracks[..., :2], routed.points, hint=hint)
    x0, error = lane_relative.fit(
        LaneState.from_states(tracks, s, d=d), known.float(), state=state
    )
    ahead = s - state.s[..., None]
    lane = routed.has_lane
    if bool(lane.all()):
        return x0, error, ahead, d
    knots = lane_relative.ACCEL_SCALE * x0[..., :KNOTS]
    lateral = free_space.fit(tracks[..., 2], known.float(), state=state, knots=knots)
    free = torch.cat([x0[..., :KNOTS], lateral], -1)
    motion = free_space.decode(free, state)
    gap = torch.hypot(motion.x - tracks[..., 0], motion.y - tracks[..., 1])
    free_error = (gap * known).sum(-1) / known.sum(-1).clamp(min=1) / 2
    before = torch.cat([state.v[..., None], tracks[..., :-1, 3]], -1)
    driven = (torch.where(known, (tracks[..., 3] + before) / 2, 0.0) * DT).cumsum(-1)
    x0 = torch.where(lane[..., None], x0, free)
    ahead = torch.where(lane[..., None], ahead, driven)
    return x0, torch.where(lane, error, free_error), ahead, d
