"""Costs of a planner's candidates by a forecast of others: contact, distance, drivable
border, progress, comfort."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from e2rl.planners.candidates import Candidates
from e2rl.planners.ego import PLAN_STEPS
from e2rl.run.config import setting
from e2rl.run.fused import fused
from e2rl.scenes.drivable_area import off_road_at
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

    def prices(self, like: Tensor) -> "Prices":
        """The Prices, of a tensor's type, where it lies."""
        return Prices(
            *[like.new_tensor(getattr(self, name)) for name in Prices._fields]
        )


class Forecast(NamedTuple):
    """M agents of each of B scenes: states [B, M, T, 4], size [B, M, 2], present [B,
    M]: the row holds an agent."""

    states: Tensor
    size: Tensor
    present: Tensor


class Pairs(NamedTuple):
    """Pairs of each of R agents with the candidates of its scene: scene [R] int64;
    ego_size [R, 2] m; states [R, T, 4] and size [R, 2] of the agent; margin [R, T] m
    below which their gap costs."""

    scene: Tensor
    ego_size: Tensor
    states: Tensor
    size: Tensor
    margin: Tensor


class Prices(NamedTuple):
    """Those of `Weights` that pairs depend on, scalars."""

    margin: Tensor
    margin_growth: Tensor
    headway: Tensor
    rear: Tensor
    fade: Tensor
    contact: Tensor
    near: Tensor


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
    driven = candidates.states.permute(3, 2, 0, 1)
    scored = driven[:, steps - 1]
    size = world.scene["size"][:, 0]
    times = steps * DT
    prices = weights.prices(size)
    cost = contact_cost(scored, size, others, times, prices)
    beyond = beyond_border(
        scored[:2, ::ROAD_STRIDE],
        world.states[:, 0, :2],
        world.scene["field"],
        world.scene["field_origin"],
        size.new_tensor(weights.border),
    )
    cost = cost + weights.off_road * beyond
    now = torch.stack([world.states[:, 0, 3], world.accel[:, 0]])
    cost = cost + weights.comfort * discomfort(driven, now)
    cost = cost + weights.lateral_offset * candidates.shift.abs()
    return cost - weights.progress * candidates.distance


def contact_cost(
    ego: Tensor,
    ego_size: Tensor,
    others: Forecast,
    times: Tensor,
    prices: Prices,
) -> Tensor:
    """Returns costs [B, C] of candidates near others: the worst moment with each agent,
    summed over agents.

    A candidate ends at its first contact that is not from behind: what comes later
    costs nothing, or it would pay to drive through somebody. Only agents that come near
    enough to a candidate to cost something are compared, with all candidates.

    Args:
        ego: states [4, T, B, C] of the candidates.
        ego_size: [B, 2] m.
        others: M agents of each scene.
        times: [T] s.
        prices: what costs how much.
    """
    batch, count = ego.shape[2:]
    agents = others.present.shape[1]
    moving = (others.states[..., 3] / MOVING).clamp(max=1)
    margin = prices.margin + prices.margin_growth * times * moving  # [B, M, T]
    radii = (ego_size.norm(dim=-1)[:, None] + others.size.norm(dim=-1)) / 2
    room = (radii[..., None] + margin + BESIDE).where(others.present[..., None], -1e6)
    near = come_near(ego, others.states, room, prices.headway)
    scene, agent = near.nonzero(as_tuple=True)
    pairs = Pairs(
        scene,
        ego_size[scene],
        states=others.states[scene, agent],
        size=others.size[scene, agent],
        margin=margin[scene, agent],
    )
    x, y, heading, speed = ego
    poses = torch.stack([x, y, heading.cos(), heading.sin(), speed])
    cost, contact = pair_costs(poses, pairs, times, prices)
    into = scene[:, None].expand(-1, count)
    end = ego.new_full((batch, count), torch.inf)
    end.scatter_reduce_(0, into, contact, "amin")
    worst = ego.new_zeros(batch, agents, count)
    worst[scene, agent] = worst_until(cost, times, end[scene])
    return worst.sum(1)


@fused("4 T B C", "B M T 4", "B M T", "")
def come_near(ego: Tensor, other: Tensor, room: Tensor, headway: Tensor) -> Tensor:
    """Returns 1 where an agent [B, M] comes near enough to a candidate to cost
    something, else 0.

    Args:
        ego: states [4, T, B, C] of the candidates.
        other: states [B, M, T, 4] of the agents.
        room: [B, M, T] m between the centres, of a standing ego.
        headway: s by which its speed adds to it.
    """
    x, y, _, speed = ego.transpose(1, 2)[:, :, None]  # [B, 1, T, C] each
    dx = x - other[..., 0, None]
    dy = y - other[..., 1, None]
    reach = room[..., None] + headway * speed
    near = (dx * dx + dy * dy < reach * reach) & (reach > 0)
    return torch.where(near, 1.0, 0.0).amax((2, 3))


@fused("5 T B C", ("R:int64", "R 2", "R T 4", "R 2", "R T"), "T", "")
def pair_costs(
    poses: Tensor, pairs: Pairs, times: Tensor, prices: Prices
) -> tuple[Tensor, Tensor]:
    """Costs [R, T, C] of pairs; and the time [R, C] s at which they first touch, and
    not from behind, inf for none.

    Contact costs more at a higher relative velocity, and half where the ego stands.
    Without contact, what counts is the fraction of the margin or of `headway` s that is
    missing, the latter before the ego's own speed closes the gap to whom it has ahead.
    An agent behind the ego counts `rear`: its driver is to keep the distance. What
    comes later costs less, by exp(-fade t).

    Args:
        poses: [5, T, B, C] of the candidates: x, y, cosine and sine of the heading,
            speed.
        pairs: agents and scenes.
        times: [T] s.
        prices: what costs how much.
    """
    x, y, cos_a, sin_a, speed = poses[:, :, pairs.scene].transpose(1, 2)  # [R, T, C]
    other_x, other_y, other_heading, other_speed = pairs.states[..., None, :].unbind(-1)
    dx = other_x - x
    dy = other_y - y
    cos_b = other_heading.cos()
    sin_b = other_heading.sin()
    cos = cos_a * cos_b + sin_a * sin_b
    sin = sin_a * cos_b - cos_a * sin_b
    length_a, width_a = (pairs.ego_size[:, None, None] / 2).unbind(-1)
    length_b, width_b = (pairs.size[:, None, None] / 2).unbind(-1)
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
    closing = speed - other_speed * cos
    severity = 1 + (closing.square() + (other_speed * sin).square()) / IMPACT**2
    severity = severity * (1 + (speed / SLOW).clamp(max=1)) / 2
    hit = gap < TOUCH
    tight = (1 - gap / pairs.margin[..., None]).clamp(0, 1).square()
    approach = torch.minimum(closing, speed).clamp(min=0)
    soon = (1 - along / (prices.headway * approach).clamp(min=1e-3)).clamp(0, 1)
    in_line = beside < BESIDE
    behind = in_line & (ahead < 0)
    nearness = torch.maximum(tight, soon * (in_line & (ahead > 0)))
    cost = prices.contact * hit * severity + prices.near * nearness
    faded = cost * torch.exp(-prices.fade * times)[:, None]
    contact = torch.where(hit & ~behind, times[:, None], torch.inf).amin(1)
    return faded * torch.where(behind, prices.rear, 1.0), contact


@fused("R T C", "T", "R C")
def worst_until(cost: Tensor, times: Tensor, end: Tensor) -> Tensor:
    """Highest costs [R, C] of moments [R, T, C] at times [T] up to an end [R, C], itself
    included."""
    return torch.where(times[:, None] <= end[:, None], cost, 0.0).amax(1)


@fused("2 T B C", "B 2", "B G G:float16", "B 2", "")
def beyond_border(
    places: Tensor,
    present: Tensor,
    field: Tensor,
    origin: Tensor,
    border: Tensor,
) -> Tensor:
    """Metres [B, C], summed over T, by which centres come nearer to the drivable border
    than `border`, or leave it; only what exceeds the ego's present place counts.

    Args:
        places: [2, T, B, C] m, of the candidates.
        present: [B, 2] m, of the ego.
        field, origin: see `off_road`.
        border: m.
    """
    x, y = places.transpose(1, 2).flatten(2)
    beyond = off_road_at(x, y, field, origin).unflatten(1, (-1, places.shape[-1]))
    here = off_road_at(present[:, :1], present[:, 1:], field, origin)
    allowed = torch.maximum(here, -border)[..., None]
    return (beyond - allowed).clamp(0, FARTHEST).sum(1)


@fused(f"4 {PLAN_STEPS} B C", "2 B")
def discomfort(states: Tensor, now: Tensor) -> Tensor:
    """Mean |acceleration| [B, C] m/s^2 of candidates, along and across, and JERK_TIME s
    of jerk now.

    Args:
        states: [4, PLAN_STEPS, B, C].
        now: [2, B], the ego's speed and acceleration.
    """
    heading, speed = states[2:]
    turn = wrap(heading[1:] - heading[:-1]) / DT
    first = (speed[0] - now[0, :, None]) / DT - now[1, :, None]
    along = (speed[1:] - speed[:-1]).abs().mean(0) / DT
    across = (turn * speed[1:]).abs().mean(0)
    return along + across + JERK_TIME * first.abs()
