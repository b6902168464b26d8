"""The verdict on every collision of the ego: whose fault, preventable by whom, which duty broken (docs/verdicts.md).

A collision counts if it is the ego's fault or a careful and competent driver in its place would have prevented it.

The partner broke the first of these duties that applies: it ran into the ego from behind; it had crossed a stop line at
red; it drove against its lane; it crossed the ego's way, or came into it, leaving less than a careful and competent
driver needs to brake.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.metrics.catalogue import Batch, Metric, declare
from e2rl.metrics.contact import REAR
from e2rl.metrics.drivers import DRIVERS, HumanDriver
from e2rl.metrics.fault import at_fault
from e2rl.metrics.preventable import Collision, Tracks, along_way, driven_length, held, preventions
from e2rl.scenes.lane_graph import against_lanes
from e2rl.scenes.recording import DT, VEHICLE

DUTIES = ("none", "rear-end", "light", "wrong way", "right of way", "entry")
NONE, REAR_END, LIGHT, WRONG_WAY, RIGHT_OF_WAY, ENTRY = range(6)
LIGHT_STEPS = round(5.0 / DT)  # before the contact in which a red light counts
WRONG_STEPS = round(1.0 / DT)  # before the contact of which half must be against the lanes
SAME_WAY = torch.pi / 6  # rad between headings below which a vehicle enters the way rather than crosses it
TURN = torch.pi / 7  # rad of heading within the last four seconds that make a turn
TURN_STEPS = round(4.0 / DT)


class Lanes(NamedTuple):
    """The map's centrelines: points [B, M, 2], lane [B, M]: which one a point is of (-1: padding)."""

    points: Tensor
    lane: Tensor


def duties(collision: Collision, rear: Tensor, red: Tensor, lanes: Lanes) -> Tensor:
    """Index [B] into DUTIES of collisions [B].

    rear [B] bool: the ego is hit at its rear; red [B] int64: step at which the partner last crossed a stop line at red,
    -1 for never.
    """
    row = torch.arange(len(rear), device=rear.device)
    pair = torch.stack([torch.zeros_like(collision.partner), collision.partner], 1)
    states = held(collision.states, collision.present)[row[:, None], :, pair]  # [B, 2, T+1, 4]
    size = collision.size[row[:, None], pair]
    ego, other = states.unbind(1)
    stop = collision.stop
    before = (stop - 1).clamp(min=0)
    turned = torch.stack([_turn(track, stop) for track in (ego, other)])
    angle = _wrap(other[row, before, 2] - ego[row, before, 2])
    gap, closing, entered = _entry(ego, other, size, stop)
    unsafe = entered & (gap < HumanDriver().stopping_gap(closing).clamp(min=0.0))
    crosses = angle.abs() > SAME_WAY
    priority = torch.where(turned[0] == turned[1], _from_left(ego, other, row, before), turned[1] & ~turned[0])
    result = torch.full_like(stop, NONE)
    result = torch.where(unsafe & ~crosses, ENTRY, result)
    result = torch.where(unsafe & crosses & priority, RIGHT_OF_WAY, result)
    result = torch.where(_against(other, stop, lanes), WRONG_WAY, result)
    result = torch.where((red >= 0) & (stop - red <= LIGHT_STEPS) & (red <= stop), LIGHT, result)
    faster = other[row, before, 3] * angle.cos() > ego[row, before, 3]
    return torch.where(rear & (angle.abs() < torch.pi / 3) & faster, REAR_END, result)


def _wrap(angle: Tensor) -> Tensor:
    return torch.remainder(angle + torch.pi, 2 * torch.pi) - torch.pi


def _turn(track: Tensor, stop: Tensor) -> Tensor:
    """Bool [B]: the vehicle at track [B, T+1, 4] turns by more than TURN in the TURN_STEPS before stop [B]."""
    steps = torch.arange(track.shape[1] - 1, device=stop.device)
    counted = (steps < stop[:, None]) & (steps >= stop[:, None] - TURN_STEPS)
    return (_wrap(track[..., 2].diff(dim=1)) * counted).sum(1).abs() > TURN


def _from_left(ego: Tensor, other: Tensor, row: Tensor, step: Tensor) -> Tensor:
    """Bool [B]: the other comes from the ego's left, so that it gives way where nothing else decides."""
    return _wrap(other[row, step, 2] - ego[row, step, 2]) < 0


def _entry(ego: Tensor, other: Tensor, size: Tensor, stop: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Gap [B] m along the ego's way and closing speed [B] m/s when the other last came into it, and whether it did."""
    tracks = Tracks(other[:, :, None], size[:, 1:], torch.ones_like(other[..., :1], dtype=torch.bool))
    along = along_way(ego, size[:, 0, 1], tracks)
    outside = along.lateral_gap[..., 0].T > 0
    steps = torch.arange(ego.shape[1], device=stop.device)
    last = torch.where(outside & (steps <= stop[:, None]), steps, -1).amax(1)
    entered = (last >= 0) & (last < stop)
    step, row = (last + 1).clamp(max=ego.shape[1] - 1), torch.arange(len(stop), device=stop.device)
    gap = along.rear[step, row, 0] - driven_length(ego)[row, step] - size[:, 0, 0] / 2
    return gap, ego[row, step, 3] - along.speed[step, row, 0], entered | (last == stop)


def _against(track: Tensor, stop: Tensor, lanes: Lanes) -> Tensor:
    """Bool [B]: in half of the WRONG_STEPS before stop [B] every lane that the vehicle is on runs against it."""
    row = torch.arange(len(stop), device=stop.device)[:, None]
    window = (stop[:, None] - torch.arange(1, WRONG_STEPS + 1, device=stop.device)).clamp(min=0)
    states = track[row, window]
    against = against_lanes(lanes.points, lanes.lane, states[..., :2], states[..., 2, None])[..., 0]
    return against.float().mean(-1) >= 0.5


declare(
    Metric(
        "cfr_counted",
        "a failure that counts: preventable, or the ego's fault",
        fraction=True,
        tables=("main", "adversaries", "methods", "egos", "public"),
    ),
    Metric(
        "cfr_preventable",
        "a failure that a competent driver prevents",
        fraction=True,
        tables=("main", "adversaries", "methods", "egos", "public"),
    ),
    Metric("counted", "collisions that count", fraction=True, per_collision=True, tables=("main", "adversaries")),
    Metric(
        "at_fault",
        "ego's fault, per collision",
        fraction=True,
        per_collision=True,
        tables=("main", "adversaries", "methods", "egos", "public"),
    ),
    Metric(
        "preventable",
        "prevented by UN R157's careful and competent driver",
        fraction=True,
        per_collision=True,
        tables=("main", "adversaries", "methods", "egos"),
    ),
    Metric("preventable_fsm", "prevented by the fuzzy safety model", fraction=True, per_collision=True),
    Metric("preventable_rss", "prevented by RSS", fraction=True, per_collision=True),
    Metric("preventable_regulation", "prevented at UN R157's limit", fraction=True, per_collision=True),
    Metric("preventable_chain", "prevented if a follower brakes, too", fraction=True, per_collision=True),
    events=("duty",),
    words={"duty": DUTIES},
)
COLUMNS = ("preventable", *(f"preventable_{name}" for name in DRIVERS if name != "human"), "preventable_chain")


def judge(batch: Batch) -> tuple[Batch, Tensor]:
    """The verdicts on B rollouts, and the way of the driver that they rest on.

    Returns:
        columns: [B] each, NaN where unknown. Of each collision: at_fault, preventable (by the human driver) and
            preventable_<model>, counted (0 or 1), preventable_chain (a follower's braking was needed for it), duty
            (index into DUTIES, -1 without a collision). Of each rollout: cfr_counted, cfr_preventable.
        driver: states [B, T+1, 4] of the human driver in the ego's place, NaN without a collision.
    """
    hit, fault = batch["hit"], at_fault(batch)
    found = {name: torch.full_like(fault, torch.nan) for name in COLUMNS}
    duty, driver = torch.full_like(batch["stop"], -1), torch.full_like(batch["states"][:, :, 0], torch.nan)
    if hit.any():
        of_hits, duty[hit], driver[hit] = collision_verdicts(batch, hit)
        for name, value in of_hits.items():
            found[name][hit] = value
    counted = torch.maximum(fault, found["preventable"])
    known = torch.zeros_like(fault).masked_fill(batch["start_overlap"], torch.nan)
    rates = {"cfr_counted": counted, "cfr_preventable": found["preventable"]}
    rates = {name: torch.where(hit, value, known) for name, value in rates.items()}
    return found | rates | {"at_fault": fault, "counted": counted, "duty": duty}, driver


def collision_verdicts(batch: Batch, hit: Tensor) -> tuple[Batch, Tensor, Tensor]:
    """COLUMNS, duty and driver's states [C, T+1, 4] of the C collisions hit [B] bool."""
    vehicles = (batch["valid"] & (batch["agent_type"] == VEHICLE)[:, None])[hit]
    collision = Collision(batch["states"][hit], vehicles, batch["size"][hit], batch["partner"][hit], batch["stop"][hit])
    row, ran = torch.arange(len(collision.stop)), batch.get("ran_light")
    red = torch.full_like(collision.stop, -1) if ran is None else ran[hit][row, collision.partner]
    lanes = Lanes(batch["lane_points"][hit], batch["lane_index"][hit])
    duty = duties(collision, batch["kind"][hit] == REAR, red, lanes)
    result = preventions(collision)
    dtype = batch["states"].dtype
    found = {f"preventable_{name}": value.avoided.to(dtype) for name, value in result.items()}
    human = result["human"]
    found["preventable"] = found.pop("preventable_human")
    found["preventable_chain"] = (human.avoided & (human.followers > 0)).to(dtype)
    return found, duty, human.states
