"""From SUMO's raw traces to sound tracks: smooth over arc length, no side slip, speed
from displacement."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from e2rl.scenes.paths import WHEELBASE, arc_length, shift_left
from e2rl.scenes.recording import DT
from scenegen.bodies import tractrix, whittaker
from scenegen.interaction import overlap
from scenegen.simulate import Net, Track

PATH_STEP, PATH_PENALTY = 0.5, 300.0  # m; smooths over about 8 m of way
TIME_PENALTY = 300.0  # smooths over about 1.6 s
WANDER, WANDER_KNOTS, WANDER_MEMORY = (
    0.13,
    20.0,
    0.75,
)  # m, m: slow drift within the lane
PEDAL, PEDAL_KNOTS = 0.09, 1.0  # m, s: unevenness of human speed control


@dataclass
class Parking:
    """Cars parked at the kerbs of a net: poses [Q, 3], sizes [Q, 2], and the strips'
    polygons."""

    pose: np.ndarray
    size: np.ndarray
    strips: list[np.ndarray]


def smooth_noise(
    rng, length: float, knots: float, sd: float, memory: float = 0.0
) -> CubicSpline:
    """A smooth random function on [0, length]: spline through AR(1) knots of standard
    deviation `sd`."""
    count = int(length / knots) + 4
    white = rng.normal(size=count) * sd
    values = np.empty(count)
    values[0] = white[0]
    for k in range(1, count):
        values[k] = memory * values[k - 1] + np.sqrt(1 - memory**2) * white[k]
    return CubicSpline((np.arange(count) - 1) * knots, values)


def smooth_track(track: Track, rng) -> np.ndarray:
    """States [T, 4] of a raw trace at the body's centre."""
    length = track.size[0]
    heading = np.array(track.heading)
    unit = np.stack([np.cos(heading), np.sin(heading)], -1)
    front = np.array(track.bumper) - (1 - WHEELBASE) / 2 * length * unit
    way = arc_length(front)
    total = way[-1]
    if total < 4 * PATH_STEP:
        centre = front[0] - WHEELBASE / 2 * length * unit[0]
        return np.tile([*centre, heading[0], 0.0], (len(front), 1))
    keep = np.concatenate([[True], np.diff(way) > 1e-6])
    at = np.arange(0.0, total + PATH_STEP, PATH_STEP)
    path = np.stack(
        [np.interp(at, way[keep], front[keep, axis]) for axis in (0, 1)], -1
    )
    path[at > total] = front[-1] + (at[at > total] - total)[:, None] * unit[-1]
    drift = smooth_noise(rng, total, WANDER_KNOTS, WANDER, WANDER_MEMORY)
    path = whittaker(shift_left(path, drift(at)), PATH_PENALTY)
    centre, angle = tractrix(path, np.array(WHEELBASE * length))
    time = np.arange(len(way)) * DT
    progress = whittaker(way, TIME_PENALTY)
    moving = np.clip(np.gradient(progress, DT) / 3.0, 0.0, 1.0)
    progress = progress + moving * smooth_noise(rng, time[-1], PEDAL_KNOTS, PEDAL)(time)
    progress = np.clip(np.maximum.accumulate(progress), 0.0, total)
    return states_along(at, centre, angle, progress)


def states_along(
    arc: np.ndarray, centre: np.ndarray, angle: np.ndarray, progress: np.ndarray
) -> np.ndarray:
    """States [T, 4] of a body at `progress` [T] on poses given over arc length [P];
    speed is displacement over time."""
    xy = np.stack([np.interp(progress, arc, centre[:, axis]) for axis in (0, 1)], -1)
    heading = np.interp(progress, arc, angle)
    velocity = np.gradient(xy, DT, axis=0)
    speed = velocity[:, 0] * np.cos(heading) + velocity[:, 1] * np.sin(heading)
    return np.concatenate([xy, heading[:, None], np.maximum(speed, 0.0)[:, None]], -1)


def stack_tracks(
    tracks: list[Track], frames: int, rng
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States [F, A, 4], valid [F, A] and sizes [A, 2] of all tracks over the recorded
    time."""
    states = np.zeros((frames, len(tracks), 4))
    valid = np.zeros((frames, len(tracks)), bool)
    for k, track in enumerate(tracks):
        own = smooth_track(track, rng) if len(track.heading) > 20 else np.zeros((0, 4))
        first = max(track.first, 0)
        own = own[first - track.first :][: max(frames - first, 0)]
        states[first : first + len(own), k] = own
        valid[first : first + len(own), k] = True
    return states, valid, np.array([track.size for track in tracks]).reshape(-1, 2)


def park(
    net: Net, states: np.ndarray, valid: np.ndarray, size: np.ndarray, rng
) -> Parking:
    """Cars at the kerbs that no vehicle ever touches and no lane runs through."""
    fill = rng.uniform(0.1, 0.45)
    pose = [np.zeros((0, 3))]
    body = [np.zeros((0, 2))]
    strips = []
    for name in net.kerbs:
        lane = net.lanes[name]
        arc = arc_length(lane.points)
        if arc[-1] < 60.0 or rng.random() < 0.4:
            continue
        slots = np.arange(22.0, arc[-1] - 22.0, 6.6)
        slots = slots[rng.random(len(slots)) < fill] + rng.uniform(-0.5, 0.5)
        if not len(slots):
            continue
        dims = np.stack(
            [rng.uniform(4.0, 5.3, len(slots)), rng.uniform(1.72, 2.0, len(slots))], -1
        )
        aside = (
            -lane.width / 2 - 0.3 - dims[:, 1] / 2 - rng.uniform(0, 0.15, len(slots))
        )
        heading = np.unwrap(np.arctan2(*np.gradient(lane.points, axis=0).T[::-1]))
        angle = np.interp(slots, arc, heading)
        foot = np.stack(
            [np.interp(slots, arc, lane.points[:, axis]) for axis in (0, 1)], -1
        )
        place = foot + aside[:, None] * np.stack([-np.sin(angle), np.cos(angle)], -1)
        pose.append(
            np.concatenate(
                [place, (angle + rng.normal(0, 0.02, len(slots)))[:, None]], -1
            )
        )
        body.append(dims)
        strips.append(kerb_strip(lane.points, arc, lane.width / 2))
    pose = np.concatenate(pose)
    body = np.concatenate(body)
    free = ~touched(pose, body, states, valid, size) & ~on_lanes(pose, body, net)
    return Parking(pose[free], body[free], strips)


def kerb_strip(points: np.ndarray, arc: np.ndarray, edge: float) -> np.ndarray:
    """Polygon of the parking strip beside a lane's right edge."""
    inner = points[(arc > 15.0) & (arc < arc[-1] - 15.0)]
    return np.concatenate(
        [shift_left(inner, -edge + 0.1), shift_left(inner, -edge - 2.5)[::-1]]
    )


def touched(
    pose: np.ndarray,
    body: np.ndarray,
    states: np.ndarray,
    valid: np.ndarray,
    size: np.ndarray,
) -> np.ndarray:
    """Which parked cars [Q] any vehicle overlaps at any time, with 0.15 m to spare, or
    another parked car does."""
    hit = np.zeros(len(pose), bool)
    for k in range(len(pose)):
        frame, agent = np.nonzero(
            valid & (np.linalg.norm(states[..., :2] - pose[k, :2], axis=-1) < 12.0)
        )
        hit[k] = overlap(
            pose[k], body[k] + 0.3, states[frame, agent, :3], size[agent]
        ).any()
        hit[k] |= overlap(pose[k], body[k] + 0.3, pose[:k], body[:k])[~hit[:k]].any()
    return hit


def on_lanes(pose: np.ndarray, body: np.ndarray, net: Net) -> np.ndarray:
    """Which parked cars [Q] stand within a lane."""
    inside = np.zeros(len(pose), bool)
    for lane in net.lanes.values():
        gap = np.linalg.norm(pose[:, None, :2] - lane.points[None], axis=-1)
        inside |= gap.min(1) < (lane.width + body[:, 1]) / 2 if len(pose) else False
    return inside
