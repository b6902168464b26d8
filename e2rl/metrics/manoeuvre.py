"""Manoeuvres: knots of acceleration and lateral shift along a route, executed by the
unicycle within its limits.

`violations` measures by how much the ego's trajectories fail as evasions: clearance to
others, and the road.
"""

import torch
from tensordict import TensorClass, TensorDictBase
from torch import Tensor

from e2rl.planners.path import RoutePath
from e2rl.scenes.boxes import separation
from e2rl.scenes.drivable_area import off_road
from e2rl.scenes.recording import DT
from e2rl.scenes.route import BEHIND, interpolate, project, project_track
from e2rl.sim import dynamics
from e2rl.sim.env import SimSettings
from e2rl.sim.mission import mission_of

KNOT_STEPS = 5  # steps between knots (0.5 s): a shift of 2 m within one of them takes all the grip of the tyres
CREEP = 2.0  # m/s below which a vehicle shifts less than its knots ask: one that stands cannot move sideways


def knot_count(steps: int) -> int:
    """Number of knots for `steps` steps; the last one lies at their end or after it."""
    return -(-steps // KNOT_STEPS) + 1


def accelerations(knots: Tensor, steps: int) -> Tensor:
    """Accelerations [..., T] at the middle of each step, linear between knots [..., K]."""
    at = (
        torch.arange(steps, device=knots.device, dtype=knots.dtype) + 0.5
    ) / KNOT_STEPS
    index = at.long()
    return torch.lerp(knots[..., index], knots[..., index + 1], at - index)


def knots_of(accel: Tensor) -> Tensor:
    """Knots [..., K] that approximate accelerations [..., T]: their means around each
    knot."""
    steps = accel.shape[-1]
    at = torch.arange(knot_count(steps), device=accel.device) * KNOT_STEPS
    near = (
        torch.arange(steps, device=accel.device) + 0.5 - at[:, None]
    ).abs() < KNOT_STEPS
    weight = near.to(accel.dtype)
    return accel @ (weight / weight.sum(-1, keepdim=True)).T


def shifts(knots: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """Lateral shift [m] and its rate [m/s], each [..., T+1] at steps 0..T: a uniform
    cubic B-spline of knots [..., K].

    The first two knots do not count: a shift begins with zero rate and curvature.
    """
    count = knots.shape[-1]
    at = torch.arange(steps + 1, device=knots.device, dtype=knots.dtype) / KNOT_STEPS
    since = at[:, None] - torch.arange(
        count + 2, device=knots.device
    )  # two more: the last knot is held
    gap = since.abs()
    near = gap < 1
    far = gap < 2
    basis = torch.where(near, 2 / 3 - gap**2 + gap**3 / 2, (2 - gap) ** 3 / 6) * far
    slope = (
        torch.where(near, -2 * gap + 1.5 * gap**2, -((2 - gap) ** 2) / 2)
        * far
        * since.sign()
    )
    held = knots[..., -1:].expand(*knots.shape[:-1], 2)
    held = torch.cat([torch.zeros_like(knots[..., :2]), knots[..., 2:], held], -1)
    return held @ basis.T, held @ slope.T / (KNOT_STEPS * DT)


def execute(
    start: Tensor,
    route: Tensor,
    accel: Tensor,
    shift: Tensor,
    steps: int,
    sim: SimSettings,
) -> tuple[Tensor, Tensor]:
    """(actions [..., T, 2], states [..., T, 4] at steps 1..T) of manoeuvres from start
    [..., 4].

    accel [..., K] m/s^2 and shift [..., K] m beside route [..., P, 2] are knots. The
    path leaves the start's pose and returns onto the shifted route (`RoutePath`); its
    headings become yaw rates. The simulator's bounds hold, and braking and turning
    share the tyres' grip; where a bound binds, the vehicle leaves the path.
    """
    bounded = accelerations(accel, steps).clamp(-sim.max_braking, sim.max_acceleration)
    v0 = start[..., 3:4]
    speed = torch.cat([v0, dynamics.bounded_speed(v0, bounded * DT)], -1)
    mean = (speed[..., 1:] + speed[..., :-1]) / 2
    change = speed.diff(dim=-1) / DT
    driven = torch.nn.functional.pad((mean * DT).cumsum(-1), (1, 0))
    path = RoutePath(start, route)
    offset, slope = path.offset(driven)
    lateral, rate = shifts(shift, steps)
    offset = offset + lateral
    curvature = interpolate(route, path.s[..., None] + driven)[2]
    inner = (1 - curvature * offset).clamp(min=0.2)
    slope = slope + inner * rate * speed / speed.clamp(min=CREEP) ** 2
    stretch = torch.hypot(inner, slope)
    along = driven.diff(dim=-1) * 2 / (stretch[..., 1:] + stretch[..., :-1])
    s = path.s[..., None] + torch.nn.functional.pad(along.cumsum(-1), (1, 0))
    heading = interpolate(route, s)[1] + torch.atan2(slope, inner)
    heading = torch.cat([start[..., 2:3], heading[..., 1:]], -1)
    grip = (dynamics.MAX_LATERAL**2 - change**2).clamp(min=0).sqrt() / mean.clamp(
        min=1e-3
    )
    bound = torch.minimum(grip, dynamics.yaw_rate_bound(mean)).clamp(
        max=sim.max_yaw_rate
    )
    yaw_rate = dynamics.wrap(heading.diff(dim=-1)) / DT
    actions = torch.stack(
        [bounded, torch.maximum(torch.minimum(yaw_rate, bound), -bound)], -1
    )
    return actions, dynamics.rollout(start, actions)


def peak_acceleration(start: Tensor, states: Tensor) -> Tensor:
    """Largest length [...] [m/s^2] of the longitudinal and lateral acceleration from
    start [..., 4] along states [..., T, 4]."""
    whole = torch.cat([start[..., None, :], states], -2)
    actions = dynamics.inverse(whole)
    speed = (whole[..., 1:, 3] + whole[..., :-1, 3]) / 2
    return torch.hypot(actions[..., 0], actions[..., 1] * speed).amax(-1)


PAIRS = 8_000_000  # boxes compared at once: bounds the memory
AWAY = 1e6  # m, position of absent agents


class EvasionScene(TensorClass):
    """Scenes [B] in the T steps after a given one, in which the motion of all agents
    but the ego is fixed."""

    start: Tensor  # [B, 4], the ego's
    ego_size: Tensor  # [B, 2]
    inside: Tensor  # [B, T] bool: within the episode
    others: Tensor  # [B, T, N, 4], AWAY where absent
    other_size: Tensor  # [B, N, 2]
    field: Tensor  # [B, G, G], of `scenes.drivable_area.off_road`
    origin: Tensor  # [B, 2]
    routes: Tensor  # [B, R, P, 2], the ego's candidates
    mission: Tensor  # [B, P, 2]
    s: Tensor  # [B] m, arc length of the ego on its mission at the start
    end: Tensor  # [B] m, the one at which the map ends (inf: it does not)

    @staticmethod
    def after(
        moment: Tensor, scene: TensorDictBase, states: Tensor, valid: Tensor
    ) -> "EvasionScene":
        """After step moment [B] of scenes [B] with agents at states [B, T+1, N, 4],
        valid [B, T+1, N], ego first."""
        horizon = states.shape[1] - 1
        row = torch.arange(len(states), device=states.device)
        step = moment[:, None] + torch.arange(1, horizon + 1, device=states.device)
        inside = step <= horizon
        step = step.clamp(max=horizon)
        present = valid[row[:, None], step, 1:] & inside[..., None]
        ever = present.any(1).any(0)  # columns without any agent cost as much as others
        start = states[row, moment, 0]
        mission = mission_of(scene)
        others = states[row[:, None], step, 1:].masked_fill(~present[..., None], AWAY)[
            :, :, ever
        ]
        agents = {
            "ego_size": scene["size"][:, 0],
            "others": others,
            "other_size": scene["size"][:, 1:][:, ever],
        }
        road = {
            "field": scene["field"],
            "origin": scene["field_origin"],
            "routes": scene["route_points"][:, 0],
        }
        s = project_track(
            states[:, :, 0, :2], mission.points, known=valid[:, :, 0], start=BEHIND
        )[0][row, moment]
        road |= {"mission": mission.points, "s": s, "end": mission.end}
        return EvasionScene(
            start=start, inside=inside, **agents, **road, batch_size=[len(states)]
        )


def violations(
    states: Tensor, scene: EvasionScene, clearance: float, road_margin: float
) -> Tensor:
    """Metres [B, C, T] by which egos at states [B, C, T, 4] miss `clearance` to others
    and `road_margin` to the border.

    0 at a step that keeps both, and after the episode. As in DrivingEnv, contact counts
    with everybody at every step, the road from the first time on it, and nothing once
    the map has ended.
    """
    missed = clearance_violation(states, scene, clearance=clearance) + road_violation(
        states, scene, margin=road_margin
    )
    missed = missed * scene.inside[:, None]
    return missed.masked_fill(past_end(states, missed > 0, scene=scene)[..., None], 0.0)


def clearance_violation(
    states: Tensor, scene: EvasionScene, clearance: float
) -> Tensor:
    """Metres [B, C, T] of missing clearance, summed over the agents nearer than it;
    exact box separation."""
    others = scene.others
    size = scene.ego_size
    other_size = scene.other_size
    reach = (size.norm(dim=-1)[:, None] + other_size.norm(dim=-1)) / 2 + clearance
    chunk = max(1, PAIRS // max(1, states.shape[0] * states.shape[2] * others.shape[2]))
    parts = []
    for part in states.split(chunk, 1):
        gap_x = part[..., None, 0] - others[:, None, ..., 0]
        gap_y = part[..., None, 1] - others[:, None, ..., 1]
        near = gap_x.square_().add_(gap_y.square_()) < reach.square()[:, None, None]
        row, trial, step, other = near.nonzero(as_tuple=True)
        apart = separation(
            part[row, trial, step],
            size[row],
            second=others[row, step, other],
            second_size=other_size[row, other],
        )
        index = (row * part.shape[1] + trial) * part.shape[2] + step
        missed = part.new_zeros(part.shape[:-1]).view(-1)
        parts.append(
            missed.index_add(0, index, (clearance - apart).clamp(min=0)).view(
                part.shape[:-1]
            )
        )
    return torch.cat(parts, 1)


def road_violation(states: Tensor, scene: EvasionScene, margin: float) -> Tensor:
    """Metres [B, C, T] beyond a line `margin` m inside the drivable border, from the
    first time within it."""
    first = (
        off_road(scene.start[:, None, :2], scene.field, origin=scene.origin) + margin
    )
    beyond = off_road(states[..., :2], scene.field, origin=scene.origin) + margin
    before = torch.cat(
        [first[..., None].expand_as(beyond[..., :1]), beyond[..., :-1]], -1
    )
    return beyond.clamp(min=0) * (before.cummin(-1).values <= 0)


def past_end(states: Tensor, wrong: Tensor, scene: EvasionScene) -> Tensor:
    """Bool [B, C]: the ego is past the map's end before the first step at which it is
    wrong [B, C, T].

    The step at which it passes the end still counts, so its position a step before the
    first wrong one decides.
    """
    first = wrong.int().argmax(-1)
    last = (first - 1).clamp(min=0)
    at = states.gather(2, last[..., None, None].expand(*last.shape, 1, 4))[:, :, 0, :2]
    speed = torch.cat(
        [scene.start[:, None, None, 3].expand_as(states[:, :, :1, 3]), states[..., 3]],
        -1,
    )
    driven = (
        ((speed[..., 1:] + speed[..., :-1]) / 2 * DT)
        .cumsum(-1)
        .gather(2, last[..., None])[..., 0]
    )
    s = project(at, scene.mission, hint=scene.s[:, None] + driven)[0]
    return (s >= scene.end[:, None]) & (first > 0)
