"""Interaction skeleton, Algorithm 2: near agents act on the ego, a distant one acts on them through a causal chain.

The arg min / arg max over subsets of a sum of distances are the K nearest / farthest agents. Chain intermediates are
taken from S and belong to the coalition C* (design.md section 7.4), and the far agent is sought within `max_dist`,
since the farthest of all is the one whose influence arrives last.
"""

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.errors import InputError
from e2rl.scene.route import project
from e2rl.sim.world import World
from e2rl.synthesizer.motion import compact, cruise, place, reach, take

SUPPORTED, NEAREST_FEASIBLE, NOBODY = range(3)  # where the near agents came from


@dataclass(frozen=True)
class SkeletonSettings:
    """Settings of Algorithm 2; conf/synthesizer/e2.yaml explains each."""

    near: int = 2
    far: int = 1
    tau_dist: float = 15.0
    tau_long: float = 20.0
    max_dist: float = 80.0
    max_chain: int = 4
    horizon: float = 5.0
    step: float = 0.5
    corridor: float = 2.5
    brake: float = 5.0
    push: float = 4.0
    top_speed: float = 25.0

    def __post_init__(self):
        if self.near < 1 or self.far < 0 or self.max_chain < 1:
            raise InputError(
                "synthesizer.skeleton needs near >= 1, far >= 0 and max_chain >= 1; it has "
                f"{self.near}, {self.far}, {self.max_chain}"
            )
        if not 0 < self.step <= self.horizon or min(self.brake, self.push, self.top_speed) <= 0:
            raise InputError("synthesizer.skeleton needs 0 < step <= horizon, and positive brake, push and top_speed")


@dataclass(frozen=True)
class Skeleton:
    """coalition [B, V] bool C*; target [B, V] int64: whom each of C* acts on (0 the ego), -1 for all others; depth [B,
    V] int64: links to the ego (1 acts on it directly, 0 not in C*); near, far [B, V] bool; chains [B] int64: far agents
    whose chain is viable; source [B] int64: SUPPORTED, NEAREST_FEASIBLE (S was empty) or NOBODY.
    """

    coalition: Tensor
    target: Tensor
    depth: Tensor
    near: Tensor
    far: Tensor
    chains: Tensor
    source: Tensor

    def counts(self) -> dict[str, int]:
        """Numbers of scenes by source, and of viable chains, for logging."""
        names = ("supported", "nearest_feasible", "nobody")
        return {name: int((self.source == code).sum()) for code, name in enumerate(names)} | {
            "chains": int(self.chains.sum())
        }


def direct(support: Tensor) -> Skeleton:
    """Everybody of support [B, V] acting on the ego."""
    nobody, none = torch.zeros_like(support), torch.zeros_like(support[:, 0], dtype=torch.int64)
    return Skeleton(support, torch.where(support, 0, -1), support.long(), support, nobody, none, none)


def chain_depth(target: Tensor) -> Tensor:
    """Links to the ego [B, V] int64 of targets [B, V] (0 the ego, -1 nobody); 0 for those who act on nobody."""
    at, depth = target, (target >= 0).long()
    while bool((at > 0).any()) and int(depth.max()) < target.shape[1]:  # a chain is never longer than the vehicles
        depth = depth + (at > 0)
        at = torch.where(at > 0, target.gather(1, at.clamp(min=0)), at)
    return depth


def _extreme(mask: Tensor, distance: Tensor, count: int, farthest: bool = False) -> Tensor:
    """The `count` members of mask [B, V] nearest to the ego (or farthest); equals by index."""
    key = (-distance if farthest else distance).masked_fill(~mask, torch.inf)
    order = key.argsort(dim=-1, stable=True)
    rank = order.argsort(-1)
    return mask & (rank < count)


def lane_of(states: Tensor, scene: TensorDictBase) -> Tensor:
    """Lane index [B, K] nearest to states [B, K, 4] of those that run within 60 degrees of them; -1 without any."""
    points, lane = scene["lane_points"], scene["lane_index"]
    ahead = torch.nn.functional.normalize(torch.diff(points, dim=1), dim=-1)
    ends = torch.nn.functional.pad(lane[:, 1:] != lane[:, :-1], (0, 1), value=True)  # a lane's last point looks back
    ahead = torch.cat([ahead, ahead[:, -1:]], 1)
    ahead = torch.where(ends[..., None], ahead.roll(1, 1), ahead)
    forward = torch.stack([states[..., 2].cos(), states[..., 2].sin()], -1)
    along = forward @ ahead.transpose(1, 2)
    gap = torch.cdist(states[..., :2], points).masked_fill((along < 0.5) | (lane < 0)[:, None], torch.inf)
    nearest, index = gap.min(-1)
    return torch.where(nearest.isfinite(), lane.gather(1, index), -1)


def _beside_ego(states: Tensor, asked: Tensor, scene: TensorDictBase) -> Tensor:
    """Bool [B, K]: vehicles states[:, 1:] [B, 1 + K, 4] are on the lane of the ego states[:, 0], on a neighbour of it,
    or on what these go on into (maps cut lanes). Only scenes with anybody `asked` [B, K] are looked at: maps are large.
    """
    rows = asked.any(1).nonzero()[:, 0]
    scene = scene.select("lane_points", "lane_index", "lane_left", "lane_right", "lane_exits")[rows]
    lanes = lane_of(states[rows], scene)
    lane, ego_lane = lanes[:, 1:], lanes[:, 0]
    known = ego_lane.clamp(min=0)[:, None]
    across = torch.cat([known, scene["lane_left"].gather(1, known), scene["lane_right"].gather(1, known)], 1)
    exits = take(scene["lane_exits"], across.clamp(min=0)).masked_fill(across[..., None] < 0, -1).flatten(1)
    beside = (lane[..., None] == torch.cat([across, exits], 1)[:, None]).any(-1)
    return torch.zeros_like(asked).index_put((rows,), beside & (lane >= 0) & (ego_lane >= 0)[:, None])


def influence(
    scene: TensorDictBase,
    world: World,
    index: Tensor,
    present: Tensor,
    expected: Tensor,
    times: Tensor,
    settings: SkeletonSettings,
) -> Tensor:
    """When each slot can act on each other slot and on the ego: bool [B, M, M + 1, K], the last target is the ego.

    index, present [B, M]: slots; expected [B, V, K, 4]: where everybody will be at times [K]. Slot i can act on j at a
    time when j lies on one of i's routes, i can be there by then, and the longitudinal headway between them would be at
    most tau_long if i kept its speed.
    """
    states = take(world.states[:, : expected.shape[1]], index)
    s, _, _ = place(states, take(scene["route_points"], index))
    slots, count = index.shape[1], len(times)
    b, m, r = (take(scene["route_valid"], index) & present[..., None]).nonzero(as_tuple=True)  # padding is most of it
    route = scene["route_points"][b, index[b, m], r]
    targets = torch.cat([take(expected, index), expected[:, :1]], 1)[..., :2].flatten(1, 2)
    at, beside, _ = project(targets[b], route)
    at, beside = at.view(-1, slots + 1, count), beside.view(-1, slots + 1, count)
    speed, length = states[b, m, 3, None, None], scene["size"][b, index[b, m], 0, None, None]
    gone = at - s[b, m, r, None, None]
    least, most = reach(speed, times, settings.brake, settings.push, settings.top_speed)
    ok = (beside.abs() <= settings.corridor) & (gone >= least - length) & (gone <= most + length)
    ok &= ((gone - speed * times).abs() <= settings.tau_long) & (gone > -length)
    able = torch.zeros(*index.shape, slots + 1, count, device=ok.device)
    able = able.index_put((b, m), ok.float(), accumulate=True) > 0
    there = torch.cat([present, torch.ones_like(present[:, :1])], 1)
    itself = torch.eye(slots, slots + 1, dtype=torch.bool, device=ok.device)
    return able & (present[:, :, None] & there[:, None] & ~itself)[..., None]


def _first_after(link: Tensor) -> Tensor:
    """Index [..., K + 1] of the first true of link [..., K] at or after each index; K for none."""
    count = link.shape[-1]
    steps = torch.arange(count, device=link.device).expand_as(link)
    when = torch.where(link, steps, count).flip(-1).cummin(-1).values.flip(-1)
    return torch.cat([when, torch.full_like(when[..., :1], count)], -1)


def _shortest_chain(after: Tensor, start: Tensor, near: Tensor, blocked: Tensor, links: int):
    """Fewest links from slot start [B] to a near slot that can still act on the ego, each link no earlier than the
    last.

    after [B, M, M + 1, K + 1] of _first_after; blocked [B, M]: slots not to pass. Layer by layer the earliest arrival
    at every slot, as leaving later never arrives earlier. Returns the number of links [B] (0 none), the near slot [B]
    and each layer's predecessors [B, M].
    """
    slots, never = near.shape[1], after.shape[-1] - 1
    arrival = torch.full_like(near, never, dtype=torch.int64).scatter(1, start[:, None], 0)
    found, last, parents = torch.zeros_like(start), start, []
    for link in range(1, links + 1):
        leave = arrival.masked_fill(near | blocked, never)
        reached = after[:, :, :slots].gather(-1, leave[:, :, None, None].expand(-1, -1, slots, 1))[..., 0]
        arrival, parent = reached.min(1)
        parents.append(parent)
        onto = after[:, :, slots].gather(-1, arrival[..., None])[..., 0].masked_fill(~near, never)
        when, slot = onto.min(-1)
        new = (found == 0) & (when < never)
        found, last = torch.where(new, link, found), torch.where(new, slot, last)
    return found, last, parents


def _link_chains(after: Tensor, near: Tensor, far: Tensor, settings: SkeletonSettings):
    """Targets and depths [B, M] of the slots (target M = the ego, -1 none) and the far slots [B, M] with a viable
    chain.
    """
    slots = near.shape[1]
    target = torch.where(near, slots, -1)
    depth = near.long()
    kept = torch.zeros_like(far)
    initiators, there = compact(far)
    for k in range(initiators.shape[1]):
        start = initiators[:, k]
        taken = target.gather(1, start[:, None])[:, 0] >= 0
        blocked = (target >= 0) & ~near
        found, current, parents = _shortest_chain(after, start, near, blocked, settings.max_chain - 1)
        found = torch.where(there[:, k] & ~taken, found, 0)
        ok = there[:, k] & (taken | (found > 0))
        kept = kept.scatter(1, start[:, None], ok[:, None] | kept.gather(1, start[:, None]))
        for link in range(len(parents), 0, -1):
            active = found >= link
            before = parents[link - 1].gather(1, current[:, None])
            step = torch.where(active[:, None], current[:, None], target.gather(1, before))
            deeper = torch.where(active[:, None], depth.gather(1, current[:, None]) + 1, depth.gather(1, before))
            target, depth = target.scatter(1, before, step), depth.scatter(1, before, deeper)
            current = torch.where(active, before[:, 0], current)
    return target, depth, kept


def build_skeleton(
    scene: TensorDictBase,
    world: World,
    support: Tensor,
    feasible: Tensor,
    settings: SkeletonSettings,
    expected: Tensor | None = None,
    cost: Tensor | None = None,
) -> Skeleton:
    """Algorithm 2 for scenes [B]: support [B, V] = S, feasible [B, V] = F.

    expected [B, V, K, 4]: where everybody will be every `step` s up to `horizon`, say in the reference rollout;
    default: at present speed along its route; cost [B, V]: what it takes each to meet the ego, inf where it cannot;
    default: the distance in metres. The near agents are those of S whom it costs least; where S has none the least of F
    act on the ego; where F has none either, nobody.
    """
    vehicles = support.shape[1]
    states = world.states[:, :vehicles].detach()
    times = settings.step * torch.arange(1, round(settings.horizon / settings.step) + 1, device=states.device)
    expected = cruise(scene, world, times) if expected is None else expected.detach()
    distance = (states[..., :2] - states[:, :1, :2]).norm(dim=-1)
    ego = torch.arange(vehicles, device=states.device) == 0
    support, feasible = (mask & world.valid[:, :vehicles] & ~ego for mask in (support, feasible))
    cost = distance if cost is None else cost
    first, second = (mask & cost.isfinite() for mask in (support, feasible))
    source = torch.where(first.any(1), SUPPORTED, torch.where(second.any(1), NEAREST_FEASIBLE, NOBODY))
    near = _extreme(torch.where(first.any(1, keepdim=True), first, second), cost, settings.near)
    index, present = compact(support | near)
    pool = present & take(support & ~near & (distance > settings.tau_dist) & (distance <= settings.max_dist), index)
    pool &= ~_beside_ego(torch.cat([states[:, :1], take(states, index)], 1), pool, scene)
    far = _extreme(pool, take(distance, index), settings.far, farthest=True)
    slot_near = present & take(near, index)
    linked = present & far.any(1, keepdim=True)  # no far agent, no chain to look for
    after = _first_after(influence(scene, world, index, linked, expected, times, settings))
    target, depth, kept = _link_chains(after, slot_near, far, settings)
    vehicle = torch.cat([index, torch.zeros_like(index[:, :1])], 1)
    target = torch.where(target >= 0, vehicle.gather(1, target.clamp(min=0)), -1)

    def spread(values: Tensor, fill: int) -> Tensor:
        full = torch.full((*support.shape,), fill, dtype=values.dtype, device=values.device)
        return full.scatter(1, index, values.masked_fill(~present, fill))

    depth = spread(depth, 0)
    return Skeleton(depth > 0, spread(target, -1), depth, near, spread(kept.long(), 0) > 0, kept.sum(1), source)
