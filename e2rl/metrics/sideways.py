"""Who moved sideways into whom before a collision (docs/verdicts.md), and the lanes by
which that is judged.

A vehicle moved into the other if it was beside the other's way a second before, and if
it would not have touched it, held at the place across its own lane that it had then.
Shapes: C collisions, W + 1 steps up to the contact, P = 2 vehicles (ego, partner), M
points of lanes.
"""

import torch
from torch import Tensor

from e2rl.metrics.catalogue import Batch
from e2rl.metrics.contact import SIDE
from e2rl.metrics.geometry import travel_heading
from e2rl.scenes.boxes import separation
from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import wrap

ALIGNED = (
    torch.pi / 4
)  # rad between headings, below which they run in the same direction
LANE_REACH = 4.0  # m to the lane that runs a vehicle's way; farther, its own first heading stands for it
LANE_ANGLE = 4.0  # m/rad: of lanes that overlap, the one that runs as the vehicle does is preferred
# Steps looked at. At the ego's side, where somebody must have come over, two seconds if
# nobody did in the last one.
WINDOWS = (round(1.0 / DT), round(2.0 / DT))
REMEMBERED = round(4.0 / DT)  # steps back to a lane that a vehicle has left, turning
LEAST = 0.2  # m sideways within a window that count as a movement
PART = 0.5  # of the other's movement that a vehicle's own must have to count beside it


def moved_into(batch: Batch) -> Tensor:
    """Bool [B, 2]: the ego moved sideways into its partner, the partner into the ego;
    both false without a contact."""
    result = torch.zeros(
        len(batch["hit"]), 2, dtype=torch.bool, device=batch["hit"].device
    )
    hit = batch["hit"]
    if hit.any():
        short, long = (_moved_within(batch, steps) for steps in WINDOWS)
        longer = ~short.any(1) & (batch["kind"][hit] == SIDE)
        result[hit] = torch.where(longer[:, None], long, short)
    return result


def _moved_within(batch: Batch, steps: int) -> Tensor:
    """`moved_into` [C, 2] of the collisions, by the last `steps` steps."""
    states, size = up_to_contact(batch, REMEMBERED)
    lanes = last_lane_headings(batch, states)[:, -1 - steps :]
    states = states[:, -1 - steps :]
    across, aside = sideways(states, lanes)
    held = torch.cat(
        [
            states[..., :2] - across[..., None] * aside,
            lanes[..., None],
            states[..., 3:],
        ],
        -1,
    )
    towards = ((states.flip(2)[:, -1, :, :2] - held[:, -1, :, :2]) * aside[:, -1]).sum(
        -1
    ).sign() * across[:, -1]
    gaps = [
        separation(
            held[:, :, k],
            size[:, None, k],
            second=states[:, :, 1 - k],
            second_size=size[:, None, 1 - k],
        )
        for k in (0, 1)
    ]
    avoids = torch.stack([(gap > 0).all(1) for gap in gaps], 1)
    enters = (beside(states, size, lanes=lanes, aside=aside)[:, :-1] > 0).any(1)
    return avoids & enters & (towards > LEAST) & (towards >= PART * towards.flip(1))


def beside(states: Tensor, size: Tensor, lanes: Tensor, aside: Tensor) -> Tensor:
    """Gap [C, W + 1, P] [m] between each vehicle and the strip that the other takes of
    its own lane; at most 0: it is in the other's way.

    Args:
        states: [C, W + 1, P, 4].
        size: [C, P, 2].
        lanes: [C, W + 1, P], headings of the lanes; aside: [C, W + 1, P, 2], directions
            to their left.
    """
    half = size[:, None] / 2
    strip_heading = lanes.flip(2)
    strip_aside = aside.flip(2)
    offset = ((states[..., :2] - states.flip(2)[..., :2]) * strip_aside).sum(-1).abs()
    for heading, box in (
        (states[..., 2], half),
        (states.flip(2)[..., 2], half.flip(2)),
    ):
        turn = heading - strip_heading
        offset = (
            offset - box[..., 0] * turn.sin().abs() - box[..., 1] * turn.cos().abs()
        )
    return offset


def up_to_contact(batch: Batch, steps: int) -> tuple[Tensor, Tensor]:
    """States [C, W + 1, P, 4] in the `steps` steps up to the contact, and sizes [C, P,
    2]; steps before both are known without a gap repeat the first of those."""
    hit = batch["hit"]
    row = hit.nonzero()[:, 0]
    stop = batch["stop"][hit]
    partner = batch["partner"][hit]
    pair = torch.stack([torch.zeros_like(partner), partner], -1)
    step = stop[:, None] + torch.arange(-steps, 1, device=stop.device)
    present = batch["valid"][
        row[:, None, None], step.clamp(min=0)[..., None], pair[:, None]
    ].all(-1) & (step >= 0)
    known = present.flip(1).long().cumprod(1).sum(1) - 1
    step = torch.maximum(step, (stop - known.clamp(min=0))[:, None])
    return batch["states"][row[:, None, None], step[..., None], pair[:, None]], batch[
        "size"
    ][row[:, None], pair]


def sideways(states: Tensor, lanes: Tensor) -> tuple[Tensor, Tensor]:
    """Metres across their lanes, to the left, that vehicles states [C, W + 1, P, 4]
    have moved since the first step [C, W + 1, P], and that direction [C, W + 1, P, 2];
    lanes [C, W + 1, P]: headings."""
    aside = torch.stack([-lanes.sin(), lanes.cos()], -1)
    change = wrap(lanes.diff(dim=1))
    middle = lanes[:, :-1] + change / 2
    step = states[..., :2].diff(dim=1)
    across = step[..., 1] * middle.cos() - step[..., 0] * middle.sin()
    across = torch.cat([torch.zeros_like(lanes[:, :1]), across.cumsum(1)], 1)
    # Who turns round comes to a lane that runs against the one before, of which its
    # left is the right.
    turns = (change.abs() > ALIGNED).any(1, keepdim=True)
    whole = ((states[..., :2] - states[:, :1, :, :2]) * aside).sum(-1)
    return torch.where(turns, whole, across), aside


def lane_headings(batch: Batch, window: Tensor, every: int) -> Tensor:
    """Headings [C, W, P] [rad] of each vehicle's lane in a window [C, W, P, 4], looked
    up in every `every`-th step.

    The nearest lane, with a price on the angle to the vehicle's direction of travel, of
    those within ALIGNED and LANE_REACH of it. Where there is none, the vehicle's
    direction at the window's start.
    """
    found, known = lanes_along(batch, window[:, ::every])
    found = torch.where(known, found, travel_heading(window[:, :1]))
    return found.repeat_interleave(every, 1)[:, : window.shape[1]]


def last_lane_headings(batch: Batch, window: Tensor) -> Tensor:
    """`lane_headings` of every step; where there is none, that of the lane which the
    vehicle left last."""
    found, known = lanes_along(batch, window)
    step = torch.arange(window.shape[1], device=window.device)[:, None]
    last = torch.where(known, step, -1).cummax(1).values
    kept = found.gather(1, last.clamp(min=0))
    return torch.where(last >= 0, kept, travel_heading(window[:, :1]))


def lanes_along(batch: Batch, moments: Tensor) -> tuple[Tensor, Tensor]:
    """Heading [C, K, P] [rad] of the lane that each vehicle of moments [C, K, P, 4] is
    on, and whether there is one."""
    points = batch["lane_points"][batch["hit"]]
    index = batch["lane_index"][batch["hit"]]
    heading = travel_heading(moments)
    if points.shape[1] < 2:
        return heading, torch.zeros_like(heading, dtype=torch.bool)
    place = moments.flatten(1, 2)[..., :2]
    points, along, index = _near(
        points, lane_directions(points, index), index=index, places=place
    )
    off = torch.cdist(place, points, compute_mode="donot_use_mm_for_euclid_dist")
    angle = wrap(along[:, None] - heading.flatten(1, 2)[..., None]).abs()
    possible = (angle < ALIGNED) & (off < LANE_REACH) & (index >= 0)[:, None]
    price, chosen = (off + LANE_ANGLE * angle).masked_fill(~possible, torch.inf).min(-1)
    return along.gather(1, chosen).view_as(heading), price.isfinite().view_as(heading)


def _near(
    points: Tensor, along: Tensor, index: Tensor, places: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Of points [C, M, 2] of lanes, with directions along and lane numbers index [C,
    M], those in reach of the bounding box of places [C, K, 2], in their order."""
    low = places.amin(1, keepdim=True) - LANE_REACH
    high = places.amax(1, keepdim=True) + LANE_REACH
    inside = ((points >= low) & (points <= high)).all(-1) & (index >= 0)
    count = max(int(inside.sum(1).amax()), 1)
    chosen = torch.argsort(~inside, dim=1, stable=True)[:, :count]
    index = index.masked_fill(~inside, -1).gather(1, chosen)
    return (
        points.gather(1, chosen[..., None].expand(-1, -1, 2)),
        along.gather(1, chosen),
        index,
    )


def lane_directions(points: Tensor, index: Tensor) -> Tensor:
    """Direction [C, M] [rad] of lanes at their points [C, M, 2], from the point before
    to the point after on the same lane (index [C, M])."""
    joined = (index[:, 1:] == index[:, :-1])[..., None]
    change = (points[:, 1:] - points[:, :-1]) * joined
    none = torch.zeros_like(points[:, :1])
    both = torch.cat([change, none], 1) + torch.cat([none, change], 1)
    return torch.atan2(both[..., 1], both[..., 0])
