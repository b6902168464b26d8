"""Speed limits that are none: numbers that converters fill in where they know no limit.

Some are beyond any limit, such as 1,000 km/h. Others could be one, such as 100 km/h on
every connector of an intersection and on nothing else. The map and what is driven on it
decide about those: a high limit is a placeholder where it is the only one of its map,
everybody drives far below it, and much of what it stands on are bends that no car takes
so fast, or it is higher than nearly all roads have. A motorway's 100 km/h passes, in a
jam too, whatever a ramp or a kink of its map is like.
"""

from collections import Counter
from dataclasses import replace

import numpy as np

from e2rl.scenes.paths import (
    arc_length,
    resample,
    tangent_angle,
    wrap,
)
from e2rl.scenes.recording import (
    VEHICLE,
    Lane,
    Recording,
)

HIGHEST = 45.0  # m/s, 162 km/h: no road's limit is higher
HIGH = 22.0  # m/s, 79 km/h
UNUSUAL = 36.0  # m/s, 130 km/h
ALIKE = 0.5  # m/s between limits that are one
USED = 0.6  # of a limit, driven by the fastest vehicle, above which it may be one
GRIP = 9.81  # m/s^2 in a bend: the most that tyres hold
SHARP = 3 * GRIP  # what no road is built for
# Parts of the limited lanes, by length, that are such bends: at 100 km/h on nuScenes'
# connectors 0.34 to 0.58 and 0.28 to 0.55, at 137 km/h on all lanes of a town 0.15 to
# 0.38 and 0.13 to 0.34.
GRIP_PART = 0.2
SHARP_PART = 0.05
BEND = 20  # m over which a bend is measured, of a shorter lane all of it
SHORT = 5  # m of lanes that have none
MOVES = 1.0  # m/s
FAST = 95  # percentile of the speeds above it that is the fastest without glitches


def known_limits(recording: Recording) -> tuple[dict[str, Lane], Counter[str]]:
    """Returns the lanes of a recording without limits that are placeholders, and how
    many these were, by a phrase."""
    limits = {
        name: lane.speed_limit
        for name, lane in recording.lanes.items()
        if lane.speed_limit > 0
    }
    placeholders = {name for name, limit in limits.items() if not limit <= HIGHEST}
    rest = {name: limit for name, limit in limits.items() if name not in placeholders}
    if _is_placeholder(recording, rest):
        placeholders |= rest.keys()
    if not placeholders:
        return recording.lanes, Counter()
    repairs = Counter(
        f"speed limits of {3.6 * limits[name]:.0f} km/h that are placeholders left out"
        for name in placeholders
    )
    lanes = {
        name: replace(lane, speed_limit=0.0) if name in placeholders else lane
        for name, lane in recording.lanes.items()
    }
    return lanes, repairs


def _is_placeholder(recording: Recording, limits: dict[str, float]) -> bool:
    """Whether the limits [m/s] of lanes by name, which are all that a map has, are one
    that stands for none."""
    if not limits:
        return False
    limit = min(limits.values())
    if limit < HIGH or max(limits.values()) - limit > ALIKE:
        return False
    driven = recording.valid & (recording.agent_type == VEHICLE)
    speed = np.abs(recording.states[driven, 3])
    moving = speed[speed > MOVES]
    fastest = np.percentile(moving, FAST) if len(moving) else 0.0
    bends = [_bends(recording.lanes[name]) for name in limits]
    lateral = limit**2 * np.concatenate([curvature for curvature, _ in bends])
    metres = np.concatenate([metres for _, metres in bends])
    whole = max(metres.sum(), 1e-6)
    if metres[lateral > SHARP].sum() > SHARP_PART * whole:
        return fastest < limit
    bent = metres[lateral > GRIP].sum() > GRIP_PART * whole
    return fastest < USED * limit and (limit > UNUSUAL or bent)


def _bends(lane: Lane) -> tuple[np.ndarray, np.ndarray]:
    """Returns curvatures [K] 1/m along a lane, each over BEND m, and the metres [K]
    that each stands for."""
    if len(lane.points) < 2:
        return np.zeros(0), np.zeros(0)
    angle = tangent_angle(resample(lane.points, 1.0))
    window = min(BEND, len(angle) - 1)
    curvature = np.zeros(1)
    if window >= SHORT:
        curvature = np.abs(wrap(angle[window:] - angle[:-window])) / window
    metres = arc_length(lane.points)[-1] / len(curvature)
    return curvature, np.full(len(curvature), metres)
