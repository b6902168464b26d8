"""nuPlan's closed-loop score of the ego in [0, 1] and its eight terms
(`experiment=nuplan`).

Definitions and thresholds are those of nuplan-devkit 1.2 (docs/results/nuplan-scores.md, which
tells what differs: lanes here are strips about centrelines, and intersections are where
strips overlap). Terms look at the whole rollout, on through contacts. They are NaN
where the ego overlaps a vehicle at the start or is absent at a step.
"""

import math
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize, pad

from e2rl.metrics.catalogue import Batch, rate
from e2rl.metrics.geometry import edge_parts_inside, velocity
from e2rl.metrics.off_road import (
    Points,
    Segments,
    has_map,
    inside_polygon,
    near_lane,
    near_segments,
)
from e2rl.metrics.proximity import ego_path, route_completion
from e2rl.scenes.boxes import angle_of, corners, overlap, to_frame, unit_vectors
from e2rl.scenes.recording import CYCLIST, DT, OTHER, PEDESTRIAN, VEHICLE
from e2rl.sim.dynamics import wrap

REAR_AXLE = 1.461 / 5.176  # of the length of nuPlan's vehicle, behind its centre
STOPPED = 0.05  # m/s: an ego or a track that is no faster stands at a collision
# Angles at the rear axle between the heading and another's centre.
AHEAD = math.radians(30)
BEHIND = math.radians(150)
ALLOWED = {  # at-fault collisions that leave a score above 0
    (PEDESTRIAN, CYCLIST): 0,
    (VEHICLE,): 0,
    (OTHER,): 1,
}
MAX_OUTSIDE = 0.3  # m that a corner may lie outside the drivable area
ENDS_MEET = 0.5  # m between the end of a lane and the start of one that follows it
AGAINST_TIME = 1.0  # s in which metres against the lane's direction are counted
AGAINST = 2.0  # m: score 0.5
FAR_AGAINST = 6.0  # m: score 0
LEAST_TTC = 0.95  # s
MOVING = 0.005  # m/s: an ego that is slower has no time to collision
MIN_PROGRESS = 0.2  # of the recorded distance
PROGRESS_FLOOR = 2.0  # m: shorter distances count as this; as far back is no progress
MAX_OVERSPEED = 2.23  # m/s above the limit, throughout the rollout: score 0
COMFORT = {  # bounds, which are excluded: m/s^2, rad/s, rad/s^2, m/s^3, m/s^3
    "longitudinal": (-4.05, 2.40),
    "yaw_rate": (-0.95, 0.95),
    "yaw_accel": (-1.93, 1.93),
    "longitudinal_jerk": (-4.13, 4.13),
    "jerk": (-8.37, 8.37),
}
WEIGHTS = {
    "time_to_collision_within_bound": 5,
    "ego_progress_along_expert_route": 5,
    "speed_limit_compliance": 4,
    "ego_is_comfortable": 2,
}
MULTIPLIERS = (
    "no_ego_at_fault_collisions",
    "drivable_area_compliance",
    "driving_direction_compliance",
    "ego_is_making_progress",
)
term = partial(rate, tables="nuplan")
SCORES = (
    term("nuplan_score", "nuPlan's closed-loop score"),
    term("no_ego_at_fault_collisions", "nuPlan: no collision at fault"),
    term("drivable_area_compliance", "nuPlan: no corner outside the drivable area"),
    term("driving_direction_compliance", "nuPlan: not against the lane's direction"),
    term("ego_is_making_progress", "nuPlan: a fifth of the recorded distance or more"),
    term(
        "time_to_collision_within_bound",
        "nuPlan: time to collision of 0.95 s or more throughout",
    ),
    term(
        "ego_progress_along_expert_route", "nuPlan: fraction of the recorded distance"
    ),
    term("speed_limit_compliance", "nuPlan: speeding, by how much and how long"),
    term("ego_is_comfortable", "nuPlan: acceleration, jerk and yaw within bounds"),
)


def nuplan_columns(batch: Batch) -> Batch:
    """The score, product of MULTIPLIERS times the mean of WEIGHTS, and its terms, each
    [B] in [0, 1]."""
    batch = batch | {"track_speed": track_speed(batch)}
    places = places_of(batch)
    contacts = contacts_of(batch, places)
    progress = expert_progress(batch)
    ego = batch["states"][:, :, 0]
    scores = {
        "no_ego_at_fault_collisions": collision_score(
            contacts.at_fault, batch["agent_type"]
        ),
        "drivable_area_compliance": drivable_area(batch),
        "driving_direction_compliance": driving_direction(batch),
        "ego_is_making_progress": (progress >= MIN_PROGRESS).to(progress),
        "time_to_collision_within_bound": time_to_collision(batch, places, contacts),
        "ego_progress_along_expert_route": progress,
        "speed_limit_compliance": speed_limit(batch),
        "ego_is_comfortable": comfort(ego, batch["size"][:, 0, 0]),
    }
    total = sum(weight * scores[name] for name, weight in WEIGHTS.items())
    mean = total / sum(WEIGHTS.values())
    multipliers = torch.stack([scores[name] for name in MULTIPLIERS])
    scores["nuplan_score"] = mean * multipliers.prod(0)
    unknown = batch["start_overlap"] | ~batch["valid"][..., 0].all(1)
    return {
        name: value.masked_fill(unknown, torch.nan) for name, value in scores.items()
    }


def track_speed(batch: Batch) -> Tensor:
    """The magnitude of the velocity [B, T+1, N] m/s as nuPlan has it: objects have
    none."""
    speed = batch["states"][..., 3].abs()
    return speed.masked_fill((batch["agent_type"] == OTHER)[:, None], 0.0)


class Places(NamedTuple):
    """Where the ego is at each step, bool [B, T+1]."""

    loose: Tensor  # its corners are not in one lane, or in lanes that follow each other
    crossing: Tensor  # its rear axle is in several lanes


def places_of(batch: Batch) -> Places:
    """Where the ego is among the lanes, strips of half their width about the
    centreline."""
    states = batch["states"][:, :, 0]
    size = batch["size"][:, None, 0]
    axle = rear_axle(states, size)[..., None, :]
    points = torch.cat([corners(states, size), axle], -2)  # [B, T+1, 5, 2]
    count = points[0, ..., 0].numel()
    point, lane, _ = lanes_at(points.flatten(1, 2), batch)
    # Of hundreds of lanes only the few that the ego touches.
    is_used = torch.zeros_like(batch["lane_width"], dtype=torch.bool)
    is_used[point // count, lane] = True
    most = max(1, int(is_used.sum(1).amax()))
    order = is_used.byte().argsort(
        dim=1,
        descending=True,
        stable=True,
    )
    lanes = order[:, :most]
    slot = (is_used.long().cumsum(1) - 1)[point // count, lane]
    width = lanes.shape[1]  # 0 where the map has no lane
    inside = states.new_zeros(len(states) * count, width)
    inside[point, slot] = 1.0
    inside = inside.view(*points.shape[:-1], width)
    together = connected(inside[..., :4, :], follows=linked(batch, lanes))
    return Places(loose=~together, crossing=inside[..., 4, :].sum(-1) > 1)


def connected(corners_inside: Tensor, follows: Tensor) -> Tensor:
    """Whether [B, T+1] the corners of the ego lie in one lane, or in lanes that follow
    each other as the ego drives.

    Some lane X is, or is followed by, a lane of each front corner, and is, or follows,
    a lane of each rear corner; and the rear corners' own lanes are one, or one follows
    the other.

    Args:
        corners_inside: [B, T+1, 4, M], 1 where a corner (front left, rear left, rear
            right, front right) is in a lane.
        follows: [B, M, M], 1 at [j, i] where lane j is lane i, or begins where lane i
            ends.
    """
    front_left, rear_left, rear_right, front_right = corners_inside.unbind(-2)
    after_left = rear_left @ follows.mT
    after_right = rear_right @ follows.mT
    front = (front_left @ follows) * (front_right @ follows)
    lane = (front * after_left * after_right).sum(-1) > 0
    rear = (after_left * rear_right + after_right * rear_left).sum(-1) > 0
    return lane & rear


def rear_axle(states: Tensor, size: Tensor) -> Tensor:
    """Position [..., 2] of the rear axle of vehicles at states [..., 4] of size [...,
    2]."""
    heading = unit_vectors(states[..., 2])
    return states[..., :2] - REAR_AXLE * size[..., :1] * heading


def lanes_at(points: Tensor, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
    """(point in B * K, lane, direction [., 2]) of all pairs of a point [B, K, 2] and a
    segment of a lane in whose strip it lies, between the lane's ends."""
    lanes = Segments.lanes(batch)
    rollout = torch.arange(len(points)).repeat_interleave(points.shape[1])
    points = points.flatten(0, 1)
    half_width = batch["lane_width"][lanes.rollout, lanes.line] / 2
    point, segment = near_segments(Points(points, rollout), lanes, half_width)
    start, end = lanes.ends[segment].unbind(1)
    direction = normalize(end - start, dim=-1)
    begins = torch.ones(len(lanes.line) + 1, dtype=torch.bool)  # a lane, or after all
    begins[1:-1] = (lanes.line.diff() != 0) | (lanes.rollout.diff() != 0)
    before_start = (direction * (points[point] - start)).sum(-1) < 0
    after_end = (direction * (points[point] - end)).sum(-1) > 0
    beyond = (begins[segment] & before_start) | (begins[segment + 1] & after_end)
    return point[~beyond], lanes.line[segment[~beyond]], direction[~beyond]


def linked(batch: Batch, lanes: Tensor) -> Tensor:
    """1 at [B, j, i] where lane j of lanes [B, M] is lane i, or begins where lane i
    ends, else 0."""
    index = batch["lane_index"]
    count = batch["lane_width"].shape[1]
    rows = torch.arange(len(index))[:, None]
    position = torch.arange(index.shape[1]).expand(index.shape)
    lane = index.masked_fill(index < 0, count)

    def end_points(reduce: str) -> Tensor:
        ends = torch.zeros(
            len(index),
            count + 1,
            dtype=torch.int64,
        )
        ends = ends.scatter_reduce(
            1,
            lane,
            position,
            reduce,
            include_self=False,
        )
        return batch["lane_points"][rows, ends.gather(1, lanes)]

    first = end_points("amin")
    follows = torch.cdist(first, end_points("amax")) < ENDS_MEET
    return (follows | torch.eye(lanes.shape[1], dtype=torch.bool)).to(first)


def angle_at(axle: Tensor, heading: Tensor, centre: Tensor) -> Tensor:
    """Angle [...] in [0, pi] at axle [..., 2] between the heading [...] and another's
    centre [..., 2]."""
    gap = centre - axle
    return wrap(angle_of(gap) - heading).abs()


class Contacts(NamedTuple):
    """Steps at which an agent first meets the ego, bool [B, T+1, N]."""

    at_fault: Tensor
    first: Tensor


def contacts_of(batch: Batch, places: Places) -> Contacts:
    """The ego is at fault if it moves and the other stands, as objects always do, if
    its front bumper meets the other, or if the other, not behind it, meets it beside
    while the ego is not in one lane."""
    touching = batch["area"] > 0
    first = touching & (touching.long().cumsum(1) == 1)
    index = first.nonzero(as_tuple=True)
    row, step, agent = index
    ego = batch["states"][row, step, 0]
    size = batch["size"][row, 0]
    other = batch["states"][index]
    angle = angle_at(
        rear_axle(ego, size),
        ego[:, 2],
        centre=other[:, :2],
    )
    parts = edge_parts_inside(
        ego,
        size,
        other=other,
        other_size=batch["size"][row, agent],
    )
    front = parts[:, 3] > 0
    moves = ego[:, 3].abs() > STOPPED
    stands = batch["track_speed"][index] <= STOPPED
    beside = (angle <= BEHIND) & (front | places.loose[row, step])
    at_fault = torch.zeros_like(first)
    at_fault[index] = moves & (stands | beside)
    return Contacts(at_fault, first)


def collision_score(at_fault: Tensor, agent_type: Tensor) -> Tensor:
    """Product [B] over kinds of agents of max(0, 1 - collisions / (allowed + 1));
    at_fault [B, T+1, N]."""
    score = torch.ones(len(at_fault), dtype=torch.float64)
    for kinds, allowed in ALLOWED.items():
        is_kind = torch.isin(agent_type, torch.tensor(kinds))[:, None]
        number = (at_fault & is_kind).sum((1, 2))
        score *= (1 - number / (allowed + 1)).clamp(min=0)
    return score


def drivable_area(batch: Batch) -> Tensor:
    """1 [B] where all corners stay within MAX_OUTSIDE of a lane's strip or a drivable
    polygon, else 0; NaN without a map."""
    states = batch["states"][:, :, 0]
    xy = corners(states, batch["size"][:, None, 0])
    rollout = torch.arange(len(states)).repeat_interleave(xy[0, ..., 0].numel())
    points = Points(xy.flatten(0, 2), rollout)
    polygons = Segments.polygons(batch)
    inside = near_lane(
        points,
        batch,
        margin=MAX_OUTSIDE,
    )
    others, index = points.outside(inside)
    inside[index] = inside_polygon(others, polygons)
    near_border, _ = near_segments(points, polygons, MAX_OUTSIDE)
    inside[near_border] = True
    result = inside.view(len(states), -1).all(1).to(states)
    return result.masked_fill(~has_map(batch), torch.nan)


def driving_direction(batch: Batch) -> Tensor:
    """1, 0.5 or 0 [B] as the ego's centre moves at most AGAINST, FAR_AGAINST or more
    metres against the direction of its lane within AGAINST_TIME; of several lanes the
    one that it follows best, and nothing outside all."""
    centre = batch["states"][:, :, 0, :2]
    moved = pad(centre.diff(dim=1), (0, 0, 1, 0)).flatten(0, 1)
    point, _, direction = lanes_at(centre, batch)
    along = (moved[point] * direction).sum(-1)
    best = moved.new_full((len(moved),), -torch.inf)
    best = best.scatter_reduce(0, point, along, "amax")
    driven = best.masked_fill(best.isinf(), 0.0).view(centre.shape[:2]).cumsum(1)
    steps = round(AGAINST_TIME / DT) + 1  # of the devkit's sums
    against = -(driven - pad(driven, (steps, 0))[:, :-steps]).amin(1)
    half = torch.where(against < FAR_AGAINST, 0.5, 0.0)
    return torch.where(against < AGAINST, 1.0, half).to(centre)


def time_to_collision(batch: Batch, places: Places, contacts: Contacts) -> Tensor:
    """1 [B] where nothing would be met within LEAST_TTC at constant velocities, from
    any step; else 0.

    Others count while they are ahead, or beside an ego that is not in one lane or on a
    crossing, until they meet it.
    """
    states = batch["states"]
    size = batch["size"]
    speed = batch["track_speed"]
    ego = states[:, :, :1]
    axle = rear_axle(ego, size[:, None, :1])
    angle = angle_at(
        axle,
        ego[..., 2],
        centre=states[..., :2],
    )
    beside = (places.loose | places.crossing)[..., None] & (angle <= BEHIND)
    met = contacts.first.cumsum(1) > 0
    counted = batch["valid"] & ~met & ((angle < AHEAD) | beside)
    counted &= speed[..., :1] > MOVING
    counted[..., 0] = False
    reach = (size[:, :1] + size).norm(dim=-1)[:, None]
    reach = reach + (speed[..., :1] + speed) * LEAST_TTC
    counted &= (states[..., :2] - ego[..., :2]).norm(dim=-1) < reach
    index = counted.nonzero(as_tuple=True)
    row, step, agent = index
    seconds = torch.arange(
        DT,
        LEAST_TTC,
        DT,
        dtype=states.dtype,
    )[:, None]  # [K, 1]
    touches = overlap(
        projected(
            states[row, step, 0],
            speed[row, step, 0],
            seconds=seconds,
        ),
        size[row, 0],
        second=projected(
            states[index],
            speed[index],
            seconds=seconds,
        ),
        second_size=size[row, agent],
    )
    meets = torch.zeros(len(states), dtype=torch.bool)
    meets[row[touches.any(0)]] = True
    return (~meets & ~contacts.at_fault.any((1, 2))).to(states)


def projected(states: Tensor, speed: Tensor, seconds: Tensor) -> Tensor:
    """States [K, Q, 4] of tracks [Q, 4] that go on along their heading with speed [Q]
    m/s for seconds [K, 1].

    nuPlan projects by the magnitude of the velocity, so one that reverses is projected
    forwards.
    """
    moving = torch.cat([states[:, :3], speed[:, None]], -1)
    place = moving[:, :2] + seconds[..., None] * velocity(moving)
    return torch.cat([place, moving[:, 2:].expand(len(seconds), -1, -1)], -1)


def expert_progress(batch: Batch) -> Tensor:
    """min(1, max(d, f) / max(r, f)) [B] of d m driven along the r m that the recorded
    ego drove, f = PROGRESS_FLOOR.

    0 where the ego ends more than f behind its start.
    """
    last = torch.full_like(batch["stop"], batch["states"].shape[1] - 1)
    path, count = ego_path(
        batch["states"],
        batch["valid"],
        stop=last,
    )
    recorded, recorded_count = ego_path(
        batch["logged"],
        batch["logged_valid"],
        stop=last,
    )
    fraction = route_completion(
        path,
        count,
        logged=batch["logged"],
        logged_valid=batch["logged_valid"],
    )
    pieces = torch.arange(1, recorded.shape[1]) < recorded_count[:, None]
    length = (recorded[:, 1:, :2] - recorded[:, :-1, :2]).norm(dim=-1)
    distance = length.mul(pieces).sum(-1)
    driven = fraction.nan_to_num(0.0) * distance
    ratio = driven.clamp(min=PROGRESS_FLOOR) / distance.clamp(min=PROGRESS_FLOOR)
    end = path[torch.arange(len(path)), (count - 1).clamp(min=0)]
    back = to_frame(end[:, :2], recorded[:, 0])[:, 0] < -PROGRESS_FLOOR
    return torch.where((driven == 0) & back, 0.0, ratio.clamp(max=1))


def speed_limit(batch: Batch) -> Tensor:
    """max(0, 1 - mean overspeed / MAX_OVERSPEED) [B]; steps without a known limit count
    as none. NaN where rollouts do not tell limits, as those read from files."""
    speed = batch["states"][:, :, 0, 3]
    if "speed_limit" not in batch:
        return torch.full_like(speed[:, 0], torch.nan)
    limit = batch["speed_limit"].to(speed)
    over = (speed - limit).clamp(min=0) * (limit > 0)
    return (1 - over.sum(1) / (speed.shape[1] - 1) / MAX_OVERSPEED).clamp(min=0)


def comfort(ego: Tensor, length: Tensor) -> Tensor:
    """1 [B] where the motion of ego [B, T+1, 4] of length [B] m stays within COMFORT,
    else 0.

    Accelerations are those of nuPlan's simulated ego. Its rear axle has a step's change
    of speed and none to the side, which makes the total; the centre, d ahead, has d
    (w^2 + dw/dt) more along the vehicle, at yaw rate w. Each is smoothed, then
    differentiated, by the devkit's Savitzky-Golay windows, and rounded as there.
    """
    turn = wrap(ego[..., 2].diff(dim=1))
    accel = held_back(ego[..., 3].diff(dim=1) / DT)
    yaw_rate = held_back(turn / DT)
    yaw_accel = pad(yaw_rate.diff(dim=1) / DT, (1, 0))
    centre = accel + REAR_AXLE * length[:, None] * (yaw_rate.square() + yaw_accel)
    heading = pad(turn.cumsum(1), (1, 0))
    longitudinal = smoothed(centre, window=8)
    total = smoothed(accel.abs(), window=8)
    motion = {
        "longitudinal": longitudinal,
        "yaw_rate": smoothed(
            heading,
            window=5,
            deriv=1,
        ),
        "yaw_accel": smoothed(
            heading,
            window=5,
            order=3,
            deriv=2,
        ),
        "longitudinal_jerk": smoothed(
            longitudinal,
            window=15,
            deriv=1,
        ),
        "jerk": smoothed(
            total,
            window=15,
            deriv=1,
        ),
    }
    within = [
        (low < motion[name]) & (motion[name] < high)
        for name, (low, high) in COMFORT.items()
    ]
    return torch.from_numpy(np.stack(within).all((0, 2))).to(ego)


def held_back(change: Tensor) -> Tensor:
    """Values [B, T+1] of steps [B, T]: that of the step before each state, and at the
    start that of the first step."""
    return torch.cat([change[:, :1], change], 1)


def smoothed(
    values: Tensor | np.ndarray, *, window: int, order: int = 2, deriv: int = 0
) -> np.ndarray:
    """A Savitzky-Golay filter, to eight decimals.

    Args:
        values: [B, T+1] at steps of DT.
        window: in steps.
        order: of its polynomials.
        deriv: which derivative.
    """
    from scipy.signal import savgol_filter  # loads all of scipy, for half a second

    values = np.asarray(values)
    length = min(window, values.shape[-1])
    return savgol_filter(
        values,
        length,
        order,
        deriv=deriv,
        delta=DT,
    ).round(8)
