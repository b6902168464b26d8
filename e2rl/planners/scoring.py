"""Costs of a planner's candidates by a forecast of others: contact, distance, drivable
border, progress, comfort."""

from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.planners.candidates import Candidates
from e2rl.run.settings import setting
from e2rl.scenes.drivable_area import off_road
from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import MAX_CURVATURE, constant_velocity, wrap
from e2rl.sim.world import World

LOOK = (0.0, 1.0, 2.0, 3.0)  # s at which the nearest are looked for
SLOW_TURN = 1.0  # m/s below which a turn rate says little of the path's curvature


@dataclass
class Forecast:
    """M agents of each of B scenes: poses [B, M, T, 3], speed [B, M, T], size [B, M,
    2], seen [B, M]: the row holds an agent."""

    poses: Tensor
    speed: Tensor
    size: Tensor
    seen: Tensor


def nearest(world: World, count: int) -> tuple[Tensor, Tensor]:
    """Agents [B, M] that come nearest to the ego within 3 s if all keep their velocity,
    and whether they are there [B, M]; M: count, or fewer where a scene has no more
    rows."""
    times = torch.tensor(LOOK, device=world.states.device)
    xy = constant_velocity(world.states, times)[..., :2]
    gap = (xy - xy[:, :1]).square().sum(-1).amin(-1)
    there = world.valid.clone()
    there[:, 0] = False
    found = gap.masked_fill(~there, torch.inf).topk(
        min(count, gap.shape[1]), largest=False
    )
    return found.indices, found.values < torch.inf


def forecast(
    world: World, agents: Tensor, seen: Tensor, times: Tensor, hold: float, turn: float
) -> Forecast:
    """The Forecast of agents [B, M] at times [T] s, evenly spaced from one spacing on.

    The acceleration is held for `hold` s (never beyond a halt), the path's curvature
    for `turn` s; then the speed and the heading stay.
    """
    row = torch.arange(len(agents), device=agents.device)[:, None]
    state = world.states[row, agents]
    accel = world.accel[row, agents]
    rate = world.turn_rate[row, agents]
    step = times[0]
    nodes = torch.nn.functional.pad(times, (1, 0))
    speed = (state[..., 3:] + accel[..., None] * nodes.clamp(max=hold)).clamp(min=0)
    moved = (speed[..., 1:] + speed[..., :-1]) / 2 * step
    driven = torch.nn.functional.pad(moved.cumsum(-1), (1, 0))
    curvature = (rate / state[..., 3].clamp(min=SLOW_TURN)).clamp(
        -MAX_CURVATURE, MAX_CURVATURE
    )[..., None]
    most = torch.maximum(state[..., 3:], speed) * turn
    heading = state[..., 2:3] + curvature * torch.minimum(driven, most)
    middle = (heading[..., 1:] + heading[..., :-1]) / 2
    x = state[..., 0:1] + (moved * middle.cos()).cumsum(-1)
    y = state[..., 1:2] + (moved * middle.sin()).cumsum(-1)
    return Forecast(
        torch.stack([x, y, heading[..., 1:]], -1),
        speed[..., 1:],
        size=world.scene["size"][row, agents],
        seen=seen,
    )


MOVING = 3.0  # m/s from which on an agent's place becomes uncertain at the full rate
TOUCH = 0.15  # m: a smaller gap counts as a contact; forecasts err, and moments between scored ones are not seen
BESIDE = 0.3  # m of lateral room below which an agent is ahead of the ego or behind it, not beside it
SLOW = 2.0  # m/s below which a contact is less and less the ego's own doing
IMPACT = 10.0  # m/s of relative velocity that double the cost of a contact
FARTHEST = 5.0  # m beyond the border from which on being farther costs no more
ROAD_STRIDE = 2  # scored states between two look-ups of the drivable field
JERK_TIME = (
    0.1  # s: weight of the first change of acceleration against mean accelerations
)


@dataclass(eq=False)
class Weights:
    """What costs how much (conf/ego/sampling.yaml and bits.yaml)."""

    margin: float = setting(low=1e-3)
    margin_growth: float = setting(low=0)
    headway: float = setting(low=0)
    rear: float = setting(low=0)
    fade: float = setting(low=0)
    contact: float = setting(low=0)
    near: float = setting(low=0)
    border: float = setting(low=0)
    off_road: float = setting(low=0)
    progress: float = setting(low=0)
    comfort: float = setting(low=0)
    lateral_offset: float = setting(low=0)


def score(
    world: World,
    candidates: Candidates,
    others: Forecast,
    steps: Tensor,
    weights: Weights,
) -> Tensor:
    """Costs [B, C]; steps [T]: those that are scored, of the candidates (1 is the next)
    and of the forecast."""
    states = candidates.states[:, :, steps - 1]
    cost = meeting_cost(
        states,
        world.scene["size"][:, 0],
        others=others,
        times=steps * DT,
        weights=weights,
    )
    cost = cost + weights.off_road * beyond_border(
        states[:, :, ::ROAD_STRIDE], world, border=weights.border
    )
    cost = cost + weights.comfort * discomfort(candidates.states, world)
    return (
        cost
        + weights.lateral_offset * candidates.shift.abs()
        - weights.progress * candidates.distance
    )


def meeting_cost(
    ego: Tensor, ego_size: Tensor, others: Forecast, times: Tensor, weights: Weights
) -> Tensor:
    """Costs [B, C] of candidates ego [B, C, T, 4] near others: the worst moment with
    each agent, summed over agents.

    A candidate ends at its first contact that is not from behind: what comes later
    costs nothing, or it would pay to drive through somebody. Only pairs of poses that
    are near enough to cost something are compared as boxes. ego_size [B, 2]; times [T]
    s.
    """
    batch, count, steps, _ = ego.shape
    agents = others.seen.shape[1]
    margin = weights.margin + weights.margin_growth * times * (
        others.speed / MOVING
    ).clamp(max=1)  # [B, M, T]
    reach = (ego_size.norm(dim=-1)[:, None] + others.size.norm(dim=-1)) / 2
    room = (reach[..., None] + margin + BESIDE)[:, None] + weights.headway * ego[
        :, :, None, :, 3
    ]
    dx = ego[:, :, None, :, 0] - others.poses[:, None, :, :, 0]
    dy = ego[:, :, None, :, 1] - others.poses[:, None, :, :, 1]
    near = (dx * dx + dy * dy < room * room) & others.seen[:, None, :, None]
    scene, candidate, agent, time = torch.unravel_index(
        near.view(-1).nonzero()[:, 0], near.shape
    )
    mine = scene * count + candidate
    pair = scene * agents + agent
    cost, ends = pair_cost(
        ego.reshape(-1, 4)[mine * steps + time],
        ego_size[scene],
        other=torch.cat([others.poses, others.speed[..., None]], -1).view(-1, 4)[
            pair * steps + time
        ],
        other_size=others.size.view(-1, 2)[pair],
        margin=margin.view(-1)[pair * steps + time],
        weights=weights,
    )
    end = torch.full((batch * count,), steps, device=ego.device)
    end.scatter_reduce_(0, mine[ends], time[ends], "amin")
    cost = cost * torch.exp(-weights.fade * times)[time] * (time <= end[mine])
    worst = ego.new_zeros(batch * count * agents)
    worst.scatter_reduce_(0, mine * agents + agent, cost, "amax")
    return worst.view(batch, count, agents).sum(-1)


def pair_cost(
    ego: Tensor,
    ego_size: Tensor,
    other: Tensor,
    other_size: Tensor,
    margin: Tensor,
    weights: Weights,
) -> tuple[Tensor, Tensor]:
    """Costs [Q] of pairs of states ego, other [Q, 4] of boxes ego_size, other_size [Q,
    2]; and bool [Q]: they touch, and not from behind.

    Contact costs more at a higher relative velocity, and half where the ego stands.
    Without contact, what counts is the fraction of `margin` [Q] m or of `headway` s
    that is missing, the latter before the ego's own speed closes the gap to whom it has
    ahead. An agent behind the ego counts `rear`: its driver is to keep the distance.
    """
    dx = other[:, 0] - ego[:, 0]
    dy = other[:, 1] - ego[:, 1]
    cos_a = ego[:, 2].cos()
    sin_a = ego[:, 2].sin()
    cos_b = other[:, 2].cos()
    sin_b = other[:, 2].sin()
    cos = cos_a * cos_b + sin_a * sin_b
    sin = sin_a * cos_b - cos_a * sin_b
    (la, wa), (lb, wb) = (ego_size / 2).unbind(-1), (other_size / 2).unbind(-1)
    ahead = dx * cos_a + dy * sin_a
    side = dy * cos_a - dx * sin_a
    along = ahead.abs() - (la + cos.abs() * lb + sin.abs() * wb)
    beside = side.abs() - (wa + sin.abs() * lb + cos.abs() * wb)
    from_other = torch.maximum(
        (dx * cos_b + dy * sin_b).abs() - (lb + cos.abs() * la + sin.abs() * wa),
        (dy * cos_b - dx * sin_b).abs() - (wb + sin.abs() * la + cos.abs() * wa),
    )
    gap = torch.maximum(torch.maximum(along, beside), from_other)
    closing = ego[:, 3] - other[:, 3] * cos
    severity = 1 + (closing.square() + (other[:, 3] * sin).square()) / IMPACT**2
    severity = severity * (1 + (ego[:, 3] / SLOW).clamp(max=1)) / 2
    hit = gap < TOUCH
    tight = (1 - gap / margin).clamp(0, 1).square()
    own = torch.minimum(closing, ego[:, 3]).clamp(min=0)
    soon = (1 - along / (weights.headway * own).clamp(min=1e-3)).clamp(0, 1)
    in_line = beside < BESIDE
    behind = in_line & (ahead < 0)
    cost = weights.contact * hit * severity + weights.near * torch.maximum(
        tight, soon * (in_line & (ahead > 0))
    )
    return cost * torch.where(behind, weights.rear, 1.0), hit & ~behind


def beyond_border(states: Tensor, world: World, border: float) -> Tensor:
    """Metres [B, C], summed over T, by which centres [B, C, T, 4] come nearer to the
    drivable border than `border`, or leave it; only what exceeds the ego's present
    place counts."""
    field = world.scene["field"]
    origin = world.scene["field_origin"]
    now = off_road(world.states[:, :1, :2], field, origin=origin).clamp(min=-border)
    return (
        (off_road(states[..., :2], field, origin=origin) - now[..., None])
        .clamp(0, FARTHEST)
        .sum(-1)
    )


def discomfort(states: Tensor, world: World) -> Tensor:
    """Mean |acceleration| [B, C] m/s^2 of candidates [B, C, T, 4], along and across,
    and JERK_TIME s of jerk now."""
    speed = states[..., 3]
    turn = wrap(states[..., 2].diff(dim=-1)) / DT
    first = (speed[..., 0] - world.states[:, :1, 3]) / DT - world.accel[:, :1]
    along = speed.diff(dim=-1).abs().mean(-1) / DT
    across = (turn * speed[..., 1:]).abs().mean(-1)
    return along + across + JERK_TIME * first.abs()
