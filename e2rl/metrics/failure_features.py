"""What happens in a collision of the ego: from where the partner comes, and what both
do (docs/reference/metrics.md).

Everything is read from the last two seconds before the contact, relative to the two
vehicles and the lanes, so moving or turning the world changes nothing and mirroring it
swaps left and right. Shapes: C collisions, W = 21 steps of the last two seconds, P = 2
vehicles (ego, partner).
"""

import math

import torch
from torch import Tensor

from e2rl.metrics.catalogue import Batch, columns
from e2rl.metrics.collisions import EGO, PARTNER
from e2rl.metrics.fault import path_boxes
from e2rl.metrics.geometry import travel_heading
from e2rl.metrics.sideways import ALIGNED, lane_headings
from e2rl.scenes.boxes import separation, to_frame
from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import wrap

APPROACHES = (  # where the partner comes from
    "ahead",
    "cut-in from the left",
    "cut-in from the right",
    "beside on the left",
    "beside on the right",
    "from behind",
    "crossing from the left",
    "crossing from the right",
    "oncoming",
)
AHEAD, CUT_IN, BESIDE, BEHIND, CROSSING, ONCOMING = (
    APPROACHES.index(word)
    for word in (
        "ahead",
        "cut-in from the left",
        "beside on the left",
        "from behind",
        "crossing from the left",
        "oncoming",
    )
)
MANOEUVRES = (  # what a vehicle does
    "stands",
    "keeps speed",
    "brakes",
    "accelerates",
    "turns left",
    "turns right",
    "veers left",
    "veers right",
)
STANDS, KEEPS, BRAKES, ACCELERATES, TURNS_LEFT, _, VEERS_LEFT, _ = range(8)
WINDOW = round(2 / DT)  # steps before contact in which headings and paths are compared
LATE = round(1 / DT)  # steps before contact at which positions and speeds are compared
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
    collisions = batch["collisions"]
    window, known = collisions.window(collisions.before, WINDOW)
    lanes = lane_headings(
        collisions,
        window,
        every=LANE_EVERY,
    )
    manoeuvres = manoeuvre(
        window,
        known,
        lanes=lanes,
    )
    ego_moved, partner_moved = batch["moved_into"].unbind(1)
    words = {
        "approach": approach(
            window,
            collisions.size,
            stands=manoeuvres[:, PARTNER] == STANDS,
            ego_enters=ego_moved & ~partner_moved,
        ),
        "ego_manoeuvre": manoeuvres[:, EGO],
        "partner_manoeuvre": manoeuvres[:, PARTNER],
    }
    speed = window[:, -1, :, 3].abs()
    return {name: collisions.column(word, -1) for name, word in words.items()} | {
        "ego_speed": collisions.column(speed[:, EGO], torch.nan),
        "partner_speed": collisions.column(speed[:, PARTNER], torch.nan),
    }


def manoeuvre(window: Tensor, known: Tensor, lanes: Tensor) -> Tensor:
    """Index [C, P] into MANOEUVRES of vehicles in window [C, W, P, 4], known [C] steps
    back, along lanes [C, W, P] [rad].

    A vehicle that never moves stands. Else a turn decides, then motion across the lane
    (unless the vehicle turns the other way: it follows a bend, not exactly), then the
    last second's mean acceleration.
    """
    speed = window[..., 3].abs()
    turn = wrap(window[..., 2].diff(dim=1)).sum(1)
    across = (speed * DT * (travel_heading(window) - lanes).sin())[:, 1:]
    is_known = torch.arange(1, WINDOW + 1) > WINDOW - known[:, None]
    seconds = known.clamp(min=1)[:, None] * DT
    across = (across * is_known[..., None]).sum(1) / seconds
    follows_bend = (across * turn < 0) & (turn.abs() > TURNING / 2)
    across = across.masked_fill(follows_bend, 0.0)
    late_seconds = known.clamp(1, LATE)[:, None] * DT
    acceleration = (speed[:, -1] - speed[:, -1 - LATE]) / late_seconds
    result = torch.full_like(
        turn,
        KEEPS,
        dtype=torch.int64,
    )
    result[acceleration > SPEEDING] = ACCELERATES
    result[acceleration < -SPEEDING] = BRAKES
    for change, threshold, left in (
        (across, SIDEWAYS, VEERS_LEFT),
        (turn, TURNING, TURNS_LEFT),
    ):
        result[change > threshold] = left
        result[change < -threshold] = left + 1
    result[speed.amax(1) < STANDING] = STANDS
    return result


def approach(
    window: Tensor,
    size: Tensor,
    *,
    stands: Tensor,
    ego_enters: Tensor,
) -> Tensor:
    """Index [C] into APPROACHES.

    Headings are compared two seconds before the contact, positions one second before
    it. Vehicles run in the same direction where their headings agree, or where one is
    on the other's path and agrees with it there (a bend). Of such a partner ahead, one
    that was off the ego's path within the two seconds cuts in. A partner that stands is
    ahead, beside or behind, whatever its heading.

    Args:
        window: states [C, W, P, 4].
        size: [C, P, 2].
        stands: [C] bool, the partner does.
        ego_enters: [C] bool, it is the ego that moved sideways into its partner, which
            then does not cut in.
    """
    late = -1 - LATE
    heading = travel_heading(window)
    relative = wrap(heading[:, 0, PARTNER] - heading[:, 0, EGO])
    on_path, follows, offset = place_on_path(
        window,
        size,
        step=0,
    )
    on_path_late, _, late_offset = place_on_path(
        window,
        size,
        step=late,
    )
    _, is_followed, _ = place_on_path(
        window.flip(2),
        size.flip(1),
        step=0,
    )
    same_direction = (relative.abs() < ALIGNED) | follows | is_followed | stands

    ego_pose = torch.cat([window[:, late, EGO, :2], heading[:, late, EGO, None]], -1)
    place = to_frame(window[:, late, PARTNER, :2], ego_pose)
    angle = heading[:, late, PARTNER] - heading[:, late, EGO]
    reach = (
        size[:, EGO, 0]
        + size[:, PARTNER, 0] * angle.cos().abs()
        + size[:, PARTNER, 1] * angle.sin().abs()
    ) / 2
    cuts_in = ~(on_path & on_path_late) & ~stands & ~ego_enters
    from_right = torch.where(on_path, late_offset, offset) < 0
    ahead = torch.where(cuts_in, CUT_IN + from_right.long(), AHEAD)
    beside = BESIDE + (place[:, 1] < 0).long()
    along = torch.where(place[:, 0] < -reach, BEHIND, beside)
    along = torch.where(place[:, 0] > reach, ahead, along)
    crossing = CROSSING + (relative > 0).long()
    opposite = relative.abs() > torch.pi - ALIGNED
    return torch.where(same_direction, along, torch.where(opposite, ONCOMING, crossing))


def place_on_path(
    window: Tensor,
    size: Tensor,
    step: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """Whether the second vehicle of window [C, W, 2, 4] touches, at a step, the path of
    the first from that step on (its boxes, then a straight strip); whether it also runs
    along the path there; and how far to the left of the path it is [m]. Each [C]; size
    [C, 2, 2]."""
    path = window[:, step:, 0]
    other = window[:, step, 1]
    boxes, sizes = path_boxes(path, size[:, 0])
    gap = separation(
        other[:, None],
        size[:, None, 1],
        second=boxes,
        second_size=sizes,
    )
    touches = (gap <= 0).any(-1)
    nearest = (path[..., :2] - other[:, None, :2]).norm(dim=-1).argmin(-1)
    pose = path[torch.arange(len(path)), nearest]
    pose = torch.cat([pose[:, :2], travel_heading(pose)[:, None]], -1)
    runs_along = wrap(travel_heading(other) - pose[:, 2]).abs() < ALIGNED
    return touches, touches & runs_along, to_frame(other[:, :2], pose)[:, 1]
