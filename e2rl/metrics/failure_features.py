"""What happens in a collision of the ego: from where the partner comes, and what both
do (docs/modes.md).

Everything is read from the last two seconds before the contact, relative to the two
vehicles and the lanes, so moving or turning the world changes nothing and mirroring it
swaps left and right. Shapes: C collisions, W = 21 steps of the last two seconds, P = 2
vehicles (ego, partner), M points of the map's lanes.
"""

import math

import torch
from torch import Tensor

from e2rl.metrics.catalogue import Batch, columns
from e2rl.metrics.geometry import travel_heading
from e2rl.metrics.sideways import ALIGNED, lane_headings
from e2rl.metrics.verdicts import ego_path_boxes
from e2rl.scenes.boxes import separation, to_frame
from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import wrap

APPROACHES = (
    *(
        "ahead",
        "cut-in from the left",
        "cut-in from the right",
        "beside on the left",
        "beside on the right",
    ),
    *("from behind", "crossing from the left", "crossing from the right", "oncoming"),
)  # where the partner comes from
AHEAD, CUT_IN, BESIDE, BEHIND, CROSSING, ONCOMING = (
    0,
    1,
    3,
    5,
    6,
    8,
)  # indices; of pairs the left one, then the right
MANOEUVRES = (
    *("stands", "keeps speed", "brakes", "accelerates"),
    *("turns left", "turns right", "veers left", "veers right"),
)  # what a vehicle does
STANDS = 0
KEEPS = 1
BRAKES = 2
ACCELERATES = 3
TURNS = 4
VEERS = 6
WINDOW, LATE = (
    round(2 / DT),
    round(1 / DT),
)  # steps before contact: of headings and ways, of positions and speeds
STANDING = 0.5  # m/s, never exceeded in the window
SPEEDING = 1.0  # m/s^2 of mean acceleration over the last second
TURNING = math.radians(25)  # change of heading over the window
SIDEWAYS = 0.5  # m/s of mean motion across the lane's direction over the window
LANE_EVERY = 4  # steps between looks at the lanes


@columns(
    events=(
        "approach",
        "ego_manoeuvre",
        "partner_manoeuvre",
        "ego_speed",
        "partner_speed",
    ),
    words={
        "approach": APPROACHES,
        "ego_manoeuvre": MANOEUVRES,
        "partner_manoeuvre": MANOEUVRES,
    },
)
def failure_columns(batch: Batch) -> Batch:
    """approach, ego_manoeuvre, partner_manoeuvre [B]: indices into APPROACHES and
    MANOEUVRES, -1 without a contact; ego_speed, partner_speed [B]: m/s at the step
    before the contact, NaN without one."""
    hit = batch["hit"]
    words = {
        name: torch.full_like(batch["stop"], -1)
        for name in ("approach", "ego_manoeuvre", "partner_manoeuvre")
    }
    speeds = batch["states"].new_full((len(hit), 2), torch.nan)
    if hit.any():
        window, known, size = last_seconds(batch)
        manoeuvres = manoeuvre(
            window, known, lanes=lane_headings(batch, window, every=LANE_EVERY)
        )
        stands = manoeuvres[:, 1] == STANDS
        came, went = batch["moved_into"][hit].unbind(1)
        words["approach"][hit] = approach(
            window, size, stands=stands, entered=came & ~went
        )
        words["ego_manoeuvre"][hit], words["partner_manoeuvre"][hit] = (
            manoeuvres.unbind(-1)
        )
        speeds[hit] = window[:, -1, :, 3].abs()
    return words | {"ego_speed": speeds[:, 0], "partner_speed": speeds[:, 1]}


def last_seconds(batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
    """States [C, W, P, 4] of the ego and its partner up to the step before the contact,
    the number [C] of steps back that both are known without a gap (at most W - 1;
    earlier states repeat the first known one), and sizes [C, P, 2].
    """
    hit = batch["hit"]
    row = hit.nonzero()[:, 0]
    before = batch["before"][hit]
    partner = batch["partner"][hit]
    pair = torch.stack([torch.zeros_like(partner), partner], -1)
    step = before[:, None] + torch.arange(-WINDOW, 1, device=hit.device)
    present = batch["valid"][
        row[:, None, None], step.clamp(min=0)[..., None], pair[:, None]
    ].all(-1) & (step >= 0)
    known = (present.flip(1).long().cumprod(1).sum(1) - 1).clamp(min=0)
    step = torch.maximum(step, (before - known)[:, None])
    return (
        batch["states"][row[:, None, None], step[..., None], pair[:, None]],
        known,
        batch["size"][row[:, None], pair],
    )


def manoeuvre(window: Tensor, known: Tensor, lanes: Tensor) -> Tensor:
    """Index [C, P] into MANOEUVRES of vehicles in window [C, W, P, 4], known [C] steps
    back, along lanes [C, W, P] [rad].

    A vehicle that never moves stands. Else a turn decides, then motion across the lane
    (unless the vehicle turns the other way: it follows a bend, not exactly), then the
    last second's mean acceleration.
    """
    speed = window[..., 3].abs()
    heading = window[..., 2]
    turn = wrap(heading[:, 1:] - heading[:, :-1]).sum(1)
    across = (speed * DT * (travel_heading(window) - lanes).sin())[:, 1:]
    steps = torch.arange(1, WINDOW + 1, device=window.device)
    across = (across * (steps > WINDOW - known[:, None])[..., None]).sum(1) / (
        known.clamp(min=1)[:, None] * DT
    )
    across = across.masked_fill((across * turn < 0) & (turn.abs() > TURNING / 2), 0.0)
    seconds = known.clamp(1, LATE)[:, None] * DT
    gain = (speed[:, -1] - speed[:, -1 - LATE]) / seconds
    result = torch.full_like(turn, KEEPS, dtype=torch.int64)
    result = result.masked_fill(gain > SPEEDING, ACCELERATES).masked_fill(
        gain < -SPEEDING, BRAKES
    )
    for change, least, left in ((across, SIDEWAYS, VEERS), (turn, TURNING, TURNS)):
        result = result.masked_fill(change > least, left).masked_fill(
            change < -least, left + 1
        )
    return result.masked_fill(speed.amax(1) < STANDING, STANDS)


def approach(window: Tensor, size: Tensor, stands: Tensor, entered: Tensor) -> Tensor:
    """Index [C] into APPROACHES, from window [C, W, P, 4] and sizes [C, P, 2]; stands
    [C]: the partner does; entered [C]: it is the ego that moved sideways into its
    partner, which then does not cut in.

    Headings are compared two seconds before the contact, positions one second before
    it. Vehicles run in the same direction where their headings agree, or where one is
    on the other's way and agrees with it there (a bend). Of such a partner ahead, one
    that was off the ego's way within the two seconds cuts in. A partner that stands is
    ahead, beside or behind, whatever its heading.
    """
    early = 0
    late = -1 - LATE
    way = travel_heading(window)
    relative = wrap(way[:, early, 1] - way[:, early, 0])
    ego = window[:, :, 0]
    other = window[:, :, 1]
    (first, follows, side), (second, _, later_side) = (
        on_way(ego, other, size=size, step=step) for step in (early, late)
    )
    _, followed, _ = on_way(other, ego, size=size.flip(1), step=early)
    facing = torch.stack([*ego[:, late, :2].unbind(-1), way[:, late, 0]], -1)
    place = to_frame(other[:, late, :2], facing)
    angle = way[:, late, 1] - way[:, late, 0]
    reach = (
        size[:, 0, 0]
        + size[:, 1, 0] * angle.cos().abs()
        + size[:, 1, 1] * angle.sin().abs()
    ) / 2
    same = (relative.abs() < ALIGNED) | follows | followed | stands
    enters = ~(first & second) & ~stands & ~entered
    from_right = torch.where(first, later_side, side) < 0
    ahead = torch.where(enters, CUT_IN + from_right.long(), AHEAD)
    beside = BESIDE + (place[:, 1] < 0).long()
    along = torch.where(
        place[:, 0] > reach, ahead, torch.where(place[:, 0] < -reach, BEHIND, beside)
    )
    across = torch.where(
        relative.abs() > torch.pi - ALIGNED, ONCOMING, CROSSING + (relative > 0).long()
    )
    return torch.where(same, along, across)


def on_way(
    ego: Tensor, other: Tensor, size: Tensor, step: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Whether the other [C, W, 4] touches, at a step of the window, the way of the ego
    [C, W, 4] from that step on (its boxes, then a straight strip); whether it also runs
    along the way there; and how far to the left of the way it is [m]. Each [C]. size
    [C, 2, 2]: of the ego and the other."""
    way = ego[:, step:]
    other = other[:, step]
    boxes, sizes = ego_path_boxes(way, size[:, 0])
    touches = (
        separation(other[:, None], size[:, None, 1], second=boxes, second_size=sizes)
        <= 0
    ).any(-1)
    nearest = (way[..., :2] - other[:, None, :2]).norm(dim=-1).argmin(-1)
    pose = way[torch.arange(len(way), device=way.device), nearest]
    pose = torch.cat([pose[:, :2], travel_heading(pose)[:, None]], -1)
    runs_along = wrap(travel_heading(other) - pose[:, 2]).abs() < ALIGNED
    return touches, touches & runs_along, to_frame(other[:, :2], pose)[:, 1]
