"""The ego's first contact in each rollout, its type and severity (docs/reference/metrics.md).

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
from e2rl.metrics.passing import interpolated, with_passing
from e2rl.scenes.boxes import separation
from e2rl.scenes.recording import CYCLIST, DT, HIDDEN, OTHER, PEDESTRIAN, VEHICLE

KINDS = ("front", "side", "rear")
FRONT, SIDE, REAR = range(3)
EDGE_KIND = (SIDE, REAR, SIDE, FRONT)  # of geometry.EDGES
BISECTIONS = 20  # of the step in which a contact begins
LEAST_PART = 1e-9  # m of an edge inside another box


def steps_until(stop: Tensor, length: int) -> Tensor:
    """Bool [B, length]: the steps 1..stop of rollouts that end at stop [B]."""
    steps = torch.arange(length, device=stop.device)
    return (steps >= 1) & (steps <= stop[:, None])


def first_contact(batch: Batch) -> Batch:
    """The ego's first contact with a vehicle in each rollout.

    Returns:
        area: [B, T+1, N] m^2, overlap of the ego with every agent.
        born_inside: [B, T+1, N] bool, agents that overlap the ego as they have from
            their appearance on, which is no contact.
        start_overlap: [B] bool, the ego overlaps a vehicle at step 0, so its collision
            metrics are unknown.
        hit: [B] bool, there is a contact.
        stop: [B], its step, else T.
        before: [B], the step before, or `stop` where the partner was absent before.
        touching: [B, N] bool, vehicles that overlap the ego at `stop`.
        partner: [B], the one with the largest overlap, -1 without a contact.
        kind: [B], index into KINDS of the ego's edge that is hit, -1 without a contact.
        passes: [B] bool, they pass through each other before `stop`, where they are
            apart again.
    """
    states = batch["states"]
    valid = batch["valid"]
    size = batch["size"]
    row = torch.arange(len(states), device=states.device)
    possible = valid & valid[..., :1]
    possible[..., 0] = False
    boxes = {"second": states, "second_size": size[:, None], "possible": possible}
    area = pair_overlap(
        states[:, :, :1],
        size[:, None, :1],
        **boxes,
    )
    born_inside = overlaps_from_birth(area > 0, valid)
    area, moment = with_passing(
        states[:, :, :1],
        size[:, None, :1],
        area=area,
        **boxes,
    )
    area = area * ~born_inside
    vehicle_area = area * (batch["agent_type"] == VEHICLE)[:, None]
    overlaps = (vehicle_area > 0).any(-1)
    hit = overlaps[:, 1:].any(-1) & ~overlaps[:, 0]
    stop = torch.where(hit, overlaps[:, 1:].int().argmax(-1) + 1, states.shape[1] - 1)
    area_at_stop = vehicle_area[row, stop] * hit[:, None]
    partner = area_at_stop.argmax(-1).masked_fill(~hit, -1)
    before = stop - valid[row, stop - 1, partner.clamp(min=0)].long()
    latest = moment[row, stop, partner.clamp(min=0)]
    kind = torch.full_like(stop, -1)
    if hit.any():
        pair = torch.stack([torch.zeros_like(partner), partner], -1)[hit]
        index = row[hit, None]
        sizes = size[index, pair]
        at_contact = states_at_contact(
            states[index, before[hit, None], pair],
            states[index, stop[hit, None], pair],
            sizes=sizes,
            latest=latest[hit],
        )
        kind[hit] = contact_kind(at_contact, sizes)
    return {
        "area": area,
        "born_inside": born_inside,
        "start_overlap": overlaps[:, 0],
        "hit": hit,
        "stop": stop,
        "before": before,
        "touching": area_at_stop > 0,
        "partner": partner,
        "kind": kind,
        "passes": hit & (latest < 1),
    }


def overlaps_from_birth(overlap: Tensor, valid: Tensor) -> Tensor:
    """Steps [B, T+1, N] bool at which agents overlap the ego as they have from their
    appearance on.

    Whoever appears within the ego, after more than HIDDEN steps of absence, touches it
    only after they have been apart once. Agents of the first step are there from
    before, and not counted here.

    Args:
        overlap: [B, T+1, N] bool, agents that overlap the ego.
        valid: [B, T+1, N] bool, agents that are there.
    """
    result = torch.zeros_like(overlap)
    rows, agents = overlap.any(1).nonzero(as_tuple=True)
    if not len(rows):
        return result
    overlap = overlap[rows, :, agents]
    valid = valid[rows, :, agents]
    steps = torch.arange(overlap.shape[1], device=overlap.device)

    def latest(condition: Tensor, otherwise: int) -> Tensor:
        return torch.where(condition, steps, otherwise).cummax(1).values

    last_valid = latest(valid, -HIDDEN - 1)
    before = torch.nn.functional.pad(
        last_valid[:, :-1],
        (1, 0),
        value=0,
    )
    birth = latest(valid & (steps - before > HIDDEN + 1), -1)
    apart = latest(valid & ~overlap, -2)
    result[rows, :, agents] = overlap & (birth >= 0) & (apart < birth)
    return result


def states_at_contact(
    before: Tensor,
    after: Tensor,
    *,
    sizes: Tensor,
    latest: Tensor,
) -> Tensor:
    """States [C, 2, 4] of the ego and its partner at the moment when they first touch.

    The moment is found by bisection of interpolated states. At the step itself two fast
    vehicles are already deep in each other, and the longest edge inside would be a side.

    Args:
        before, after: states [C, 2, 4] at the step before and at the contact's.
        sizes: [C, 2, 2].
        latest: [C], fraction of the step at which they overlap.
    """
    low = torch.zeros_like(latest)
    high = latest
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        states = interpolated(
            before,
            after,
            fraction=middle[:, None],
        )
        gap = separation(
            states[:, 0],
            sizes[:, 0],
            second=states[:, 1],
            second_size=sizes[:, 1],
        )
        low = torch.where(gap <= 0, low, middle)
        high = torch.where(gap <= 0, middle, high)
    return interpolated(
        before,
        after,
        fraction=high[:, None],
    )


def contact_kind(states: Tensor, sizes: Tensor) -> Tensor:
    """Index [C] into KINDS of the ego's edge with the longest part inside its partner,
    of states [C, 2, 4] and sizes [C, 2, 2] of both; left and right are `side`.

    Where no edge is inside (the partner lies wholly within the ego) the edge nearest to
    its centre decides.
    """
    ego, other = states.unbind(1)
    ego_size, other_size = sizes.unbind(1)
    parts = edge_parts_inside(
        ego,
        ego_size,
        other=other,
        other_size=other_size,
    )
    nearness = -edge_distances(
        ego,
        ego_size,
        point=other[..., :2],
    )
    inside = parts.amax(-1, keepdim=True) > LEAST_PART
    edge = torch.where(inside, parts, nearness).argmax(-1)
    return torch.tensor(EDGE_KIND, device=edge.device)[edge]


def kinds_at_stop(batch: Batch) -> Tensor:
    """Bool [B, 3] per KINDS: an edge of this kind has a part inside any vehicle that
    the ego touches at `stop`."""
    states = batch["states"][torch.arange(len(batch["stop"])), batch["stop"]]
    parts = edge_parts_inside(
        states[:, :1],
        batch["size"][:, :1],
        other=states,
        other_size=batch["size"],
    )
    inside = ((parts > LEAST_PART) & batch["touching"][..., None]).any(1)
    left, rear, right, front = inside.unbind(-1)
    passing = batch["passes"][:, None] & (
        batch["kind"][:, None] == torch.arange(len(KINDS))
    )
    return torch.stack([front, right | left, rear], -1) | passing


@columns(
    event(
        "cfr",
        "ego hits any vehicle",
        raised=1.0,
        tables="main traffic adversaries methods egos public",
    ),
    event(
        "cfr_adv",
        "ego hits an adversary",
        tables="main adversaries methods",
    ),
    event(
        "cfr_vru",
        "ego hits a pedestrian or cyclist",
        raised=1.0,
        tables="main public",
    ),
    event(
        "cfr_object",
        "ego hits an object, such as a cone",
        raised=1.0,
        tables="main public",
    ),
    *(
        event(
            kind,
            f"first contact at the ego's {kind}",
            tables="main adversaries egos",
        )
        for kind in KINDS
    ),
    *(
        event(
            f"{kind}_any",
            f"ego's {kind} in contact at first contact",
            tables="egos",
        )
        for kind in KINDS
    ),
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
    states = batch["states"]
    hit = batch["hit"]
    stop = batch["stop"]
    events = {"cfr": hit, "cfr_adv": (batch["touching"] & batch["adversaries"]).any(-1)}
    for kind, any_of_kind in enumerate(kinds_at_stop(batch).unbind(1)):
        events[KINDS[kind]] = batch["kind"] == kind
        events[f"{KINDS[kind]}_any"] = any_of_kind
    result = {
        name: value.to(states.dtype).masked_fill(batch["start_overlap"], torch.nan)
        for name, value in events.items()
    }
    touches = (batch["area"] > 0) & steps_until(stop, states.shape[1])[..., None]
    touched = touches.any(1)
    agent_type = batch["agent_type"]
    vulnerable = (agent_type == PEDESTRIAN) | (agent_type == CYCLIST)
    row = torch.arange(len(states))
    before = velocity(states[row, batch["before"]])
    relative = (before[:, 0] - before[row, batch["partner"].clamp(min=0)]).norm(dim=-1)
    step = stop.to(states.dtype).masked_fill(~hit, torch.nan)
    return result | {
        "cfr_vru": (touched & vulnerable).any(1).to(states.dtype),
        "cfr_object": (touched & (agent_type == OTHER)).any(1).to(states.dtype),
        "rir": result["rear"].masked_fill(~hit, torch.nan),
        "relvel": relative.masked_fill(~hit, torch.nan),
        "contact_step": step,
        "contact_time": step * DT,
        "contact_type": batch["kind"],
        "partner": batch["partner"],
        "start_overlap_ego": batch["start_overlap"],
    }
