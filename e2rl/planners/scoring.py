"""Costs of a planner's candidates by a forecast of others: contact, distance, drivable
border, progress, comfort."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from e2rl.planners.candidates import Candidates
from e2rl.run.config import setting
from e2rl.scenes.drivable_area import off_road
from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import MAX_CURVATURE, constant_velocity, midpoints, wrap
from e2rl.sim.world import World

LOOK = (0.0, 1.0, 2.0, 3.0)  # s at which the nearest are looked for
SLOW_TURN = 1.0  # m/s below which a turn rate says little of the path's curvature
MOVING = 3.0  # m/s from which on an agent's place becomes uncertain at the full rate
TOUCH = 0.15  # m: a smaller gap is a contact, as forecasts err and moments are skipped
BESIDE = 0.3  # m of lateral room from which on an agent is beside, not ahead or behind
SLOW = 2.0  # m/s below which a contact is less and less the ego's own doing
IMPACT = 10.0  # m/s of relative velocity that double the cost of a contact
FARTHEST = 5.0  # m beyond the border from which on being farther costs no more
ROAD_STRIDE = 2  # scored states between two look-ups of the drivable field
JERK_TIME = 0.1  # s: weight of the first change of acceleration against accelerations


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


@dataclass
class Forecast:
    """M agents of each of B scenes: states [B, M, T, 4], size [B, M, 2], present [B,
    M]: the row holds an agent."""

    states: Tensor
    size: Tensor
    present: Tensor


@dataclass
class Pairs:
    """Q pairs of a candidate and an agent at a moment: states [Q, 4] and sizes [Q, 2],
    and the margin [Q] m below which their gap costs."""

    ego: Tensor
    ego_size: Tensor
    other: Tensor
    other_size: Tensor
    margin: Tensor


def nearest(world: World, count: int) -> tuple[Tensor, Tensor]:
    """Agents [B, M] that come nearest to the ego within 3 s if all keep their velocity,
    and whether they are present [B, M]; M: count, or fewer where a scene has no more
    rows."""
    times = torch.tensor(LOOK, device=world.states.device)
    xy = constant_velocity(world.states, times)[..., :2]
    gap = (xy - xy[:, :1]).square().sum(-1).amin(-1)
    others = world.valid.clone()
    others[:, 0] = False
    gap = gap.masked_fill(~others, torch.inf)
    gap, agents = gap.topk(min(count, gap.shape[1]), largest=False)
    return agents, gap < torch.inf


def forecast(
    world: World,
    agents: tuple[Tensor, Tensor],
    *,
    times: Tensor,
    hold: float,
    turn: float,
) -> Forecast:
    """Returns the Forecast of agents; after `hold` and `turn` their speed and heading
    stay.

    Args:
        world: B scenes.
        agents: of `nearest`.
        times: [T] s, evenly spaced from one spacing on.
        hold: s for which the acceleration is held, never beyond a halt.
        turn: s for which the path's curvature is held.
    """
    index, present = agents
    row = torch.arange(len(index), device=index.device)[:, None]
    state = world.states[row, index]
    accel = world.accel[row, index][..., None]
    start = state[..., 3:]
    speed = (start + accel * pad(times, (1, 0)).clamp(max=hold)).clamp(min=0)
    steps = midpoints(speed) * times[0]
    driven = pad(steps.cumsum(-1), (1, 0))
    curvature = world.turn_rate[row, index] / state[..., 3].clamp(min=SLOW_TURN)
    curvature = curvature.clamp(-MAX_CURVATURE, MAX_CURVATURE)[..., None]
    turning = torch.minimum(driven, torch.maximum(start, speed) * turn)
    heading = state[..., 2:3] + curvature * turning
    middle = midpoints(heading)
    x = state[..., 0:1] + (steps * middle.cos()).cumsum(-1)
    y = state[..., 1:2] + (steps * middle.sin()).cumsum(-1)
    return Forecast(
        torch.stack(
            [
                x,
                y,
                heading[..., 1:],
                speed[..., 1:],
            ],
            -1,
        ),
        world.scene["size"][row, index],
        present=present,
    )


def score(
    world: World,
    candidates: Candidates,
    *,
    others: Forecast,
    steps: Tensor,
    weights: Weights,
) -> Tensor:
    """Returns costs [B, C].

    Args:
        world: B scenes.
        candidates: C of each.
        others: at the times of `steps`.
        steps: [T], of the candidates, that are scored; 1 is the next.
        weights: what costs how much.
    """
    states = candidates.states[:, :, steps - 1]
    cost = contact_cost(
        states,
        world,
        others,
        times=steps * DT,
        weights=weights,
    )
    beyond = beyond_border(
        states[:, :, ::ROAD_STRIDE],
        world,
        border=weights.border,
    )
    cost = cost + weights.off_road * beyond
    cost = cost + weights.comfort * discomfort(candidates.states, world)
    cost = cost + weights.lateral_offset * candidates.shift.abs()
    return cost - weights.progress * candidates.distance


def contact_cost(
    ego: Tensor,
    world: World,
    others: Forecast,
    *,
    times: Tensor,
    weights: Weights,
) -> Tensor:
    """Returns costs [B, C] of candidates near others: the worst moment with each agent,
    summed over agents.

    A candidate ends at its first contact that is not from behind: what comes later
    costs nothing, or it would pay to drive through somebody. Only pairs of poses that
    are near enough to cost something are compared as boxes.

    Args:
        ego: states [B, C, T, 4] of the candidates.
        world: B scenes.
        others: M agents of each.
        times: [T] s.
        weights: what costs how much.
    """
    batch, count, steps, _ = ego.shape
    agents = others.present.shape[1]
    ego_size = world.scene["size"][:, 0]
    moving = (others.states[..., 3] / MOVING).clamp(max=1)
    margin = weights.margin + weights.margin_growth * times * moving  # [B, M, T]
    radii = (ego_size.norm(dim=-1)[:, None] + others.size.norm(dim=-1)) / 2
    room = (radii[..., None] + margin + BESIDE)[:, None]
    room = room + weights.headway * ego[:, :, None, :, 3]
    dx = ego[:, :, None, :, 0] - others.states[:, None, :, :, 0]
    dy = ego[:, :, None, :, 1] - others.states[:, None, :, :, 1]
    near = (dx * dx + dy * dy < room * room) & others.present[:, None, :, None]
    flat = near.view(-1).nonzero()[:, 0]
    scene, candidate, agent, time = torch.unravel_index(flat, near.shape)
    candidate = scene * count + candidate
    agent_row = scene * agents + agent
    moment = agent_row * steps + time
    pairs = Pairs(
        ego=ego.reshape(-1, 4)[candidate * steps + time],
        ego_size=ego_size[scene],
        other=others.states.view(-1, 4)[moment],
        other_size=others.size.view(-1, 2)[agent_row],
        margin=margin.view(-1)[moment],
    )
    cost, ends = pair_cost(pairs, weights)
    end = torch.full((batch * count,), steps, device=ego.device)
    end.scatter_reduce_(0, candidate[ends], time[ends], "amin")
    faded = cost * torch.exp(-weights.fade * times)[time]
    cost = faded * (time <= end[candidate])
    worst = ego.new_zeros(batch * count * agents)
    worst.scatter_reduce_(0, candidate * agents + agent, cost, "amax")
    return worst.view(batch, count, agents).sum(-1)


def pair_cost(pairs: Pairs, weights: Weights) -> tuple[Tensor, Tensor]:
    """Costs [Q] of pairs; and bool [Q]: they touch, and not from behind.

    Contact costs more at a higher relative velocity, and half where the ego stands.
    Without contact, what counts is the fraction of the margin or of `headway` s that is
    missing, the latter before the ego's own speed closes the gap to whom it has ahead.
    An agent behind the ego counts `rear`: its driver is to keep the distance.
    """
    ego = pairs.ego
    other = pairs.other
    dx = other[:, 0] - ego[:, 0]
    dy = other[:, 1] - ego[:, 1]
    cos_a = ego[:, 2].cos()
    sin_a = ego[:, 2].sin()
    cos_b = other[:, 2].cos()
    sin_b = other[:, 2].sin()
    cos = cos_a * cos_b + sin_a * sin_b
    sin = sin_a * cos_b - cos_a * sin_b
    length_a, width_a = (pairs.ego_size / 2).unbind(-1)
    length_b, width_b = (pairs.other_size / 2).unbind(-1)
    ahead = dx * cos_a + dy * sin_a
    side = dy * cos_a - dx * sin_a
    along = ahead.abs() - (length_a + cos.abs() * length_b + sin.abs() * width_b)
    beside = side.abs() - (width_a + sin.abs() * length_b + cos.abs() * width_b)
    ahead_of_other = (dx * cos_b + dy * sin_b).abs()
    side_of_other = (dy * cos_b - dx * sin_b).abs()
    from_other = torch.maximum(
        ahead_of_other - (length_b + cos.abs() * length_a + sin.abs() * width_a),
        side_of_other - (width_b + sin.abs() * length_a + cos.abs() * width_a),
    )
    gap = torch.maximum(torch.maximum(along, beside), from_other)
    closing = ego[:, 3] - other[:, 3] * cos
    severity = 1 + (closing.square() + (other[:, 3] * sin).square()) / IMPACT**2
    severity = severity * (1 + (ego[:, 3] / SLOW).clamp(max=1)) / 2
    hit = gap < TOUCH
    tight = (1 - gap / pairs.margin).clamp(0, 1).square()
    approach = torch.minimum(closing, ego[:, 3]).clamp(min=0)
    soon = (1 - along / (weights.headway * approach).clamp(min=1e-3)).clamp(0, 1)
    in_line = beside < BESIDE
    behind = in_line & (ahead < 0)
    nearness = torch.maximum(tight, soon * (in_line & (ahead > 0)))
    cost = weights.contact * hit * severity + weights.near * nearness
    return cost * torch.where(behind, weights.rear, 1.0), hit & ~behind


def beyond_border(
    states: Tensor,
    world: World,
    border: float,
) -> Tensor:
    """Metres [B, C], summed over T, by which centres [B, C, T, 4] come nearer to the
    drivable border than `border`, or leave it; only what exceeds the ego's present
    place counts."""
    field = world.scene["field"]
    origin = world.scene["field_origin"]
    present = off_road(
        world.states[:, :1, :2],
        field,
        origin=origin,
    ).clamp(min=-border)
    distance = off_road(
        states[..., :2],
        field,
        origin=origin,
    )
    return (distance - present[..., None]).clamp(0, FARTHEST).sum(-1)


def discomfort(states: Tensor, world: World) -> Tensor:
    """Mean |acceleration| [B, C] m/s^2 of candidates [B, C, T, 4], along and across,
    and JERK_TIME s of jerk now."""
    speed = states[..., 3]
    turn = wrap(states[..., 2].diff(dim=-1)) / DT
    first = (speed[..., 0] - world.states[:, :1, 3]) / DT - world.accel[:, :1]
    along = speed.diff(dim=-1).abs().mean(-1) / DT
    across = (turn * speed[..., 1:]).abs().mean(-1)
    return along + across + JERK_TIME * first.abs()
