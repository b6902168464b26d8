"""Interaction skeleton (Algorithm 2): near agents act on the ego, a distant one acts on
them through a causal chain.

The arg min / arg max over subsets of a sum of distances are the K nearest / farthest
agents. Intermediate members of a chain are taken from S and join the coalition C*. The
influence of the farthest of all would arrive last, so the far agent is sought within
MAX_DIST.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.run.config import configured, setting
from e2rl.scenes.boxes import unit_vectors
from e2rl.scenes.route import project
from e2rl.sim.world import World
from e2rl.traffic.motion import (
    compact,
    frenet_pose,
    put,
    reachable_distance,
    smallest,
    take,
)

MAX_DIST = 80.0  # m; farther vehicles start no chain
STEP = 0.5  # s between the moments that are looked at
CORRIDOR = 2.5  # m from a route within which a vehicle is on it
SAME_WAY_COSINE = 0.5  # of headings within 60 degrees


@configured("synthesizer/e2", "skeleton")
@dataclass(frozen=True)
class SkeletonSettings:
    """Settings of Algorithm 2; conf/synthesizer/e2.yaml explains each."""

    near: int = setting(low=1)
    far: int = setting(low=0)
    tau_dist: float = setting(low=0)
    tau_long: float = setting(low=0)
    max_chain: int = setting(low=1)
    horizon: float = setting(low=STEP)
    pursuit: bool = setting()


@dataclass(frozen=True)
class Skeleton:
    """coalition [B, V] bool: C*; target [B, V] int64: the vehicle that each of C* acts
    on (0 the ego), -1 for all others; depth [B, V] int64: links to the ego (1 acts on
    it directly, 0 not in C*); near [B, V] bool; far [B, V] bool: far agents with a
    viable chain.
    """

    coalition: Tensor
    target: Tensor
    depth: Tensor
    near: Tensor
    far: Tensor


def direct(support: Tensor) -> Skeleton:
    """The skeleton in which all of support [B, V] act on the ego directly."""
    return Skeleton(
        support,
        torch.where(support, 0, -1),
        depth=support.long(),
        near=support,
        far=torch.zeros_like(support),
    )


def chain_depth(target: Tensor) -> Tensor:
    """Links to the ego [B, V] int64 of targets [B, V] (0 the ego, -1 nobody); 0 for
    vehicles that act on nobody."""
    at = target
    depth = (target >= 0).long()
    while (
        bool((at > 0).any()) and int(depth.max()) < target.shape[1]
    ):  # a chain is never longer than the vehicles
        depth = depth + (at > 0)
        at = torch.where(at > 0, target.gather(1, at.clamp(min=0)), at)
    return depth


def lane_of(states: Tensor, scene: TensorDictBase) -> Tensor:
    """Index [B, K] of the lane nearest to states [B, K, 4] and within 60 degrees of
    their heading; -1 for none."""
    points = scene["lane_points"]
    lane = scene["lane_index"]
    ahead = torch.nn.functional.normalize(torch.diff(points, dim=1), dim=-1)
    ahead = torch.cat([ahead, ahead[:, -1:]], 1)
    # A lane's last point looks back.
    last = torch.nn.functional.pad(lane[:, 1:] != lane[:, :-1], (0, 1), value=True)
    ahead = torch.where(last[..., None], ahead.roll(1, 1), ahead)
    along = unit_vectors(states[..., 2]) @ ahead.transpose(1, 2)
    other = (along < SAME_WAY_COSINE) | (lane < 0)[:, None]
    gap = torch.cdist(states[..., :2], points).masked_fill(other, torch.inf)
    nearest, index = gap.min(-1)
    return torch.where(nearest.isfinite(), lane.gather(1, index), -1)


def _on_ego_lanes(states: Tensor, distant: Tensor, scene: TensorDictBase) -> Tensor:
    """Bool [B, K]: vehicles states[:, 1:] [B, 1 + K, 4] are on the lane of the ego
    states[:, 0], on a neighbour of it, or on a successor of these (maps cut lanes).
    Only scenes with any vehicle distant [B, K] are looked at: maps are large.
    """
    rows = distant.any(1).nonzero()[:, 0]
    scene = scene[rows]
    lanes = lane_of(states[rows], scene)
    lane = lanes[:, 1:]
    ego_lane = lanes[:, :1]
    present = ego_lane.clamp(min=0)
    left = scene["lane_left"].gather(1, present)
    right = scene["lane_right"].gather(1, present)
    across = torch.cat([present, left, right], 1)
    exits = take(scene["lane_exits"], across.clamp(min=0))
    exits = exits.masked_fill(across[..., None] < 0, -1).flatten(1)
    shared = (lane[..., None] == torch.cat([across, exits], 1)[:, None]).any(-1)
    shared = shared & (lane >= 0) & (ego_lane >= 0)
    return torch.zeros_like(distant).index_put((rows,), shared)


def influence(
    world: World,
    *,
    index: Tensor,
    present: Tensor,
    expected: Tensor,
    settings: SkeletonSettings,
) -> Tensor:
    """Returns when each slot can act on each other slot and on the ego: bool
    [B, M, M + 1, K], the last target is the ego.

    Slot i can act on j at a time when j is on one of i's candidate routes, i can be
    there by then, and the longitudinal headway between them would be at most tau_long
    if i kept its speed.

    Args:
        world: B scenes.
        index: [B, M] int64, vehicles of the slots (see `compact`).
        present: [B, M] bool, slots in use.
        expected: [B, V, K, 4], states of everybody every STEP s.
        settings: of Algorithm 2.
    """
    scene = world.scene
    count = expected.shape[2]
    width = index.shape[1] + 1
    times = STEP * torch.arange(1, count + 1, device=index.device)
    states = take(world.states[:, : expected.shape[1]], index)
    s, _, _ = frenet_pose(states, take(scene["route_points"], index))
    # Most candidates are padding.
    candidates = take(scene["route_valid"], index) & present[..., None]
    b, m, r = candidates.nonzero(as_tuple=True)
    targets = torch.cat([take(expected, index), expected[:, :1]], 1)
    points = targets[..., :2].flatten(1, 2)[b]
    target_s, target_d, _ = (
        value.view(-1, width, count)
        for value in project(points, scene["route_points"][b, index[b, m], r])
    )
    speed = states[b, m, 3, None, None]
    length = scene["size"][b, index[b, m], 0, None, None]
    distance = target_s - s[b, m, r, None, None]
    least, most = reachable_distance(speed, times)
    on_route = (target_d.abs() <= CORRIDOR) & (distance > -length)
    in_time = (distance >= least - length) & (distance <= most + length)
    headway = (distance - speed * times).abs() <= settings.tau_long
    can_act = (on_route & in_time & headway).float()
    by_slot = torch.zeros(*index.shape, width, count, device=index.device)
    by_slot = by_slot.index_put((b, m), can_act, accumulate=True) > 0
    is_target = torch.cat([present, torch.ones_like(present[:, :1])], 1)
    itself = torch.eye(width - 1, width, dtype=torch.bool, device=index.device)
    pairs = present[:, :, None] & is_target[:, None] & ~itself
    return by_slot & pairs[..., None]


def first_after(flag: Tensor) -> Tensor:
    """Index [..., K + 1] of the first true of flag [..., K] at or after each index; K
    for none."""
    count = flag.shape[-1]
    steps = torch.arange(count, device=flag.device).expand_as(flag)
    when = torch.where(flag, steps, count).flip(-1).cummin(-1).values.flip(-1)
    return torch.cat([when, torch.full_like(when[..., :1], count)], -1)


class _Chain(NamedTuple):
    """The shortest chains [B]: links, 0 for none; last slot, which acts on the ego;
    predecessors of the slots [B, M] after each link."""

    links: Tensor
    last: Tensor
    parents: list[Tensor]


def _shortest_chain(
    after: Tensor,
    start: Tensor,
    *,
    near: Tensor,
    blocked: Tensor,
    most_links: int,
) -> _Chain:
    """The chain from slot start [B] to a near slot [B, M] that can still act on the
    ego, each link no earlier than the last; it does not pass blocked slots [B, M].

    after [B, M, M + 1, K + 1]: of `first_after`. Breadth-first by the earliest arrival
    at every slot, since departing later never arrives earlier.
    """
    slots = near.shape[1]
    never = after.shape[-1] - 1
    arrival = torch.full_like(near, never, dtype=torch.int64)
    arrival = arrival.scatter(1, start[:, None], 0)
    links = torch.zeros_like(start)
    last = start
    parents = []
    for link in range(1, most_links + 1):
        departure = arrival.masked_fill(near | blocked, never)[:, :, None, None]
        departure = departure.expand(-1, -1, slots, 1)
        reached = after[:, :, :slots].gather(-1, departure)[..., 0]
        arrival, parent = reached.min(1)
        parents.append(parent)
        on_ego = after[:, :, slots].gather(-1, arrival[..., None])[..., 0]
        when, slot = on_ego.masked_fill(~near, never).min(-1)
        new = (links == 0) & (when < never)
        links = torch.where(new, link, links)
        last = torch.where(new, slot, last)
    return _Chain(links, last, parents=parents)


def _link_chains(
    after: Tensor,
    near: Tensor,
    far: Tensor,
    most_links: int,
) -> tuple[Tensor, Tensor]:
    """Targets [B, M] of slots (M: the ego, -1: none); far slots [B, M] with a chain of
    up to `most_links` links."""
    target = torch.where(near, near.shape[1], -1)
    viable = torch.zeros_like(far)
    initiators, present = compact(far)
    for number in range(initiators.shape[1]):
        start = initiators[:, number]
        starts = present[:, number]
        linked = target.gather(1, start[:, None])[:, 0] >= 0
        blocked = (target >= 0) & ~near
        chain = _shortest_chain(
            after,
            start,
            near=near,
            blocked=blocked,
            most_links=most_links,
        )
        links = torch.where(starts & ~linked, chain.links, 0)
        arrives = (starts & (linked | (links > 0)))[:, None]
        before = viable.gather(1, start[:, None])
        viable = viable.scatter(1, start[:, None], arrives | before)
        slot = chain.last
        for link in range(len(chain.parents), 0, -1):
            active = links >= link
            parent = chain.parents[link - 1].gather(1, slot[:, None])
            acts_on = torch.where(
                active[:, None],
                slot[:, None],
                target.gather(1, parent),
            )
            target = target.scatter(1, parent, acts_on)
            slot = torch.where(active, parent[:, 0], slot)
    return target, viable


def build_skeleton(
    world: World,
    *,
    support: Tensor,
    feasible: Tensor,
    settings: SkeletonSettings,
    expected: Tensor,
    cost: Tensor,
) -> Skeleton:
    """Returns the skeletons of Algorithm 2.

    The near agents are those of S with the least cost; where S has none, those of F;
    where F has none either, nobody, or with `pursuit` the nearest of S, or of F where S
    is empty.

    Args:
        world: B scenes.
        support: [B, V] bool, S.
        feasible: [B, V] bool, F.
        settings: of Algorithm 2.
        expected: [B, V, K, 4], states of everybody every STEP s from now.
        cost: [B, V] s, of meeting the ego, inf for vehicles that cannot.
    """
    vehicles = support.shape[1]
    states = world.states[:, :vehicles].detach()
    expected = expected[:, :, : round(settings.horizon / STEP)].detach()
    distance = (states[..., :2] - states[:, :1, :2]).norm(dim=-1)
    ego = torch.arange(vehicles, device=states.device) == 0
    counts = world.valid[:, :vehicles] & ~ego
    support = support & counts
    feasible = feasible & counts
    reaching = cost.isfinite()
    first = support & reaching
    candidates = torch.where(first.any(1, keepdim=True), first, feasible & reaching)
    near = smallest(candidates, cost, count=settings.near)
    if settings.pursuit:
        others = torch.where(support.any(1, keepdim=True), support, feasible)
        nearest = smallest(others, distance, count=settings.near)
        near = torch.where(near.any(1, keepdim=True), near, nearest)
    index, present = compact(support | near)
    distant = support & ~near & (distance > settings.tau_dist) & (distance <= MAX_DIST)
    distant = present & take(distant, index)
    with_ego = torch.cat([states[:, :1], take(states, index)], 1)
    distant &= ~_on_ego_lanes(with_ego, distant, world.scene)
    far = smallest(distant, -take(distance, index), count=settings.far)
    linked = present & far.any(1, keepdim=True)  # no far agent, no chain to look for
    acts = influence(
        world,
        index=index,
        present=linked,
        expected=expected,
        settings=settings,
    )
    slot_target, viable = _link_chains(
        first_after(acts),
        present & take(near, index),
        far=far,
        most_links=settings.max_chain - 1,
    )
    # The vehicle of each slot; the last is the ego.
    vehicle = torch.cat([index, torch.zeros_like(index[:, :1])], 1)
    target = put(
        torch.full_like(support, -1, dtype=torch.int64),
        index,
        mask=slot_target >= 0,
        rows=vehicle.gather(1, slot_target.clamp(min=0)),
    )
    far = put(torch.zeros_like(support), index, mask=present, rows=viable)
    return Skeleton(target >= 0, target, depth=chain_depth(target), near=near, far=far)
