"""The ego's distance to others, acceleration, progress and fraction of the recorded
path until its first contact (docs/reference/metrics.md).

Vehicles that stand at the start: parked ones should stay, some of those on a lane
should start.
"""

from functools import partial

import torch
from torch import Tensor

from e2rl.metrics.catalogue import Batch, Metric, columns, rate
from e2rl.metrics.contact import steps_until
from e2rl.metrics.geometry import velocity
from e2rl.scenes.boxes import distance
from e2rl.scenes.recording import DT
from e2rl.scenes.route import WINDOW
from e2rl.sim.dynamics import closest_approach_cost, wrap

SMOOTHING = 0.5  # s, moving average of the ego's speed before its derivative
LEAST_WAY = 1.0  # m: of a shorter recorded way no fraction is known
STANDING = 0.5  # m/s at the start frame
MOVED = 2.0  # m from the start position
per_km = partial(
    Metric,
    unit="1/km",
    per="driven_km",
    tables="egos",
)


@columns(
    Metric(
        "min_dtc",
        "smallest gap to another agent",
        unit="m",
        tables="main methods",
    ),
    Metric(
        "ttc_c",
        "time-to-collision cost, adversaries",
        tables="main adversaries methods",
    ),
    Metric("ttc_c_all", "time-to-collision cost, all agents"),
    Metric(
        "macc",
        "ego's mean |acceleration|",
        unit="m/s²",
        tables="main egos public",
    ),
    Metric(
        "progress",
        "distance that the ego drives",
        unit="m",
        raised=0.0,
        tables="main egos public",
    ),
    rate(
        "route_completion",
        "fraction of the recorded ego's path driven until contact",
        tables="public",
    ),
    per_km(
        "failures_per_km",
        "`cfr`, of all that the ego drives",
        column="cfr",
    ),
    per_km(
        "counted_per_km",
        "the same of `cfr_counted`",
        column="cfr_counted",
    ),
)
def motion_columns(batch: Batch) -> Batch:
    """min_dtc, ttc_c, ttc_c_all, macc, progress, driven_km and route_completion over
    the steps 1..stop; NaN without any agent to measure them on."""
    states = batch["states"]
    valid = batch["valid"]
    stop = batch["stop"]
    counted = valid & valid[..., :1] & steps_until(stop, states.shape[1])[..., None]
    counted[..., 0] = False
    gap = distance(
        states[:, :, :1],
        batch["size"][:, None, :1],
        second=states,
        second_size=batch["size"][:, None],
    )
    gap = gap.masked_fill(~counted, torch.inf).flatten(1).amin(-1)
    moving = velocity(states)
    cost = closest_approach_cost(
        states[..., :2] - states[..., :1, :2], moving - moving[..., :1, :]
    )
    path, count = ego_path(
        states,
        valid,
        stop=stop,
    )
    driven = progress(path, count)
    return {
        "min_dtc": gap.masked_fill(gap.isinf(), torch.nan).masked_fill(
            batch["hit"], 0.0
        ),
        "ttc_c": mean_worst_cost(cost, counted & batch["adversaries"][:, None]),
        "ttc_c_all": mean_worst_cost(cost, counted),
        "macc": mean_acceleration(path, count),
        "progress": driven,
        "driven_km": driven / 1000,
        "route_completion": route_completion(
            path,
            count,
            logged=batch["logged"],
            logged_valid=batch["logged_valid"],
        ),
    }


def mean_worst_cost(cost: Tensor, counted: Tensor) -> Tensor:
    """Mean [B] of each step's largest counted cost [B, T+1, N] over the steps that have
    one; NaN where none has."""
    any_counted = counted.any(-1)
    worst = (cost * counted).amax(-1)
    return (worst * any_counted).sum(-1) / any_counted.sum(-1)  # 0 / 0 is NaN


def ego_path(states: Tensor, valid: Tensor, stop: Tensor) -> tuple[Tensor, Tensor]:
    """The ego's valid states at steps 0..stop moved to the front [B, T+1, 4], and their
    number [B]."""
    steps = torch.arange(states.shape[1], device=states.device)
    counted = valid[..., 0] & (steps <= stop[:, None])
    order = (~counted).byte().argsort(dim=-1, stable=True)
    return states[:, :, 0].gather(1, order[..., None].expand(-1, -1, 4)), counted.sum(
        -1
    )


def mean_acceleration(path: Tensor, count: Tensor) -> Tensor:
    """Mean |central difference| [B] [m/s2] of the speed's moving average over full
    windows of SMOOTHING seconds.

    path [B, T+1, 4] of `count` [B] states; NaN where it is shorter than a window and
    two steps.
    """
    window = round(SMOOTHING / DT)
    if path.shape[1] < window + 2:
        return torch.full_like(path[:, 0, 0], torch.nan)
    smooth = path[..., 3].unfold(1, window, 1).mean(-1)
    change = (smooth[:, 2:] - smooth[:, :-2]).abs() / (2 * DT)
    number = (count - window - 1).clamp(min=0)
    counted = torch.arange(change.shape[1], device=path.device) < number[:, None]
    return (change * counted).sum(-1) / number


def progress(path: Tensor, count: Tensor) -> Tensor:
    """Distance [B] [m] driven along the ego's own heading, each step along the mean of
    its two headings.

    path [B, T+1, 4] of `count` [B] states; driving backwards counts negative.
    """
    step = path[:, 1:] - path[:, :-1]
    heading = path[:, :-1, 2] + wrap(step[..., 2]) / 2
    driven = step[..., 0] * heading.cos() + step[..., 1] * heading.sin()
    counted = torch.arange(driven.shape[1], device=path.device) < (count - 1)[:, None]
    return (driven * counted).sum(-1)


def route_completion(
    path: Tensor,
    count: Tensor,
    logged: Tensor,
    logged_valid: Tensor,
) -> Tensor:
    """Fraction [B] in [0, 1] of the recorded ego's path that lies behind the ego at the
    end of its path.

    The ego is projected onto the nearest piece of the recorded way,
    as MetaDrive does. Where that jumps, as at a crossing of the way with itself, it is
    followed from the start on instead. NaN where the ego is in no step, or where the
    recorded way is shorter than LEAST_WAY.

    Args:
        path: [B, T+1, 4].
        count: [B], states of the path.
        logged: [B, T+1, N, 4], the recording.
        logged_valid: [B, T+1, N] bool.
    """
    steps = torch.full_like(count, logged.shape[1] - 1)
    recorded, has_path = ego_path(
        logged,
        logged_valid,
        stop=steps,
    )
    piece = (
        torch.arange(recorded.shape[1] - 1, device=path.device)
        < (has_path - 1)[:, None]
    )
    length = recorded[..., :2].diff(dim=1).norm(dim=-1) * piece
    end = length.cumsum(-1)
    place = _place_on(
        path[..., :2],
        count,
        way=recorded[..., :2],
        piece=piece,
        ends=torch.stack([end - length, end], -1),
    )
    whole = length.sum(-1)
    return (
        (place / whole)
        .clamp(max=1)
        .masked_fill((count == 0) | (whole < LEAST_WAY), torch.nan)
    )


def _place_on(
    points: Tensor,
    count: Tensor,
    way: Tensor,
    piece: Tensor,
    ends: Tensor,
) -> Tensor:
    """Metres [B] along ways [B, P, 2] at which the last of `count` [B] points [B, T, 2]
    is.

    piece [B, P-1]: which pieces are part of the way; ends [B, P-1, 2] m: along it,
    where they begin and end.
    """
    start = way[:, None, :-1]
    along = (way[:, 1:] - way[:, :-1])[:, None]
    offset = points[:, :, None] - start
    fraction = (
        (offset * along).sum(-1) / along.square().sum(-1).clamp(min=1e-12)
    ).clamp(0, 1)
    gap = (
        (offset - fraction[..., None] * along)
        .norm(dim=-1)
        .masked_fill(~piece[:, None], torch.inf)
    )
    place = ends[:, None, :, 0] + fraction * (ends[..., 1] - ends[..., 0])[:, None]
    nearest = place.gather(2, gap.argmin(-1, keepdim=True))[..., 0]

    moved = torch.nn.functional.pad(points.diff(dim=1).norm(dim=-1), (1, 0))
    inside = torch.arange(points.shape[1], device=points.device) < count[:, None]
    before = torch.nn.functional.pad(nearest[:, :-1], (1, 0))
    rows = (
        ((((nearest - before).abs() - moved) > WINDOW) & inside).any(1).nonzero()[:, 0]
    )
    if len(rows):
        nearest[rows] = _followed(
            place[rows],
            gap[rows],
            ends=ends[rows],
            moved=moved[rows],
        )
    return nearest.gather(1, (count - 1).clamp(min=0)[:, None])[:, 0]


def _followed(place: Tensor, gap: Tensor, ends: Tensor, moved: Tensor) -> Tensor:
    """Metres [R, T] along ways at which points are, one after another from the ways'
    starts on.

    place, gap [R, T, P]: of each point on each piece, metres along the way and beside
    it; ends [R, P, 2]: metres at which the pieces begin and end; moved [R, T] m since
    the point before.
    """
    places = [torch.zeros_like(moved[:, 0])]
    for step in range(moved.shape[1]):
        hint = (places[-1] + moved[:, step])[:, None]
        far = (ends[..., 1] < hint - WINDOW) | (ends[..., 0] > hint + WINDOW)
        index = gap[:, step].masked_fill(far, torch.inf).argmin(1, keepdim=True)
        places.append(place[:, step].gather(1, index)[:, 0])
    return torch.stack(places[1:], 1)


def moved(states: Tensor, valid: Tensor) -> Tensor:
    """Bool [B, N]: at some valid step [B, T+1, N] farther than MOVED from its position
    at step 0."""
    distance = (states[..., :2] - states[:, :1, :, :2]).norm(dim=-1)
    return ((distance > MOVED) & valid).any(1)


@columns(
    rate(
        "parked_moved",
        "parked vehicles that move > 2 m",
        weight="parked_vehicles",
        tables="traffic",
    ),
    rate(
        "starts",
        "standing vehicles that start, over the log's",
        column="starters",
        per="starters_log",
        tables="traffic",
    ),
    events=("parked_vehicles", "starters_log"),
)
def standing_columns(batch: Batch) -> Batch:
    """parked_moved, starters and what they rest on, each [B], of `traffic` vehicles
    recorded throughout.

    parked_moved: fraction of the parked_vehicles that move. starters: vehicles slower
    than STANDING at the start, not parked, that move; starters_log: those that move in
    the log. Unlike safety metrics these look at the whole rollout. Nothing is known
    without `parked`, which rollouts read from files lack.
    """
    if "parked" not in batch:
        return {}
    states = batch["states"]
    counted = batch["traffic"] & batch["logged_valid"].all(1)
    parked = counted & batch["parked"]
    standing = counted & ~batch["parked"] & (states[:, 0, :, 3].abs() < STANDING)
    motion = moved(states, batch["valid"])
    log = moved(batch["logged"], batch["logged_valid"])
    found = {
        "parked_moved": (parked & motion).sum(-1) / parked.sum(-1),
        "parked_vehicles": parked.sum(-1),
        "starters": (standing & motion).sum(-1),
        "starters_log": (standing & log).sum(-1),
    }
    return {name: value.to(states.dtype) for name, value in found.items()}
