"""Contacts of the ego, their type and severity, and contacts within the simulated
traffic (docs/method.md, section 10).

Shapes: B rollouts, N agents (the ego is row 0), T steps. Tensors over time hold T + 1
states; step 0 is the start. A contact counts at steps >= 1. `stop` is the step of the
ego's first contact with a vehicle, T without one.
"""

import torch
from torch import Tensor

from e2rl.metrics.catalogue import Batch, Metric, columns, event, rate
from e2rl.metrics.geometry import (
    edge_distances,
    edge_parts_inside,
    pair_overlap,
    velocity,
)
from e2rl.metrics.realism import MOVING
from e2rl.scenes.boxes import separation, to_frame
from e2rl.scenes.recording import CYCLIST, DT, HIDDEN, OTHER, PEDESTRIAN, VEHICLE
from e2rl.sim.dynamics import wrap
from e2rl.sim.passing import is_fast, time_inside

FRONT = 0
SIDE = 1
REAR = 2
KINDS = ("front", "side", "rear")
EDGE_KIND = (SIDE, REAR, SIDE, FRONT)  # of geometry.EDGES
BISECTIONS = 20


def steps_until(stop: Tensor, length: int) -> Tensor:
    """Bool [B, length]: the steps 1..stop of rollouts that end at stop [B]."""
    steps = torch.arange(length, device=stop.device)
    return (steps >= 1) & (steps <= stop[:, None])


def first_contact(batch: Batch) -> Batch:
    """The ego's first contact with a vehicle in each rollout.

    area [B, T+1, N] [m2]: overlap of the ego with every agent. start_overlap [B]: the
    ego overlaps a vehicle at step 0, so its collision metrics are unknown. hit [B]
    bool. stop [B]: step of the contact, else T. touching [B, N]: vehicles that overlap
    the ego at `stop`. partner [B]: the one with the largest overlap. kind [B]: index
    into KINDS, by the ego's edge that is hit. Partner and kind are -1 without a
    contact. before [B]: the step before the contact, or the contact's own where the
    partner was absent before. passes [B]: they pass through each other before `stop`,
    where they are apart again. born_inside [B, T+1, N]: agents that overlap the ego as
    they have since they appeared, which is no contact.
    """
    states = batch["states"]
    valid = batch["valid"]
    size = batch["size"]
    row = torch.arange(len(states), device=states.device)
    possible = valid & valid[..., :1]
    possible[..., 0] = False
    ego = states[:, :, :1]
    ego_size = size[:, None, :1]
    everybody = states
    sizes = size[:, None]
    area = pair_overlap(
        ego, ego_size, second=everybody, second_size=sizes, possible=possible
    )
    born_inside = since_birth(area > 0, valid)
    area, moment = with_passing(
        ego, ego_size, second=everybody, second_size=sizes, possible=possible, area=area
    )
    area = area * ~born_inside
    vehicle_area = area * (batch["agent_type"] == VEHICLE)[:, None]
    overlaps = (vehicle_area > 0).any(-1)
    hit = overlaps[:, 1:].any(-1) & ~overlaps[:, 0]
    stop = torch.where(hit, overlaps[:, 1:].int().argmax(-1) + 1, states.shape[1] - 1)
    at_stop = vehicle_area[row, stop] * hit[:, None]
    partner = at_stop.argmax(-1).masked_fill(~hit, -1)
    before = stop - valid[row, stop - 1, partner.clamp(min=0)].long()
    kind = torch.full_like(stop, -1)
    latest = moment[row, stop, partner.clamp(min=0)]
    if hit.any():
        boxes = boxes_at_contact(
            states[hit],
            size[hit],
            partner=partner[hit],
            before=before[hit],
            stop=stop[hit],
            latest=latest[hit],
        )
        kind[hit] = contact_kind(*boxes)
    contact = {
        "area": area,
        "start_overlap": overlaps[:, 0],
        "hit": hit,
        "stop": stop,
        "touching": at_stop > 0,
    }
    contact |= {
        "partner": partner,
        "kind": kind,
        "before": before,
        "passes": hit & (latest < 1),
    }
    return contact | {"born_inside": born_inside}


def with_passing(
    first: Tensor,
    first_size: Tensor,
    second: Tensor,
    second_size: Tensor,
    possible: Tensor,
    area: Tensor,
) -> tuple[Tensor, Tensor]:
    """Overlap areas [B, T+1, N] with those of pairs that pass through each other in the
    step before, at the middle of their contact; and that moment [B, T+1, N], as a
    fraction of the step, 1 for all others.

    first, second: states [B, T+1, N or 1, 4], with sizes that broadcast; possible, area
    [B, T+1, N]: of pairs at steps.
    """
    moment = torch.ones_like(area)
    shape = area.shape
    boxes = [
        value.expand(*shape, value.shape[-1])
        for value in (first, first_size, second, second_size)
    ]
    offset = (boxes[2] - boxes[0])[..., :2]
    change = torch.nn.functional.pad(offset.diff(dim=1), (0, 0, 0, 0, 1, 0))
    reach = (boxes[1].norm(dim=-1) + boxes[3].norm(dim=-1)) / 2 + change.norm(dim=-1)
    half = [(boxes[index] / 2).movedim(-1, 0) for index in (1, 3)]
    asked = (
        possible
        & (area == 0)
        & is_fast(change.movedim(-1, 0), *half)
        & (offset.norm(dim=-1) < reach)
    )
    asked[:, 0] = False
    asked[:, 1:] &= possible[:, :-1] & (area[:, :-1] == 0)
    if not asked.any():
        return area, moment
    rollout, step, agent = asked.nonzero(as_tuple=True)
    one, one_size, two, two_size = (value[rollout, step, agent] for value in boxes)
    one_before, two_before = (
        boxes[index][rollout, step - 1, agent] for index in (0, 2)
    )
    middle = [
        between(then, now, fraction=torch.full_like(now[:, 0], 0.5))
        for then, now in ((one_before, one), (two_before, two))
    ]
    frame = torch.cat([torch.zeros_like(one[:, :2]), middle[0][:, 2:3]], -1)
    offset = to_frame(two_before[:, :2] - one_before[:, :2], frame).T
    moved = to_frame(change[rollout, step, agent], frame).T
    turn = middle[1][:, 2] - middle[0][:, 2]
    direction = torch.stack([turn.cos(), turn.sin()])
    begin, end = time_inside(
        offset, moved, direction=direction, own=(one_size / 2).T, other=(two_size / 2).T
    )
    at = (begin + end) / 2
    inside = begin < end
    shared = pair_overlap(
        between(one_before, one, fraction=at),
        one_size,
        second=between(two_before, two, fraction=at),
        second_size=two_size,
        possible=inside,
    )
    area = area.clone()
    touched = shared > 0
    area[rollout[touched], step[touched], agent[touched]] = shared[touched]
    moment[rollout[touched], step[touched], agent[touched]] = at[touched]
    return area, moment


def between(before: Tensor, after: Tensor, fraction: Tensor) -> Tensor:
    """States [..., 4] at a fraction [...] of the way from `before` to `after` [..., 4]."""
    change = after - before
    change = torch.cat([change[..., :2], wrap(change[..., 2:3]), change[..., 3:]], -1)
    return before + fraction[..., None] * change


def since_birth(overlap: Tensor, valid: Tensor) -> Tensor:
    """Returns the steps [B, T+1, N] bool at which agents overlap the ego as they have
    since they appeared.

    Whoever appears within the ego, after more than HIDDEN steps of absence, touches it
    only after they have been apart once. Agents of the first step are there from
    before, and not counted here.

    Args:
        overlap: [B, T+1, N] bool, agents that overlap the ego.
        valid: [B, T+1, N] bool, agents that are there.
    """
    born = torch.zeros_like(overlap)
    rows, agents = overlap.any(1).nonzero(as_tuple=True)
    if not len(rows):
        return born
    overlaps = overlap[rows, :, agents]
    there = valid[rows, :, agents]
    steps = torch.arange(overlap.shape[1], device=overlap.device)
    seen = torch.where(there, steps, -HIDDEN - 1).cummax(1).values
    before = torch.nn.functional.pad(seen[:, :-1], (1, 0), value=0)
    appears = there & (steps - before > HIDDEN + 1)
    birth = torch.where(appears, steps, -1).cummax(1).values
    apart = torch.where(there & ~overlaps, steps, -2).cummax(1).values
    born[rows, :, agents] = overlaps & (birth >= 0) & (apart < birth)
    return born


def boxes_at_contact(
    states: Tensor,
    size: Tensor,
    partner: Tensor,
    before: Tensor,
    stop: Tensor,
    latest: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """State [C, 4] and size [C, 2] of the ego and then of its partner at the moment
    when they first touch.

    The moment is found by bisection of states interpolated linearly between the step
    `before` and the fraction `latest` [C] of the way to `stop`, at which they overlap.
    At the step itself two fast vehicles are already deep in each other, and the longest
    edge inside would be a side.
    """
    rows = torch.arange(len(states), device=states.device)
    pair = torch.stack([torch.zeros_like(partner), partner], -1)
    start, end = (states[rows[:, None], step[:, None], pair] for step in (before, stop))
    sizes = size[rows[:, None], pair]
    low = torch.zeros_like(latest)
    high = latest
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        now = between(start, end, fraction=middle[:, None])
        meet = (
            separation(
                now[:, 0], sizes[:, 0], second=now[:, 1], second_size=sizes[:, 1]
            )
            <= 0
        )
        low = torch.where(meet, low, middle)
        high = torch.where(meet, middle, high)
    now = between(start, end, fraction=high[:, None])
    return now[:, 0], sizes[:, 0], now[:, 1], sizes[:, 1]


def contact_kind(
    ego: Tensor, ego_size: Tensor, other: Tensor, other_size: Tensor
) -> Tensor:
    """Index [...] into KINDS of the ego's edge with the longest part inside the other
    box; left and right are `side`.

    Where no edge is inside (the other box lies wholly within the ego's) the edge
    nearest to its centre decides.
    """
    parts = edge_parts_inside(ego, ego_size, other=other, other_size=other_size)
    nearness = -edge_distances(ego, ego_size, point=other[..., :2])
    chosen = torch.where(parts.amax(-1, keepdim=True) > 1e-9, parts, nearness).argmax(
        -1
    )
    return torch.tensor(EDGE_KIND, device=ego.device)[chosen]


def kinds_at_stop(batch: Batch) -> Tensor:
    """Bool [B, 3] per KINDS: an edge of this kind has a part inside any vehicle that
    the ego touches at `stop`."""
    states = batch["states"][torch.arange(len(batch["stop"])), batch["stop"]]
    parts = edge_parts_inside(
        states[:, :1], batch["size"][:, :1], other=states, other_size=batch["size"]
    )
    inside = ((parts > 1e-9) & batch["touching"][..., None]).any(1)
    left, rear, right, front = inside.unbind(-1)
    kinds = torch.arange(len(KINDS), device=states.device)
    passing = batch["passes"][:, None] & (batch["kind"][:, None] == kinds)
    return torch.stack([front, right | left, rear], -1) | passing


@columns(
    event(
        "cfr",
        "ego hits any vehicle",
        raised=1.0,
        tables="main traffic adversaries methods egos public",
    ),
    event("cfr_adv", "ego hits an adversary", tables="main adversaries methods"),
    event(
        "cfr_vru", "ego hits a pedestrian or cyclist", raised=1.0, tables="main public"
    ),
    event(
        "cfr_object",
        "ego hits an object, such as a cone",
        raised=1.0,
        tables="main public",
    ),
    event("front", "first contact at the ego's front", tables="main adversaries egos"),
    event("side", "first contact at the ego's side", tables="main adversaries egos"),
    event("rear", "first contact at the ego's rear", tables="main adversaries egos"),
    event("front_any", "ego's front in contact at first contact", tables="egos"),
    event("side_any", "ego's side in contact at first contact", tables="egos"),
    event("rear_any", "ego's rear in contact at first contact", tables="egos"),
    rate(
        "rir",
        "rear impacts per collision",
        per_collision=True,
        tables="main adversaries methods",
    ),
    Metric(
        "relvel",
        "impact speed: of the ego relative to its partner, before contact",
        unit="m/s",
        per_collision=True,
        tables="main adversaries methods egos",
    ),
    Metric(
        "contact_time",
        "median time of the first contact",
        unit="s",
        median=True,
        per_collision=True,
        tables="main adversaries egos",
    ),
    events=("contact_type", "partner", "contact_step", "start_overlap_ego"),
    words={"contact_type": KINDS},
)
def contact_columns(batch: Batch) -> Batch:
    """Metrics of the ego's first contact; NaN where the ego overlaps a vehicle at the
    start already.

    relvel: |v_ego - v_partner| [m/s] at the step before contact.
    """
    states, hit, stop, unknown = (
        batch[key] for key in ("states", "hit", "stop", "start_overlap")
    )
    found = {"cfr": hit, "cfr_adv": (batch["touching"] & batch["adversaries"]).any(-1)}
    for kind, (name, touched) in enumerate(
        zip(KINDS, kinds_at_stop(batch).unbind(1), strict=True)
    ):
        found |= {name: batch["kind"] == kind, f"{name}_any": touched}
    found = {
        name: value.to(states.dtype).masked_fill(unknown, torch.nan)
        for name, value in found.items()
    }
    step = stop.to(states.dtype).masked_fill(~hit, torch.nan)
    row = torch.arange(len(states))
    before = velocity(states[row, batch["before"]])
    relative = (before[:, 0] - before[row, batch["partner"].clamp(min=0)]).norm(dim=-1)
    until = steps_until(stop, states.shape[1])[..., None]
    touches = batch["area"] > 0
    agent_type = batch["agent_type"][:, None]
    vulnerable = (
        touches & until & ((agent_type == PEDESTRIAN) | (agent_type == CYCLIST))
    )
    objects = touches & until & (agent_type == OTHER)
    return found | {
        "cfr_vru": vulnerable.any((1, 2)).to(states.dtype),
        "cfr_object": objects.any((1, 2)).to(states.dtype),
        "rir": found["rear"].masked_fill(~hit, torch.nan),
        "relvel": relative.masked_fill(~hit, torch.nan),
        "contact_step": step,
        "contact_time": step * DT,
        "contact_type": batch["kind"],
        "partner": batch["partner"],
        "start_overlap_ego": unknown,
    }


@columns(
    rate(
        "cfr_bg",
        "other simulated vehicles hit each other",
        tables="main traffic adversaries methods",
    ),
    Metric("bg_pairs", "pairs of other vehicles that hit each other"),
    rate(
        "touched",
        "moving vehicles that touch another simulated one",
        weight="moving_vehicles",
        tables="traffic",
    ),
    events=("moving_vehicles", "start_overlap_bg"),
)
def traffic_contact_columns(batch: Batch) -> Batch:
    """Pairs of `traffic` vehicles that overlap at a step 1..stop, and the fraction of
    moving vehicles among them.

    Pairs that overlap at step 0 already are counted apart and left out of the rest.
    """
    states = batch["states"]
    size = batch["size"]
    traffic = batch["traffic"]
    used = traffic.any(0).nonzero()[:, 0]
    one, two = used[torch.triu_indices(len(used), len(used), 1, device=states.device)]
    index = nearby(
        states, size, one=one, two=two, present=batch["valid"] & traffic[:, None]
    )
    row, step, pair = index
    first, second = (
        (states[row, step, agent], size[row, agent]) for agent in (one[pair], two[pair])
    )
    overlap = torch.zeros(
        *states.shape[:2], len(one), dtype=torch.bool, device=states.device
    )
    overlap[index] = (
        pair_overlap(*first, *second, torch.ones_like(row, dtype=torch.bool)) > 0
    )
    later = (overlap & steps_until(batch["stop"], states.shape[1])[..., None]).any(1)
    meets = later & ~overlap[:, 0]
    touched = torch.zeros_like(traffic, dtype=torch.int64)
    touched = touched.index_add(1, torch.cat([one, two]), meets.long().repeat(1, 2)) > 0
    pairs = meets.sum(-1)
    found = {
        "cfr_bg": (pairs > 0).to(states.dtype),
        "bg_pairs": pairs,
        "start_overlap_bg": overlap[:, 0].any(-1),
    }
    return found | touched_columns(batch, touched)


def nearby(
    states: Tensor, size: Tensor, one: Tensor, two: Tensor, present: Tensor
) -> tuple[Tensor, ...]:
    """Indices (rollout, step, pair) where agents one [P] and two [P] are present and
    their bounding circles meet."""
    x = states[..., 0]
    y = states[..., 1]
    radius = size.norm(dim=-1) / 2
    square = (
        (x[:, :, one] - x[:, :, two])
        .square_()
        .add_((y[:, :, one] - y[:, :, two]).square_())
    )
    reach = (radius[:, one] + radius[:, two]).square_()
    return (
        present[:, :, one] & present[:, :, two] & (square <= reach[:, None])
    ).nonzero(as_tuple=True)


def touched_columns(batch: Batch, touched: Tensor) -> Batch:
    """Fraction of the traffic that moves, in the rollout or its log, that is touched
    [B, N] by another vehicle."""
    pairs = (("states", "valid"), ("logged", "logged_valid"))
    fastest = [
        (batch[track][..., 3].abs() * batch[valid]).amax(1) for track, valid in pairs
    ]
    moving = batch["traffic"] & (torch.maximum(*fastest) > MOVING)
    number = moving.sum(-1)
    fraction = (touched & moving).sum(-1).to(
        batch["states"].dtype
    ) / number  # 0 / 0 is NaN
    return {"touched": fraction, "moving_vehicles": number}
