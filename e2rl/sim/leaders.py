"""Leaders: the nearest agent ahead of each vehicle along its route.

Most agents are far from most routes, so only near pairs are projected: routes are cut
into stretches with bounding boxes, and an agent is compared with the vertices of the
stretches near it.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.run.fused import fused
from e2rl.scenes.route import SPACING, onto_segments

GATE_MARGIN = 0.3  # m of lateral clearance within which an agent still is a leader
FREE_GAP = 200.0  # m: the gap of a vehicle without a leader
STRETCH = 10  # vertices


# Called, because a field `index` of a class hides tuple.index for the type checker.
class Leaders(
    NamedTuple("Leaders", [("gap", Tensor), ("speed", Tensor), ("index", Tensor)])
):
    """Per vehicle and moment [B, V, T]: gap from bumper to bumper [m], the leader's
    speed along the route [m/s], its index."""


class Pairs(NamedTuple):
    """Vehicles and agents near their routes, each [Q] int64: scene, vehicle, agent,
    moment, and the nearest vertex of the vehicle's route."""

    scene: Tensor
    vehicle: Tensor
    agent: Tensor
    moment: Tensor
    vertex: Tensor


class Followers(NamedTuple):
    """Vehicles on their routes: arc length s and offset d [B, V] m, points [B, V, P, 2]
    m."""

    s: Tensor
    d: Tensor
    points: Tensor


def leaders(
    s: Tensor,
    points: Tensor,
    *,
    agents: Tensor,
    size: Tensor,
    present: Tensor,
    d: Tensor | None = None,
    free_gap: float = FREE_GAP,
) -> Leaders:
    """The nearest agent ahead of each vehicle whose box is within GATE_MARGIN of the
    vehicle's lateral range, at T moments of the agents.

    A vehicle's lateral range is its width around the route; with offsets it also covers
    the distance from the offset back to the route.

    Args:
        s: [B, V] m, arc lengths of the vehicles, where they are all the while.
        points: [B, V, P, 2] m, their routes.
        agents: [B, M, T, 4] states, the vehicles in rows 0 .. V-1.
        size: [B, M, 2] m.
        present: [B, M] bool.
        d: [B, V] m, offsets of the vehicles (None: 0).
        free_gap: m.

    Returns:
        Fields [B, V, T]. Without a leader nearer than `free_gap`, the gap is `free_gap`
        and the speed is the vehicle's own.
    """
    d = torch.zeros_like(s) if d is None else d
    reach = size[:, : s.shape[1], 1] / 2 + GATE_MARGIN + d.abs()
    room = reach[..., None] + size.norm(dim=-1)[:, None] / 2
    pairs = _near_pairs(
        points,
        s,
        xy=agents[..., :2],
        room=room,
        present=present,
    )
    gap, along, leads = ahead_of(Followers(s, d, points), agents, size, pairs)
    table = gap.new_full((*s.shape, agents.shape[2], agents.shape[1]), free_gap)
    at = (pairs.scene, pairs.vehicle, pairs.moment, pairs.agent)
    gaps = table.index_put(at, torch.where(leads > 0, gap, free_gap))
    nearest, index = gaps.min(-1)
    speeds = torch.zeros_like(table).index_put(at, along)
    speed = speeds.gather(-1, index[..., None])[..., 0]
    speed = torch.where(nearest < free_gap, speed, agents[:, : s.shape[1], :, 3])
    return Leaders(nearest.clamp(max=free_gap), speed, index)


@fused(("B V", "B V", "B V P 2!"), "B X T 4!", "B X 2!", "Q:int64")
def ahead_of(
    followers: Followers,
    agents: Tensor,
    size: Tensor,
    pairs: Pairs,
) -> tuple[Tensor, Tensor, Tensor]:
    """Of each pair [Q] the gap m, the agent's speed along the route m/s, and 1 where it
    is a leader (see `leaders`), else 0.

    Args:
        followers: the vehicles.
        agents: [B, X, T, 4] states.
        size: [B, X, 2] m.
        pairs: vehicles and agents.
    """
    s, d, points = followers
    at = (pairs.scene, pairs.vehicle)
    x, y, heading, v = agents[pairs.scene, pairs.agent, pairs.moment].unbind(-1)
    place, offset, route_heading = onto_segments(
        torch.stack([x, y], -1),
        pairs.vertex,
        last=points.shape[2] - 2,
        take=lambda index: points[pairs.scene, pairs.vehicle, index],
    )
    turn = heading - route_heading
    cos = torch.cos(turn)
    sin = torch.sin(turn)
    length, width = size[at].unbind(-1)
    box_length, box_width = size[pairs.scene, pairs.agent].unbind(-1)
    across = (box_length * sin.abs() + box_width * cos.abs()) / 2
    along = (box_length * cos.abs() + box_width * sin.abs()) / 2
    ahead = place - s[at]
    aside = offset - torch.minimum(
        torch.maximum(offset, d[at].clamp(max=0)), d[at].clamp(min=0)
    )
    leads = (aside.abs() < width / 2 + across + GATE_MARGIN) & (ahead > 0)
    return ahead - length / 2 - along, v * cos, torch.where(leads, 1.0, 0.0)


def _near_pairs(
    points: Tensor,
    s: Tensor,
    *,
    xy: Tensor,
    room: Tensor,
    present: Tensor,
) -> Pairs:
    """Pairs of present agents xy [B, M, T, 2] within room [B, V, M] m of the vehicle's
    route and not behind it. Where the route comes by an agent more than once, the first
    time counts. A route continues straight beyond its last vertex."""
    vehicles, count = points.shape[1:3]
    moments = xy.shape[2]
    stretches = _stretches(points)  # [B, V, C, 2, STRETCH + 1]
    low, high = torch.aminmax(stretches, dim=-1)
    number = torch.arange(1, low.shape[2] + 1, device=s.device)
    ends = SPACING * (STRETCH * number).clamp(max=count - 1)
    to_come = (ends >= s[..., None] - SPACING).to(s.dtype)
    itself = torch.eye(
        vehicles,
        xy.shape[1],
        dtype=torch.bool,
        device=s.device,
    )
    counts = present[:, :vehicles, None] & present[:, None] & ~itself
    far = (room + SPACING / 2).repeat_interleave(moments, -1)
    flat = xy.flatten(1, 2)
    before = points[:, :, -2]
    last = points[:, :, -1]
    some = near_some(low, high, before, last, to_come, flat, far) > 0
    b, v, m = (counts.repeat_interleave(moments, -1) & some).nonzero(as_tuple=True)
    place = flat[b, m]
    within = far[b, v, m]
    near = _near(
        low[b, v],
        high[b, v],
        xy=place[:, None],
        far=within[:, None],
    )
    near &= to_come[b, v] > 0
    near[:, -1] |= _beyond(
        before[b, v],
        last[b, v],
        xy=place,
        far=within,
    )
    pair, stretch = near.nonzero(as_tuple=True)
    gap = stretches[b[pair], v[pair], stretch] - place[pair][..., None]
    nearest, index = gap.square().sum(1).min(-1)
    table = nearest.new_full(near.shape, torch.inf).index_put((pair, stretch), nearest)
    vertex = torch.zeros_like(table, dtype=torch.long).index_put(
        (pair, stretch), STRETCH * stretch + index
    )
    chosen = _first_passage(table, within.square())
    vertex = vertex.gather(1, chosen[:, None])[:, 0].clamp(max=count - 1)
    return Pairs(b, v, m // moments, m % moments, vertex)


def _first_passage(squared: Tensor, reach: Tensor) -> Tensor:
    """Index [Q] of the first stretch that is nearer to an agent than the next one is,
    and within reach; without any, of the nearest.

    squared [Q, C], reach [Q]: squared distances.
    """
    after = torch.nn.functional.pad(squared[:, 1:], (0, 1), value=torch.inf)
    passes = (squared <= after) & (squared <= reach[:, None])
    return torch.where(passes.any(1), passes.int().argmax(1), squared.argmin(1))


@fused("B V C 2", "B V C 2", "B V 2", "B V 2", "B V C", "B Q 2", "B V Q")
def near_some(
    low: Tensor,
    high: Tensor,
    before: Tensor,
    last: Tensor,
    to_come: Tensor,
    xy: Tensor,
    far: Tensor,
) -> Tensor:
    """1 where a point [B, V, Q] is near a stretch that is to come, or the route's
    straight continuation; else 0.

    Args:
        low, high: [B, V, C, 2] m, corners of the stretches' boxes.
        before, last: [B, V, 2] m, the last two vertices of the routes.
        to_come: [B, V, C], 1 where it is, else 0.
        xy: [B, Q, 2] m, the points.
        far: [B, V, Q] m, what is near.
    """
    near = _near(
        low[..., None, :],
        high[..., None, :],
        xy=xy[:, None, None],
        far=far[:, :, None],
    )
    beyond = _beyond(
        before[:, :, None],
        last[:, :, None],
        xy=xy[:, None],
        far=far,
    )
    on_stretch = torch.where(near, to_come[..., None], 0.0).amax(2)
    return torch.maximum(on_stretch, torch.where(beyond, 1.0, 0.0))


def _near(
    low: Tensor,
    high: Tensor,
    xy: Tensor,
    far: Tensor,
) -> Tensor:
    """Bool [...]: points xy [..., 2] are within far [...] m of boxes low to high [...,
    2]."""
    x, y = torch.maximum(low - xy, xy - high).clamp(min=0).unbind(-1)
    return x.square() + y.square() < far.square()


def _beyond(
    before: Tensor,
    last: Tensor,
    xy: Tensor,
    far: Tensor,
) -> Tensor:
    """Bool [...]: points are within far m of a line that goes on straight beyond its
    last two vertices [..., 2]."""
    tip = last - before
    unit = tip / tip.norm(
        dim=-1,
        keepdim=True,
    ).clamp(min=1e-6)
    past = xy - last
    across = past[..., 1] * unit[..., 0] - past[..., 0] * unit[..., 1]
    return ((past * unit).sum(-1) > 0) & (across.abs() < far)


def _stretches(points: Tensor) -> Tensor:
    """Stretches [B, V, C, 2, STRETCH + 1] of routes points [B, V, P, 2]; each begins
    with the last vertex of the one before, and the last one is filled up with the
    route's end."""
    missing = -(points.shape[2] - 1) % STRETCH
    if missing:
        points = torch.cat([points, points[:, :, -1:].expand(-1, -1, missing, -1)], 2)
    return points.unfold(2, STRETCH + 1, STRETCH)


class IDMParameters(NamedTuple):
    """Headway T [s], standstill gap s0 [m], maximum acceleration a and comfortable
    braking b [m/s^2], exponent n."""

    headway: float
    standstill_gap: float
    acceleration: float
    braking: float
    exponent: float = 4.0


def desired_gap(speed: Tensor, leader_speed: Tensor, driver: IDMParameters) -> Tensor:
    """s* [...] m behind a leader: s0 + max(0, v T + v (v - v_leader) / (2 sqrt(ab)))."""
    closing = (
        speed
        * (speed - leader_speed)
        / (2 * (driver.acceleration * driver.braking) ** 0.5)
    )
    return driver.standstill_gap + (speed * driver.headway + closing).clamp(min=0)


def idm_acceleration(
    speed: Tensor,
    desired_speed: Tensor,
    *,
    gap: Tensor,
    leader_speed: Tensor,
    driver: IDMParameters,
    improved: bool,
) -> Tensor:
    """IDM acceleration [...] m/s^2: the free-road term less a (s* / s)^2.

    Treiber, Hennecke and Helbing, Physical Review E 62 (2000), eqs. (3) and (4), whose
    free-road term is a (1 - (v / v0)^n).

    Args:
        speed: [...] m/s, v.
        desired_speed: [...] m/s, v0.
        gap: [...] m, s; inf: no leader.
        leader_speed: [...] m/s.
        driver: a, b, n and what s* takes.
        improved: above the desired speed the free-road term is -b (1 - (v0 / v)^(a n /
            b)), which brakes by b at most (Treiber and Kesting, Traffic Flow Dynamics,
            2013, eq. 11.23).
    """
    a = driver.acceleration
    b = driver.braking
    n = driver.exponent
    wanted = desired_gap(speed, leader_speed, driver)
    interaction = (wanted / gap.clamp(min=0.1)) ** 2
    if not improved:
        return a * (1 - (speed / desired_speed).clamp(min=0) ** n - interaction)
    below = a * (1 - (speed / desired_speed).clamp(0, 1) ** n)
    ratio = (desired_speed / speed.clamp(min=1e-3)).clamp(max=1)
    above = -b * (1 - ratio ** (a * n / b))
    return torch.where(speed > desired_speed, above, below) - a * interaction
