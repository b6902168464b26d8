"""Traffic on fixed paths for the procedural source: the Intelligent Driver Model (Treiber et al. 2000) with leaders,
red lights and yielding.

This is the scene generator's own model: numpy on the host, one fleet on dense paths that its vehicles never leave. The
IDM egos and traffic of the simulation drive batches of scenes on route
candidates and share no code with it, so that bundled seeds keep giving the same scenes.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from e2rl.scenes.recording import DT

StopLine = tuple[int, float, np.ndarray]  # on a path: the vehicle, arc length m, [T] whether its light is closed
STEP = 1.0  # m between the points of a path
AHEAD = 70  # m that a driver looks ahead for leaders
COMFORT, HARDEST = 3.5, 7.0  # m/s^2: braking that a light or a crossing vehicle may ask for; that physics allows
NEAR = 2.3  # m between two routes that conflict
HORIZON = 6.0  # s before arrival within which drivers look at a conflict


@dataclass
class Fleet:
    """Vehicles on their paths, which have a point every STEP m.

    front, centre [A, P, 2]: paths of the front axle and the body's centre; heading, limit [A, P]: rad, speed bound m/s;
    length, start [A]: m of path, m where a vehicle begins; size [A, 2]; drivers [A]: accel, brake m/s^2, headway s,
    gap m at standstill, speed m/s at the start.
    """

    front: np.ndarray
    centre: np.ndarray
    heading: np.ndarray
    limit: np.ndarray
    length: np.ndarray
    start: np.ndarray
    size: np.ndarray
    accel: np.ndarray
    brake: np.ndarray
    headway: np.ndarray
    gap: np.ndarray
    speed: np.ndarray
    lights: list[StopLine] = field(default_factory=list)

    def subset(self, keep: np.ndarray) -> "Fleet":
        """The fleet of the vehicles `keep` (indices) alone."""
        arrays = {name: value[keep] for name, value in vars(self).items() if name != "lights"}
        number = {int(old): new for new, old in enumerate(keep)}
        return replace(self, **arrays, lights=[(number[k], s, closed) for k, s, closed in self.lights if k in number])


def roll(fleet: Fleet, frames: int) -> np.ndarray:
    """Progress [frames, A] m of all vehicles along their paths."""
    between = conflicts(fleet)
    s, v = fleet.start.copy(), fleet.speed.copy()
    progress = np.empty((frames, len(s)))
    for frame in range(frames):
        progress[frame] = s
        present = s < fleet.length
        gap, leader_speed = leaders(fleet, s, v, present)
        accel = idm(fleet, v, _speed_bound(fleet, s, v), gap, leader_speed)
        stop = stop_distance(fleet, s, v, frame)
        stop = np.minimum(stop, yield_distance(fleet, s, v, present, between, stop))
        halt = idm(fleet, v, np.full(len(v), np.inf), stop + fleet.gap - 0.5, np.zeros(len(v)))
        accel = np.clip(np.minimum(accel, halt), -HARDEST, fleet.accel)
        after = np.maximum(v + accel * DT, 0.0)
        s = s + np.where(present, (v + after) / 2 * DT, 0.0)
        v = after
    return progress


def _at(values: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Path values [A, P, ...] at arc length s [A]."""
    index = np.clip(np.round(s / STEP).astype(int), 0, values.shape[1] - 1)
    return values[np.arange(len(s)), index]


def _indices_ahead(fleet: Fleet, s: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Indices [A, K] of the path points `reach` [K] points ahead of arc length s [A]."""
    return np.clip((s[:, None] / STEP).round().astype(int) + reach, 0, fleet.centre.shape[1] - 1)


def _speed_bound(fleet: Fleet, s: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Speed to aim for [A]: the bound here, and those ahead that comfortable braking has to meet."""
    reach = np.arange(0, 61, 4)
    bound = np.take_along_axis(fleet.limit, _indices_ahead(fleet, s, reach), 1)
    room = np.maximum(reach * STEP - 0.5 * v[:, None], 0.0)
    return np.sqrt(bound**2 + 2 * 1.3 * room).min(1)


def idm(fleet: Fleet, v: np.ndarray, target: np.ndarray, gap: np.ndarray, leader_speed: np.ndarray) -> np.ndarray:
    """IDM acceleration [A] m/s^2 towards speed `target` behind a leader at bumper distance `gap`.

    a (1 - (v / target)^4 - (wish / gap)^2) with wish = gap0 + v headway + v (v - leader_speed) / (2 sqrt(a b)); above
    the target speed it brakes in proportion to the excess instead of its fourth power.
    """
    closing = v * (v - leader_speed) / (2 * np.sqrt(fleet.accel * fleet.brake))
    wish = fleet.gap + np.maximum(v * fleet.headway + closing, 0.0)
    ratio = v / np.maximum(target, 0.5)
    free = np.where(ratio <= 1, fleet.accel * (1 - ratio**4), -fleet.brake * np.minimum(ratio - 1, 0.5) * 3)
    return free - fleet.accel * (wish / np.maximum(gap, 0.3)) ** 2


def leaders(fleet: Fleet, s: np.ndarray, v: np.ndarray, present: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bumper distance [A] m to the nearest vehicle in each one's corridor (inf: none) and its speed along the path."""
    own = np.arange(len(s))
    position, heading = _at(fleet.centre, s), _at(fleet.heading, s)
    index = _indices_ahead(fleet, s, np.arange(AHEAD))
    path = np.take_along_axis(fleet.centre, index[..., None], 1)
    squared = ((path[:, None] - position[None, :, None]) ** 2).sum(-1)  # [A, A, AHEAD]
    nearest = squared.argmin(-1)
    aside = np.sqrt(np.take_along_axis(squared, nearest[..., None], -1)[..., 0])
    turn = np.take_along_axis(fleet.heading, index, 1)[own[:, None], nearest] - heading[None]
    half = np.abs(np.cos(turn)) * fleet.size[None, :, 1] / 2 + np.abs(np.sin(turn)) * fleet.size[None, :, 0] / 2
    reach = np.abs(np.cos(turn)) * fleet.size[None, :, 0] / 2 + np.abs(np.sin(turn)) * fleet.size[None, :, 1] / 2
    inside = (aside < half + fleet.size[:, None, 1] / 2 + 0.25) & (nearest > 0) & present[None] & present[:, None]
    inside &= (np.cos(turn) > -0.5) & ~np.eye(len(s), dtype=bool)
    gap = np.where(inside, nearest * STEP - fleet.size[:, None, 0] / 2 - reach, np.inf)
    first = gap.argmin(1)
    return gap[own, first], v[first] * np.maximum(np.cos(turn[own, first]), 0.0)


def conflicts(fleet: Fleet) -> tuple[np.ndarray, np.ndarray]:
    """Arc lengths [A, A] on i's path between which it conflicts with j's path, first meeting only; inf: never.

    Routes that run together from the start are no conflict: their drivers see each other as leaders.
    """
    coarse = 2
    path = fleet.centre[:, ::coarse]
    count, points = path.shape[:2]
    arc = np.arange(points) * coarse * STEP
    used = (arc[None] >= fleet.start[:, None]) & (arc[None] <= np.minimum(fleet.start + 220.0, fleet.length)[:, None])
    enter, leave = np.full((count, count), np.inf), np.full((count, count), np.inf)
    squares = (path**2).sum(-1)
    for i in range(count):
        at = np.flatnonzero(used[i])
        if not len(at):
            continue
        squared = squares[i, at][None, :, None] + squares[:, None] - 2 * np.einsum("pc,jqc->jpq", path[i, at], path)
        near = np.where(used[:, None], squared, np.inf).min(-1) < NEAR**2  # [A, P_i]
        rising = near & ~np.concatenate([np.ones((count, 1), bool), near[:, :-1]], 1)
        meets = rising.any(1)
        first = rising.argmax(1)
        after = ~near & (np.arange(len(at)) > first[:, None])
        last = np.where(after.any(1), after.argmax(1), len(at) - 1)
        enter[i], leave[i] = np.where(meets, arc[at[first]], np.inf), np.where(meets, arc[at[last]], np.inf)
    both = np.isfinite(enter) & np.isfinite(enter.T) & ~np.eye(count, dtype=bool)
    return np.where(both, enter, np.inf), np.where(both, leave, np.inf)


def _can_stop(v: np.ndarray, room: np.ndarray) -> np.ndarray:
    return v**2 <= 2 * COMFORT * np.maximum(room, 0.0)


def stop_distance(fleet: Fleet, s: np.ndarray, v: np.ndarray, frame: int) -> np.ndarray:
    """Distance [A] m from each front bumper to the next closed light where stopping is possible; inf: none."""
    distance = np.full(len(s), np.inf)
    for k, line, closed in fleet.lights:
        room = line - s[k] - fleet.size[k, 0] / 2
        if closed[frame] and room > -0.5 and _can_stop(v[k], room + 0.5):
            distance[k] = min(distance[k], max(room, 0.0))
    return distance


def yield_distance(
    fleet: Fleet, s: np.ndarray, v: np.ndarray, present: np.ndarray, between: tuple[np.ndarray, ...], stop: np.ndarray
) -> np.ndarray:
    """Distance [A] m from each front bumper to the first conflict that another vehicle reaches first; inf: none.

    between: see `conflicts`; stop [A]: distance to a red light. A vehicle inside a conflict goes on; of two that
    approach, the one that arrives first goes first; who waits at a red light does not count; who cannot stop goes.
    """
    enter, leave = between
    half = fleet.size[:, :1] / 2
    room = enter - s[:, None] - half  # from i to its conflict with j
    inside = (room < 0) & (s[:, None] - half < leave)
    passed = s[:, None] - half >= leave
    held = stop[:, None] < room
    time = np.where(inside, 0.0, np.maximum(room, 0.0) / np.maximum(v[:, None], 1.0))
    time = np.where(passed | held | ~present[:, None], np.inf, time)
    stuck = ~inside & ~_can_stop(v[:, None], room - 1.0)
    time = np.where(stuck, time * 1e-3, time)
    order = np.arange(len(s))
    theirs = time.T
    earlier = (time > theirs) | ((time == theirs) & (order[:, None] > order[None]))
    must = earlier & (theirs < HORIZON) & np.isfinite(time) & ~inside & ~stuck
    return np.where(must, np.maximum(room - 1.0, 0.0), np.inf).min(1)
