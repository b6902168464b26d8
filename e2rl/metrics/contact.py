"""Contacts: the ego's first one, its type and severity, and those of the simulated traffic (design.md section 5).

Names: B rollouts, N agents (the ego is row 0), T steps; tensors over time hold T + 1 states, step 0 the start frame.
Contact is looked for at every step >= 1. `stop` is the step of the ego's first contact with a vehicle, else T.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.metrics.geometry import edge_distances, edge_parts_inside, overlap_area, velocity
from e2rl.scene.boxes import separation
from e2rl.sim.dynamics import wrap

MIN_AREA = 1e-6  # m2: a smaller overlap is the rounding of float32 positions
FRONT, SIDE, REAR = 0, 1, 2
KINDS = ("front", "side", "rear")
EDGE_KIND = (SIDE, REAR, SIDE, FRONT)  # of geometry.EDGES
BISECTIONS = 20


@dataclass
class EgoContact:
    """The ego's first contact per rollout; `kind`, `partner` are -1 and `touched` is empty where there is none."""

    overlaps_start: Tensor  # [B] bool, the ego overlaps a vehicle at step 0: its collision metrics are NaN
    hit: Tensor  # [B] bool
    stop: Tensor  # [B] int64, last step that counts
    partner: Tensor  # [B] int64, the vehicle with the largest overlap at `stop`
    touched: Tensor  # [B, N] bool, all vehicles that overlap the ego at `stop`
    kind: Tensor  # [B] int64, index into KINDS, by the ego's edge that is hit
    kinds_any: Tensor  # [B, 3] bool, every kind of edge with a part inside a touched vehicle at `stop`
    before: Tensor  # [B] int64, the step before contact (contact itself if the partner was not there before)


def pair_overlap(first: Tensor, first_size: Tensor, second: Tensor, second_size: Tensor, possible: Tensor) -> Tensor:
    """Overlap area [...] [m2] of broadcastable boxes; 0 where `possible` [...] is false or it is <= MIN_AREA.

    Bounding circles and then separating axes sort out pairs first; the exact area is computed for the rest only.
    """
    shape = possible.shape
    boxes = [
        first.expand(*shape, 4),
        first_size.expand(*shape, 2),
        second.expand(*shape, 4),
        second_size.expand(*shape, 2),
    ]
    reach = (boxes[1].norm(dim=-1) + boxes[3].norm(dim=-1)) / 2
    near = possible & ((boxes[0][..., :2] - boxes[2][..., :2]).square().sum(-1) <= reach.square())
    index = near.nonzero(as_tuple=True)
    chosen = [box[index] for box in boxes]
    meet = separation(*chosen) <= 0
    area = overlap_area(*(box[meet] for box in chosen))
    result = torch.zeros(shape, dtype=first.dtype, device=first.device)
    result[tuple(axis[meet] for axis in index)] = area.masked_fill(area <= MIN_AREA, 0.0)
    return result


def ego_overlap(states: Tensor, valid: Tensor, size: Tensor) -> Tensor:
    """Overlap area [B, T+1, N] of the ego with every agent (0 with itself) from states [B, T+1, N, 4]."""
    possible = valid & valid[..., :1]
    possible[..., 0] = False
    return pair_overlap(states[:, :, :1], size[:, None, :1], states, size[:, None], possible)


def first_contact(states: Tensor, valid: Tensor, size: Tensor, area: Tensor) -> EgoContact:
    """The ego's first contact from the vehicles' overlap areas [B, T+1, N] (0 for agents that do not count)."""
    rollouts, steps = states.shape[0], states.shape[1] - 1
    touches = (area > 0).any(-1)
    overlaps_start = touches[:, 0]
    hit = touches[:, 1:].any(-1) & ~overlaps_start
    stop = torch.where(hit, touches[:, 1:].int().argmax(-1) + 1, steps)
    at_stop = area[torch.arange(rollouts, device=area.device), stop] * hit[:, None]
    partner = at_stop.argmax(-1).masked_fill(~hit, -1)
    before = stop - valid[torch.arange(rollouts, device=area.device), stop - 1, partner.clamp(min=0)].long()
    kind = torch.full_like(stop, -1)
    kinds_any = torch.zeros(rollouts, len(KINDS), dtype=torch.bool, device=area.device)
    rows = hit.nonzero()[:, 0]
    if len(rows):
        kind[rows] = contact_kind(*contact_moment(states[rows], size[rows], partner[rows], before[rows], stop[rows]))
        kinds_any[rows] = kinds_at_step(states[rows, stop[rows]], size[rows], at_stop[rows] > 0)
    return EgoContact(overlaps_start, hit, stop, partner, at_stop > 0, kind, kinds_any, before)


def contact_moment(states: Tensor, size: Tensor, partner: Tensor, before: Tensor, stop: Tensor) -> tuple[Tensor, ...]:
    """The ego's and its partner's boxes (state [C, 4], size [C, 2] each) when they first touch.

    States are interpolated linearly between the steps `before` and `stop` and bisected: at 0.1 s steps alone, two fast
    vehicles are already deep in each other, and the longest overlapped edge would be the side one.
    """
    rows = torch.arange(len(states), device=states.device)
    pair = torch.stack([torch.zeros_like(partner), partner], -1)
    start, end = (states[rows[:, None], step[:, None], pair] for step in (before, stop))
    change = end - start
    change = torch.cat([change[..., :2], wrap(change[..., 2:3]), change[..., 3:]], -1)
    sizes = size[rows[:, None], pair]
    low, high = torch.zeros_like(start[:, 0, 0]), torch.ones_like(start[:, 0, 0])
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        now = start + middle[:, None, None] * change
        meet = separation(now[:, 0], sizes[:, 0], now[:, 1], sizes[:, 1]) <= 0
        low, high = torch.where(meet, low, middle), torch.where(meet, middle, high)
    now = start + high[:, None, None] * change
    return now[:, 0], sizes[:, 0], now[:, 1], sizes[:, 1]


def contact_kind(ego: Tensor, ego_size: Tensor, other: Tensor, other_size: Tensor) -> Tensor:
    """Index [...] into KINDS: the ego's edge with the longest part inside the other box; left and right are `side`.

    Where no edge is inside (the other box lies wholly within the ego's) the edge nearest to its centre decides.
    """
    parts = edge_parts_inside(ego, ego_size, other, other_size)
    nearness = -edge_distances(ego, ego_size, other[..., :2])
    chosen = torch.where(parts.amax(-1, keepdim=True) > 1e-9, parts, nearness).argmax(-1)
    return torch.tensor(EDGE_KIND, device=ego.device)[chosen]


def kinds_at_step(states: Tensor, size: Tensor, touched: Tensor) -> Tensor:
    """Bool [C, 3] per KINDS: an edge of this kind of the ego has a part inside any touched [C, N] vehicle."""
    parts = edge_parts_inside(states[:, :1], size[:, :1], states, size)
    inside = ((parts > 1e-9) & touched[..., None]).any(1)
    left, rear, right, front = inside.unbind(-1)
    return torch.stack([front, right | left, rear], -1)


def vulnerable_contact(area: Tensor, vehicle: Tensor, stop: Tensor) -> Tensor:
    """Bool [B]: the ego overlaps an agent that is no vehicle at a step 1..stop; area [B, T+1, N], vehicle [B, N]."""
    counts = ((area > 0) & ~vehicle[:, None]).any(-1)
    return (counts & up_to(stop, area.shape[1])).any(-1)


def background_pairs(states: Tensor, valid: Tensor, size: Tensor, traffic: Tensor, stop: Tensor) -> tuple[Tensor, ...]:
    """Counts [B] of pairs of `traffic` [B, N] vehicles that overlap at a step 1..stop, and at step 0; and who is among
    the first [B, N] bool.

    Pairs that overlap at step 0 already are left out of the first count.
    """
    used = traffic.any(0).nonzero()[:, 0]
    one, two = torch.triu_indices(len(used), len(used), 1, device=states.device)
    one, two = used[one], used[two]
    possible = (valid & traffic[:, None])[:, :, one] & (valid & traffic[:, None])[:, :, two]
    index = nearby(states, size, one, two, possible)
    batch, step, pair = index
    overlap = torch.zeros(possible.shape, dtype=torch.bool, device=states.device)
    first, second = one[pair], two[pair]
    area = pair_overlap(
        states[batch, step, first],
        size[batch, first],
        states[batch, step, second],
        size[batch, second],
        torch.ones_like(batch, dtype=torch.bool),
    )
    overlap[index] = area > 0
    later = (overlap & up_to(stop, states.shape[1])[..., None]).any(1)
    meets = later & ~overlap[:, 0]
    touched = torch.zeros_like(traffic, dtype=torch.int64).index_add(1, one, meets.long())
    touched = touched.index_add(1, two, meets.long()) > 0
    return meets.sum(-1), overlap[:, 0].sum(-1), touched


def nearby(states: Tensor, size: Tensor, one: Tensor, two: Tensor, possible: Tensor) -> tuple[Tensor, ...]:
    """Indices (rollout, step, pair) of possible [B, T+1, P] pairs of agents one [P], two [P] whose circles meet."""
    x, y = states[..., 0], states[..., 1]
    radius = size.norm(dim=-1) / 2
    square = (x[:, :, one] - x[:, :, two]).square_().add_((y[:, :, one] - y[:, :, two]).square_())
    reach = (radius[:, one] + radius[:, two]).square_()
    return (possible & (square <= reach[:, None])).nonzero(as_tuple=True)


def up_to(stop: Tensor, length: int) -> Tensor:
    """Bool [B, length]: the steps 1..stop of rollouts that end at stop [B]."""
    steps = torch.arange(length, device=stop.device)
    return (steps >= 1) & (steps <= stop[:, None])


def relative_speed(states: Tensor, contact: EgoContact) -> Tensor:
    """|v_ego - v_partner| [B] [m/s] at the step before contact; NaN without contact (section 8.3)."""
    rows = torch.arange(len(states), device=states.device)
    now = states[rows, contact.before]
    speed = (velocity(now[:, 0]) - velocity(now[rows, contact.partner.clamp(min=0)])).norm(dim=-1)
    return speed.masked_fill(~contact.hit, torch.nan)
