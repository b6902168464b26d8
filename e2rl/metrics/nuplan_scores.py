"""nuPlan's closed-loop score of the ego in [0, 1] and its eight terms (`experiment=nuplan`).

Definitions and thresholds are those of nuplan-devkit 1.2 (docs/nuplan-scores.md, which tells what differs: lanes here
are strips about centrelines, and intersections are where strips overlap). Terms look at the whole rollout, on through
contacts. They are NaN where the ego overlaps a vehicle at the start or is absent at a step.
"""

import math
from functools import partial
from typing import NamedTuple

import torch
from scipy.signal import savgol_filter
from torch import Tensor

from e2rl.metrics.catalogue import Batch, rate
from e2rl.metrics.geometry import edge_parts_inside, velocity
from e2rl.metrics.off_road import has_lines, inside_polygon, line_segments, near_lane, near_segments
from e2rl.metrics.proximity import ego_path, route_completion
from e2rl.scenes.boxes import corners, overlap
from e2rl.scenes.recording import CYCLIST, DT, OTHER, PEDESTRIAN, VEHICLE
from e2rl.sim.dynamics import wrap

REAR_AXLE = 1.461 / 5.176  # of the length: nuPlan's vehicle, from its centre back to the rear axle
STOPPED_EGO, STOPPED = 0.05, 0.005  # m/s: slower egos and others stand
AHEAD, BEHIND = math.radians(20), math.radians(150)  # angle at the rear axle between heading and another's centre
ALLOWED = {(PEDESTRIAN, CYCLIST): 0, (VEHICLE,): 0, (OTHER,): 1}  # at-fault collisions that leave a score above 0
MAX_OUTSIDE = 0.3  # m that a corner may lie outside the drivable area
ENDS_MEET = 0.5  # m between the end of a lane and the start of one that follows it
WINDOW, AGAINST, FAR_AGAINST = 1.0, 2.0, 6.0  # s, and metres against the lane's direction in it: score 0.5, 0
LEAST_TTC = 0.95  # s
MOVING = 0.005  # m/s: an ego that is slower has no time to collision
MIN_PROGRESS = 0.2  # of the recorded way
MAX_OVERSPEED = 2.23  # m/s above the limit, throughout the rollout: score 0
COMFORT = {  # bounds: m/s^2, m/s^2, rad/s, rad/s^2, m/s^3, m/s^3
    "longitudinal": (-4.05, 2.40),
    "lateral": (-4.89, 4.89),
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
    term("ego_is_making_progress", "nuPlan: a fifth of the recorded way or more"),
    term("time_to_collision_within_bound", "nuPlan: time to collision of 0.95 s or more throughout"),
    term("ego_progress_along_expert_route", "nuPlan: fraction of the recorded way"),
    term("speed_limit_compliance", "nuPlan: speeding, by how much and how long"),
    term("ego_is_comfortable", "nuPlan: acceleration, jerk and yaw within bounds"),
)


def nuplan_columns(batch: Batch) -> Batch:
    """The score, product of MULTIPLIERS times the mean of WEIGHTS, and its terms, each [B] in [0, 1]."""
    places = places_of(batch)
    fault, new = at_fault(batch, places)
    progress = expert_progress(batch)
    found = {
        "no_ego_at_fault_collisions": collision_score(fault, batch["agent_type"]),
        "drivable_area_compliance": drivable_area(batch),
        "driving_direction_compliance": driving_direction(batch),
        "ego_is_making_progress": (progress > MIN_PROGRESS).to(progress),
        "time_to_collision_within_bound": time_to_collision(batch, places, fault, new),
        "ego_progress_along_expert_route": progress,
        "speed_limit_compliance": speed_limit(batch),
        "ego_is_comfortable": comfort(batch["states"][:, :, 0]),
    }
    mean = sum(weight * found[name] for name, weight in WEIGHTS.items()) / sum(WEIGHTS.values())
    found["nuplan_score"] = mean * torch.stack([found[name] for name in MULTIPLIERS]).prod(0)
    unknown = batch["start_overlap"] | ~batch["valid"][..., 0].all(1)
    return {name: value.masked_fill(unknown, torch.nan) for name, value in found.items()}


class Places(NamedTuple):
    """Of the ego at each step, bool [B, T+1]."""

    loose: Tensor  # its corners are not in one lane, or one and a next
    crossing: Tensor  # its rear axle is in several lanes


def places_of(batch: Batch) -> Places:
    """Where the ego is among the lanes, strips of half their width about the centreline."""
    states, size = batch["states"][:, :, 0], batch["size"][:, None, 0]
    points = torch.cat([corners(states, size), rear_axle(states, size)[..., None, :]], -2)  # [B, T+1, 5, 2]
    each = points[0, ..., 0].numel()
    point, lane, _ = lanes_at(points.flatten(1, 2), batch)
    used = torch.zeros_like(batch["lane_width"], dtype=torch.bool)
    used[point // each, lane] = True  # a few of hundreds
    chosen = used.byte().argsort(dim=1, descending=True, stable=True)[:, : max(1, int(used.sum(1).amax()))]
    slot = used.long().cumsum(1) - 1
    inside = states.new_zeros(len(states) * each, chosen.shape[1])
    inside[point, slot[point // each, lane]] = 1.0
    inside = inside.view(*points.shape[:-1], -1)  # [B, T+1, 5, M] of the chosen lanes
    within = (inside[..., :4, :].flatten(1, 2) @ linked(batch, chosen)).view(inside[..., :4, :].shape) > 0
    return Places(~within.all(2).any(-1), inside[..., 4, :].sum(-1) > 1)


def rear_axle(states: Tensor, size: Tensor) -> Tensor:
    """Position [..., 2] of the rear axle of vehicles at states [..., 4] of size [..., 2]."""
    heading = torch.stack([states[..., 2].cos(), states[..., 2].sin()], -1)
    return states[..., :2] - REAR_AXLE * size[..., :1] * heading


def lanes_at(points: Tensor, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
    """(point in B * K, lane, direction [., 2]) of all pairs of a point [B, K, 2] and a segment of a lane in whose strip
    it lies, between the lane's ends."""
    owner, lane, ends = line_segments(batch["lane_points"], batch["lane_index"])
    rollout = torch.arange(len(points)).repeat_interleave(points.shape[1])
    points = points.flatten(0, 1)
    point, near = near_segments(points, rollout, owner, ends, batch["lane_width"][owner, lane] / 2)
    along = torch.nn.functional.normalize(ends[near, 1] - ends[near, 0], dim=-1)
    begins = torch.ones(len(lane) + 1, dtype=torch.bool)  # the last row: after the end of the last lane
    begins[1:-1] = (lane.diff() != 0) | (owner.diff() != 0)
    before, after = ((along * (points[point] - ends[near, end])).sum(-1) for end in (0, 1))
    within = ~(begins[near] & (before < 0)) & ~(begins[near + 1] & (after > 0))
    return point[within], lane[near[within]], along[within]


def linked(batch: Batch, chosen: Tensor) -> Tensor:
    """1 at [B, j, i] where the chosen lane j [B, M] is lane i, or begins where lane i ends, else 0."""
    index, count = batch["lane_index"], batch["lane_width"].shape[1]
    at = torch.arange(index.shape[1]).expand(index.shape)
    slot = index.masked_fill(index < 0, count)
    ends = []
    for reduce in ("amin", "amax"):
        place = torch.zeros(len(index), count + 1, dtype=torch.int64)
        place = place.scatter_reduce(1, slot, at, reduce, include_self=False).gather(1, chosen)
        ends.append(batch["lane_points"].gather(1, place[..., None].expand(-1, -1, 2)))
    first, last = ends
    follows = torch.cdist(first, last) < ENDS_MEET
    return (follows | torch.eye(chosen.shape[1], dtype=torch.bool)).to(first)


def angle_at(axle: Tensor, heading: Tensor, centre: Tensor) -> Tensor:
    """Angle [...] in [0, pi] at axle [..., 2] between the heading [...] and another's centre [..., 2]."""
    gap = centre - axle
    return wrap(torch.atan2(gap[..., 1], gap[..., 0]) - heading).abs()


def at_fault(batch: Batch, places: Places) -> tuple[Tensor, Tensor]:
    """Bool [B, T+1, N] each: collisions at the ego's fault, and all, at the step at which an agent first meets the ego.

    The ego is at fault if it moves and the other stands, if its front bumper meets the other, or if the other, not
    behind it, meets it beside while the ego is not in one lane.
    """
    touching = batch["area"] > 0
    new = touching & (touching.long().cumsum(1) == 1)
    row, step, agent = new.nonzero(as_tuple=True)
    ego, other = batch["states"][row, step, 0], batch["states"][row, step, agent]
    size, other_size = batch["size"][row, 0], batch["size"][row, agent]
    behind = angle_at(rear_axle(ego, size), ego[:, 2], other[:, :2]) > BEHIND
    front = edge_parts_inside(ego, size, other, other_size)[:, 3] > 0
    moves, stands = ego[:, 3].abs() > STOPPED_EGO, other[:, 3].abs() <= STOPPED
    guilty = moves & (stands | (~behind & (front | places.loose[row, step])))
    fault = torch.zeros_like(new)
    fault[row, step, agent] = guilty
    return fault, new


def collision_score(fault: Tensor, agent_type: Tensor) -> Tensor:
    """Product [B] over kinds of agents of max(0, 1 - collisions / (allowed + 1)); fault [B, T+1, N]."""
    score = torch.ones(len(fault), dtype=torch.float64)
    for kinds, allowed in ALLOWED.items():
        number = (fault & torch.isin(agent_type, torch.tensor(kinds))[:, None]).sum((1, 2))
        score *= (1 - number / (allowed + 1)).clamp(min=0)
    return score


def drivable_area(batch: Batch) -> Tensor:
    """1 [B] where all corners stay within MAX_OUTSIDE of a lane's strip or a drivable polygon, else 0; NaN without a
    map."""
    states, size = batch["states"][:, :, 0], batch["size"][:, None, 0]
    where = corners(states, size)
    points = where.flatten(0, 2)
    rollout = torch.arange(len(states)).repeat_interleave(where[0, ..., 0].numel())
    inside = near_lane(points, rollout, batch["lane_points"], batch["lane_index"], batch["lane_width"], MAX_OUTSIDE)
    polygons = batch["drivable_points"], batch["drivable_index"]
    rest = (~inside).nonzero()[:, 0]
    inside[rest] = inside_polygon(points[rest], rollout[rest], *polygons)
    owner, _, ends = line_segments(*polygons, closed=True)
    near, _ = near_segments(points, rollout, owner, ends, ends.new_full(owner.shape, MAX_OUTSIDE))
    inside[near] = True
    mapped = has_lines(batch["lane_index"]) | has_lines(batch["drivable_index"])
    return inside.view(len(states), -1).all(1).to(states).masked_fill(~mapped, torch.nan)


def driving_direction(batch: Batch) -> Tensor:
    """1, 0.5 or 0 [B] as the ego's centre moves at most AGAINST, FAR_AGAINST or more metres against the direction of
    its lane within WINDOW; of several lanes the one that it follows best, and nothing outside all."""
    centre = batch["states"][:, :, 0, :2]
    moved = torch.nn.functional.pad(centre.diff(dim=1), (0, 0, 1, 0)).flatten(0, 1)
    point, _, along = lanes_at(centre, batch)
    best = moved.new_full((len(moved),), -torch.inf)
    best = best.scatter_reduce(0, point, (moved[point] * along).sum(-1), "amax")
    way = best.masked_fill(best.isinf(), 0.0).view(centre.shape[:2]).cumsum(1)
    steps = round(WINDOW / DT) + 1  # of the devkit's sums
    before = torch.nn.functional.pad(way, (steps, 0))[:, :-steps]
    against = -(way - before).amin(1)
    return torch.where(against < AGAINST, 1.0, torch.where(against < FAR_AGAINST, 0.5, 0.0)).to(centre)


def time_to_collision(batch: Batch, places: Places, fault: Tensor, new: Tensor) -> Tensor:
    """1 [B] where nothing would be met within LEAST_TTC at constant velocities, from any step; else 0.

    Others count while they are ahead, or beside an ego that is not in one lane or on a crossing, until they meet it.
    """
    states, size = batch["states"], batch["size"]
    ego, length = states[:, :, :1], size[:, None, :1]
    angle = angle_at(rear_axle(ego, length), ego[..., 2], states[..., :2])
    beside = (places.loose | places.crossing)[..., None] & (angle <= BEHIND)
    seen = batch["valid"] & ~(new.cumsum(1) > 0) & ((angle < AHEAD) | beside) & (ego[..., 3].abs() > MOVING)
    seen[..., 0] = False
    reach = (size[:, :1] + size).norm(dim=-1)[:, None] + (ego[..., 3].abs() + states[..., 3].abs()) * LEAST_TTC
    seen &= (states[..., :2] - ego[..., :2]).norm(dim=-1) < reach
    row, step, agent = seen.nonzero(as_tuple=True)
    ahead = torch.arange(DT, LEAST_TTC, DT, dtype=states.dtype)[:, None, None]  # [K, 1, 1] s

    def after(track: Tensor) -> Tensor:
        return torch.cat([track[:, :2] + ahead * velocity(track), track[:, 2:].expand(len(ahead), -1, -1)], -1)

    boxes = after(states[row, step, 0]), size[row, 0], after(states[row, step, agent]), size[row, agent]
    meets = torch.zeros(len(states), dtype=torch.bool).index_fill(0, row[overlap(*boxes).any(0)], True)
    return (~meets & ~fault.any((1, 2))).to(states)


def expert_progress(batch: Batch) -> Tensor:
    """Fraction [B] of the recorded ego's path driven to the last step; 1 where it hardly moved."""
    last = torch.full_like(batch["stop"], batch["states"].shape[1] - 1)
    way = ego_path(batch["states"], batch["valid"], last)
    return route_completion(*way, batch["logged"], batch["logged_valid"]).nan_to_num(1.0)


def speed_limit(batch: Batch) -> Tensor:
    """max(0, 1 - mean overspeed / MAX_OVERSPEED) [B]; steps without a known limit count as none. NaN where rollouts do
    not tell limits, as those read from files."""
    speed = batch["states"][:, :, 0, 3]
    if "speed_limit" not in batch:
        return torch.full_like(speed[:, 0], torch.nan)
    limit = batch["speed_limit"].to(speed)
    over = (speed - limit).clamp(min=0) * (limit > 0)
    return (1 - over.sum(1) / (speed.shape[1] - 1) / MAX_OVERSPEED).clamp(min=0)


def comfort(ego: Tensor) -> Tensor:
    """1 [B] where the motion of ego [B, T+1, 4] stays within COMFORT, else 0.

    Derivatives are Savitzky-Golay filters with the devkit's windows; acceleration is a step's change of speed, and
    speed times yaw rate.
    """
    speed, heading = ego[..., 3], torch.cumsum(wrap(torch.nn.functional.pad(ego[..., 2].diff(dim=1), (1, 0))), 1)
    change = torch.nn.functional.pad(torch.stack([speed.diff(dim=1), speed[:, 1:] * heading.diff(dim=1)]), (1, 0)) / DT
    change[..., 0] = change[..., 1]
    smooth = partial(savgol_filter, delta=DT, axis=-1)
    window = partial(min, ego.shape[1])
    lon, lat, size = (smooth(a.numpy(), window(8), 2) for a in (*change, torch.hypot(*change)))
    found = {
        "longitudinal": lon,
        "lateral": lat,
        "yaw_rate": smooth(heading.numpy(), window(5), 2, deriv=1),
        "yaw_accel": smooth(heading.numpy(), window(5), 3, deriv=2),
        "longitudinal_jerk": smooth(lon, window(15), 2, deriv=1),
        "jerk": smooth(size, window(15), 2, deriv=1),
    }
    fine = [(low <= found[name]) & (found[name] <= high) for name, (low, high) in COMFORT.items()]
    return torch.stack([torch.from_numpy(each).all(-1) for each in fine]).all(0).to(ego)
