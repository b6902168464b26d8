"""Who moved sideways into whom before a collision (docs/reference/verdicts.md), and the lanes by
which that is judged.

A vehicle moved into the other if it was beside the other's strip a second before, and if
it would not have touched it, held at the place across its own lane that it had then.
Shapes: C collisions, W + 1 steps up to the contact, P = 2 vehicles (ego, partner), M
points of lanes.
"""

import torch
from torch import Tensor

from e2rl.metrics.collisions import Collisions
from e2rl.metrics.contact import SIDE
from e2rl.metrics.geometry import travel_heading
from e2rl.scenes.boxes import angle_of, separation
from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import wrap

ALIGNED = torch.pi / 4  # rad between headings, below which they run in one direction
LANE_REACH = 4.0  # m to the lane of a vehicle; farther, its first heading stands for it
LANE_ANGLE = 4.0  # m/rad: of overlapping lanes, the one that runs as the vehicle does
WINDOW = round(1.0 / DT)  # steps before the contact
# Steps at the ego's side, where somebody must have come over, if nobody did in WINDOW.
SIDE_WINDOW = round(2.0 / DT)
REMEMBERED = round(4.0 / DT)  # steps back to a lane that a vehicle has left, turning
LEAST_OFFSET = 0.2  # m sideways within a window that count as a movement
LEAST_SHARE = 0.5  # of the other's movement, from which on both have moved


def moved_into(collisions: Collisions) -> Tensor:
    """Bool [C, 2]: the ego moved sideways into its partner, the partner into the ego."""
    states, _ = collisions.window(collisions.stop, REMEMBERED)
    lanes = last_lane_headings(collisions, states)
    short, long = (
        moved_within(states[:, -1 - steps :], collisions.size, lanes[:, -1 - steps :])
        for steps in (WINDOW, SIDE_WINDOW)
    )
    longer = ~short.any(1) & (collisions.kind == SIDE)
    return torch.where(longer[:, None], long, short)


def moved_within(states: Tensor, size: Tensor, lanes: Tensor) -> Tensor:
    """`moved_into` [C, 2] by states [C, W + 1, P, 4], sizes [C, P, 2] and headings of
    lanes [C, W + 1, P]."""
    left = torch.stack([-lanes.sin(), lanes.cos()], -1)
    offset = lateral_motion(
        states,
        lanes,
        left=left,
    )
    held = torch.cat(
        [
            states[..., :2] - offset[..., None] * left,
            lanes[..., None],
            states[..., 3:],
        ],
        -1,
    )
    gap = separation(
        held,
        size[:, None],
        second=states.flip(2),
        second_size=size.flip(1)[:, None],
    )
    avoids = (gap > 0).all(1)
    enters = (
        strip_gap(
            states,
            size,
            lanes=lanes,
            left=left,
        )[:, :-1]
        > 0
    ).any(1)
    to_other = states.flip(2)[:, -1, :, :2] - held[:, -1, :, :2]
    towards = (to_other * left[:, -1]).sum(-1).sign() * offset[:, -1]
    moves = (towards > LEAST_OFFSET) & (towards >= LEAST_SHARE * towards.flip(1))
    return avoids & enters & moves


def strip_gap(states: Tensor, size: Tensor, *, lanes: Tensor, left: Tensor) -> Tensor:
    """Gap [C, W + 1, P] m between each vehicle and the strip that the other takes of
    its own lane; at most 0: it is in the other's strip.

    Args:
        states: [C, W + 1, P, 4].
        size: [C, P, 2].
        lanes: [C, W + 1, P] rad, headings of the lanes.
        left: [C, W + 1, P, 2], directions to their left.
    """
    half = size[:, None] / 2
    other = states.flip(2)
    gap = ((states[..., :2] - other[..., :2]) * left.flip(2)).sum(-1).abs()
    for box, box_half in ((states, half), (other, half.flip(2))):
        turn = box[..., 2] - lanes.flip(2)
        gap = gap - box_half[..., 0] * turn.sin().abs()
        gap = gap - box_half[..., 1] * turn.cos().abs()
    return gap


def lateral_motion(states: Tensor, lanes: Tensor, left: Tensor) -> Tensor:
    """Metres [C, W + 1, P] to the left across their lanes that vehicles states [C,
    W + 1, P, 4] have moved from the first step on; lanes, left as in `strip_gap`."""
    change = wrap(lanes.diff(dim=1))
    middle = lanes[:, :-1] + change / 2
    step = states[..., :2].diff(dim=1)
    across = step[..., 1] * middle.cos() - step[..., 0] * middle.sin()
    across = torch.cat([torch.zeros_like(lanes[:, :1]), across.cumsum(1)], 1)
    # Who turns round comes to a lane that runs against the one before, of which its
    # left is the right.
    turns_round = (change.abs() > ALIGNED).any(1, keepdim=True)
    whole = ((states[..., :2] - states[:, :1, :, :2]) * left).sum(-1)
    return torch.where(turns_round, whole, across)


def lane_headings(collisions: Collisions, window: Tensor, every: int) -> Tensor:
    """Headings [C, W, P] rad of each vehicle's lane in a window [C, W, P, 4], looked up
    in every `every`-th step.

    Where there is no lane, the vehicle's direction at the window's start.
    """
    heading, on_lane = lanes_along(collisions, window[:, ::every])
    heading = torch.where(on_lane, heading, travel_heading(window[:, :1]))
    return heading.repeat_interleave(every, 1)[:, : window.shape[1]]


def last_lane_headings(collisions: Collisions, window: Tensor) -> Tensor:
    """`lane_headings` of every step; where there is none, that of the lane which the
    vehicle left last."""
    heading, on_lane = lanes_along(collisions, window)
    step = torch.arange(window.shape[1])[:, None]
    last = torch.where(on_lane, step, -1).cummax(1).values
    last_heading = heading.gather(1, last.clamp(min=0))
    return torch.where(last >= 0, last_heading, travel_heading(window[:, :1]))


def lanes_along(collisions: Collisions, moments: Tensor) -> tuple[Tensor, Tensor]:
    """Heading [C, K, P] rad of the lane that each vehicle of moments [C, K, P, 4] is
    on, and whether there is one.

    It is the nearest lane, with a price on the angle to the vehicle's direction of
    travel, of those within ALIGNED and LANE_REACH of it.
    """
    points = collisions.lane_points
    index = collisions.lane_index
    heading = travel_heading(moments)
    if not len(points) or points.shape[1] < 2:
        return heading, torch.zeros_like(heading, dtype=torch.bool)
    places = moments.flatten(1, 2)[..., :2]
    low = places.amin(1, keepdim=True) - LANE_REACH
    high = places.amax(1, keepdim=True) + LANE_REACH
    near = ((points >= low) & (points <= high)).all(-1) & (index >= 0)
    count = max(int(near.sum(1).amax()), 1)
    chosen = torch.argsort(
        ~near,
        dim=1,
        stable=True,
    )[:, :count]
    directions = lane_directions(points, index).gather(1, chosen)
    distance = torch.cdist(
        places,
        points.gather(1, chosen[..., None].expand(-1, -1, 2)),
        compute_mode="donot_use_mm_for_euclid_dist",
    )
    angle = wrap(directions[:, None] - heading.flatten(1, 2)[..., None]).abs()
    possible = (angle < ALIGNED) & (distance < LANE_REACH)
    possible = possible & near.gather(1, chosen)[:, None]
    price = (distance + LANE_ANGLE * angle).masked_fill(~possible, torch.inf)
    least, best = price.min(-1)
    return (
        directions.gather(1, best).view_as(heading),
        least.isfinite().view_as(heading),
    )


def lane_directions(points: Tensor, index: Tensor) -> Tensor:
    """Direction [C, M] rad of lanes at their points [C, M, 2], from the point before to
    the point after on the same lane (index [C, M])."""
    same_lane = (index[:, 1:] == index[:, :-1])[..., None]
    change = torch.nn.functional.pad(points.diff(dim=1) * same_lane, (0, 0, 1, 1))
    both = change[:, 1:] + change[:, :-1]
    return angle_of(both)
