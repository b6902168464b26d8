"""Speed limits that are none: numbers that converters fill in where they know no limit.

Some are beyond any limit, such as 1,000 km/h. Others could be one, such as 100 km/h on every connector of an
intersection and on nothing else. The map and what is driven on it decide about those: a high limit is a placeholder
where it is the only one of its map, everybody drives far below it, and it stands on bends that no car takes so fast,
or is higher than nearly all roads have. A motorway's 100 km/h passes, in a jam too.
"""

from collections import Counter
from dataclasses import replace

import numpy as np

from e2rl.scenes.paths import resample, tangent_angle, wrap
from e2rl.scenes.recording import VEHICLE, Lane, Recording

HIGHEST = 45.0  # m/s, 162 km/h: no road's limit is higher
HIGH, UNUSUAL = 22.0, 36.0  # m/s: 79 and 130 km/h
ALIKE = 0.5  # m/s between limits that are one
USED = 0.6  # of a limit, driven by the fastest vehicle, above which it may be one
GRIP, SHARP = 9.81, 3 * 9.81  # m/s^2 in a bend: the most that tyres hold, and what no road is built for
BEND, SHORT = 20, 5  # m over which a bend is measured, of a shorter lane all of it; lanes that have none
MOVES, FAST = 1.0, 95  # m/s, and the percentile of the speeds above it that is the fastest without glitches


def known_limits(recording: Recording) -> tuple[dict[str, Lane], Counter[str]]:
    """Returns the lanes of a recording without limits that are placeholders, and how many these were, by a phrase."""
    limits = {name: lane.speed_limit for name, lane in recording.lanes.items() if lane.speed_limit > 0}
    placeholders = {name for name, limit in limits.items() if not limit <= HIGHEST}
    rest = {name: limit for name, limit in limits.items() if name not in placeholders}
    if _is_placeholder(recording, rest):
        placeholders |= rest.keys()
    if not placeholders:
        return recording.lanes, Counter()
    repairs = Counter(
        f"speed limits of {3.6 * limits[name]:.0f} km/h that are placeholders left out" for name in placeholders
    )
    lanes = {
        name: replace(lane, speed_limit=0.0) if name in placeholders else lane for name, lane in recording.lanes.items()
    }
    return lanes, repairs


def _is_placeholder(recording: Recording, limits: dict[str, float]) -> bool:
    """Whether the limits [m/s] of lanes by name, which are all that a map has, are one that stands for none."""
    if not limits or min(limits.values()) < HIGH or max(limits.values()) - min(limits.values()) > ALIKE:
        return False
    limit = min(limits.values())
    speed = np.abs(recording.states[recording.valid & (recording.agent_type == VEHICLE), 3])
    moving = speed[speed > MOVES]
    fastest = np.percentile(moving, FAST) if len(moving) else 0.0
    lateral = max(limit**2 * _curvature(recording.lanes[name]) for name in limits)
    if lateral > SHARP:
        return fastest < limit
    return fastest < USED * limit and (limit > UNUSUAL or lateral > GRIP)


def _curvature(lane: Lane) -> float:
    """The highest curvature [1/m] of a lane over BEND m, which the kinks of a coarse polyline do not change."""
    if len(lane.points) < 2:
        return 0.0
    angle = tangent_angle(resample(lane.points, 1.0))
    length = min(BEND, len(angle) - 1)
    return float(np.abs(wrap(angle[length:] - angle[:-length])).max()) / length if length >= SHORT else 0.0
