"""Whether a recording can be traffic in metres, seconds and radians, on the map that
comes with it.

A log in other units, mirrored, or beside its map would make a scene all the same, and a
wrong one. `extent` bounds what a recording may cost to build; `motion` and `map_fit`
measure it. LIMITS say what is plausible. The genuine logs measured (443 of Waymo, 10 of
nuScenes, 239 bundled ones) stay far inside: their range stands beside each limit.
"""

from math import (
    inf,
    isnan,
    pi,
)
from typing import NamedTuple

import numpy as np
from numpy import ndarray
from scipy.spatial import cKDTree

from e2rl.run.errors import InputError
from e2rl.scenes.lane_graph import LaneGraph
from e2rl.scenes.paths import (
    arc_length,
    wrap,
)
from e2rl.scenes.recording import (
    DT,
    FEW_FRAMES,
    VEHICLE,
    Recording,
)

FRAMES = 5  # between the two poses of a displacement: half a second
MOVED = 1.0  # m of a displacement of a vehicle that moves
DRIVES = 2.0  # m/s of one
DRIVEN = 15.0  # m that a vehicle drives before it is looked at alone
BACKWARDS = 5.0  # m/s up to which it may reverse
ENOUGH = 20  # displacements that a median needs
CROWD = 100_000  # pairs of vehicles at one place at one moment, of which all are one
TWIN = 0.5  # m between the centres of vehicles that are one
LANE_RADIUS = 3.0  # m from a lane of a vehicle on it
LANE_ANGLE = 0.6  # rad from its direction
LANES = 8  # points of lanes that are looked at
PARALLEL = 0.2  # rad between lanes side by side
BESIDE = (1.5, 20.0)  # m between them
LEVEL_WITH = 1.0  # m along from a point of a lane to the point beside it
VERGE = 2.0  # m that may lie between the borders of lanes that adjoin
SAMPLES = 300  # lane points at most whose neighbours are looked at

# Of a measure the least and the most; what it is, and how a log outside of it is
# mended.
LIMITS: dict[str, tuple[float, float, str, str]] = {
    # `extent`
    "states": (2, 4e6, "frames x agents", "cut the log"),  # 400 to 45,000
    "coordinate": (
        0,
        2e7,
        "m is the largest coordinate",
        "give positions in m",
    ),  # 44 to 40,000
    "heading": (
        0,
        10 * pi,
        "rad is the largest heading",
        "give headings in rad",
    ),  # 3 to 14
    "reach": (
        0,
        10_000,
        "m is an agent from the ego",
        "give positions in m, or leave the agent out",
    ),  # 31 to 323
    "map_reach": (
        0,
        50_000,
        "m is a point of the map from the ego",
        "cut the map, or give it in m",
    ),  # 126 to 770
    "lane": (
        0,
        10_000,
        "m is the longest lane",
        "cut the map, or give it in m",
    ),  # 72 to 676
    "lanes": (0, 500_000, "m are all lanes together", "cut the map"),  # 620 to 32,000
    "borders": (
        0,
        5_000_000,
        "m are the borders of all drivable areas",
        "cut the map",
    ),  # 0 to 41,000
    "links": (
        0,
        100,
        "lanes begin at one place, or follow one lane",
        "draw each lane once",
    ),  # 1 to 5
    "length": (0.05, 40, "m is an agent's length", "give sizes in m"),  # 0.2 to 17
    "width": (
        0.05,
        15,
        "m is an agent's width",
        "give sizes in m",
    ),  # 0.2 to 10, of a glitch
    # `motion`
    "vehicle_length": (
        2.5,
        9,
        "m is the median length of vehicles",
        "give sizes in m",
    ),  # 3.9 to 5.9
    "vehicle_width": (
        1.0,
        4,
        "m is the median width of vehicles",
        "give sizes in m",
    ),  # 1.7 to 2.8
    "speed": (
        0,
        45,
        "m/s is the median speed of moving vehicles",
        "give speeds in m/s",
    ),  # 2.7 to 22
    "speed_ratio": (
        0.7,
        1.4,
        "times the displacement is what the recorded speeds make",
        "give m, m/s and s",
    ),  # 1
    # 0.001 to 0.16
    "direction": (
        0,
        0.4,
        "rad lie between heading and displacement",
        "give rad from x to y, mirror no axes",
    ),
    "ego_speed_ratio": (
        0.7,
        1.4,
        "times its displacement is what the ego's speeds make",
        "give m, m/s and s",
    ),
    "ego_direction": (
        0,
        0.45,
        "rad lie between the ego's heading and displacement",
        "give rad",
    ),  # 0.28
    "track_direction": (
        0,
        0.45,
        "rad lie between heading and displacement of a vehicle",
        "give rad",
    ),  # 0.20
    "slow_direction": (
        0,
        0.8,
        "rad lie between heading and displacement of a slow vehicle",
        "give rad",
    ),  # 0.43
    "twins": (
        0,
        2.0,
        "s are two vehicles that drive at the same place",
        "leave one of the two out",
    ),  # 0 to 0.5
    "track_speed": (
        1,
        2.0,
        "is the factor between speeds and displacement of a vehicle",
        "give m/s",
    ),  # 1.5
    # `map_fit`
    "lane_distance": (
        0,
        10,
        "m is the ego from the nearest lane",
        "give the map of this place",
    ),  # 0.2 to 3.5
    "on_lanes": (
        0.3,
        1,
        "of the moving vehicles drive along a lane",
        "give the map of this place",
    ),  # 0.36 to 1
    "lane_spacing": (
        0,
        7.5,
        "m lie between lanes side by side",
        "give positions and map in m",
    ),  # 2.8 to 5.7
}


def check(measures: dict[str, float], scene_id: str) -> None:
    """InputError for the first measure outside of its limits; NaN, of what a log is too
    short to tell, passes."""
    for name, value in measures.items():
        low, high, meaning, mend = LIMITS[name]
        if name == "states" and value < low:
            raise InputError(f"scene {scene_id[:100]!r}: {FEW_FRAMES}")
        if not isnan(value) and not low <= value <= high:
            bound = f"at least {low:g}" if value < low else f"at most {high:g}"
            raise InputError(
                f"scene {scene_id[:100]!r}: {value:.3g} {meaning}, plausible is {bound}; "
                f"{mend}"
            )


def extent(recording: Recording) -> dict[str, float]:
    """Sizes of a validated recording."""
    valid = recording.valid
    points = recording.states[..., :2][valid]
    path = recording.states[valid[:, recording.ego], recording.ego, :2]
    ego = np.median(path, axis=0) if len(path) else np.full(2, np.nan)
    lines = [lane.points for lane in recording.lanes.values()]
    rings = [ring[:, :2] for ring in recording.drivable]
    ground = np.concatenate([line for line in lines + rings if len(line)])
    lengths = [arc_length(line)[-1] for line in lines if len(line) > 1]
    size = recording.size[valid.any(0)]
    return {
        "states": valid.size,
        "coordinate": max(np.abs(points).max(), np.abs(ground).max()),
        "heading": np.abs(recording.states[..., 2][valid]).max(),
        "reach": np.linalg.norm(points - ego, axis=-1).max(),
        "map_reach": np.linalg.norm(ground - ego, axis=-1).max(),
        "lane": max(lengths, default=0.0),
        "lanes": sum(lengths),
        "borders": sum(arc_length(ring)[-1] for ring in rings if len(ring)),
        "links": links(recording),
        "length": _extreme(size[:, 0], "length"),
        "width": _extreme(size[:, 1], "width"),
    }


def links(recording: Recording) -> int:
    """The most lanes that begin at one place, or are named to follow one: of so many,
    all pairs would be looked at."""
    lanes = recording.lanes.values()
    most = max(len(lane.exits) for lane in lanes)
    starts = np.array([lane.points[0] for lane in lanes if len(lane.points)])
    if not len(starts):
        return most
    together = cKDTree(starts).query_ball_point(starts, TWIN, return_length=True)
    return max(most, int(np.max(together)))


def _extreme(sizes: ndarray, name: str) -> float:
    """The size that is nearer to a limit."""
    return float(sizes.min() if sizes.min() < LIMITS[name][0] else sizes.max())


class Displacements(NamedTuple):
    """Displacements [K, 2] m over FRAMES frames; the pose [K, 3] in their middle, the
    mean recorded speed [K] m/s without its sign, and the track [K] whose they are."""

    moved: ndarray
    pose: ndarray
    speed: ndarray
    track: ndarray


def displacements(recording: Recording) -> Displacements:
    """All displacements, overlapping ones included, of vehicles that are recorded for
    FRAMES frames on end and drive."""
    states = recording.states
    count = max(len(states) - FRAMES, 0)
    spans = [slice(first, first + count) for first in range(FRAMES + 1)]
    recorded = np.logical_and.reduce([recording.valid[span] for span in spans])
    speed = np.mean([np.abs(states[span, :, 3]) for span in spans], axis=0)
    moved = states[spans[-1], :, :2] - states[spans[0], :, :2]
    drives = (np.linalg.norm(moved, axis=-1) > MOVED) | (speed > DRIVES)
    chosen = recorded & drives & (recording.agent_type == VEHICLE)
    pose = states[spans[FRAMES // 2], :, :3]
    return Displacements(
        moved[chosen],
        pose[chosen],
        speed[chosen],
        track=chosen.nonzero()[1],
    )


def motion(recording: Recording) -> dict[str, float]:
    """Sizes of vehicles, and whether headings and speeds are those of the
    displacements."""
    moved, pose, speed, track = displacements(recording)
    distance = np.linalg.norm(moved, axis=-1)
    ego = track == recording.ego
    ratio = (speed * FRAMES * DT + 0.05) / (distance + 0.05)
    far = distance > MOVED
    course = np.arctan2(moved[:, 1], moved[:, 0])
    turned = np.abs(wrap(course - pose[:, 2]))
    slow = distance < BACKWARDS * FRAMES * DT  # it may reverse
    turned = np.where(slow, np.minimum(turned, pi - turned), turned)
    single = recording.valid.any(0) & (recording.agent_type == VEHICLE)
    single[[*recording.coupled, *recording.towed]] = False
    size = recording.size[single]
    length, width = np.median(size, axis=0) if len(size) else (np.nan, np.nan)
    return {
        "vehicle_length": float(length),
        "vehicle_width": float(width),
        "speed": _median(distance / (FRAMES * DT)),
        "speed_ratio": _median(ratio),
        "direction": _median(turned[far]),
        "ego_speed_ratio": _median(ratio[ego]),
        "ego_direction": _median(turned[far & ego]),
        "twins": _together(recording, np.unique(track[far])),
        **_worst(
            distance[far],
            turned[far],
            ratio=ratio[far],
            track=track[far],
        ),
    }


def _together(recording: Recording, tracks: ndarray) -> float:
    """The longest time [s] that two of these tracks [K] are at one place."""
    place = recording.states[::FRAMES, tracks, :2]
    valid = recording.valid[::FRAMES, tracks]
    pairs = [np.zeros((0, 2), int)]
    for recorded, points in zip(valid, place, strict=True):
        index = np.flatnonzero(recorded)
        if len(index) > 1:
            tree = cKDTree(points[index])
            if tree.count_neighbors(tree, TWIN) > CROWD + len(index):
                return inf
            pairs.append(index[tree.query_pairs(TWIN, output_type="ndarray")])
    count = np.unique(
        np.concatenate(pairs),
        axis=0,
        return_counts=True,
    )[1]
    return float(count.max(initial=0) * FRAMES * DT)


def _worst(
    distance: ndarray,
    turned: ndarray,
    *,
    ratio: ndarray,
    track: ndarray,
) -> dict[str, float]:
    """The largest deviations of one vehicle, of those that drive DRIVEN m: of its
    heading and of its speeds."""
    drives = np.bincount(track, distance) / FRAMES > DRIVEN
    turn = _medians(turned, track)
    factor = _medians(np.abs(np.log(ratio)), track)
    fast = _medians(distance, track) > BACKWARDS * FRAMES * DT
    return {
        "track_direction": _largest(turn[drives & fast]),
        "slow_direction": _largest(turn[drives & ~fast]),
        "track_speed": float(np.exp(_largest(factor[drives]))),
    }


def _largest(values: ndarray) -> float:
    return float(values.max()) if len(values) else np.nan


def _medians(values: ndarray, group: ndarray) -> ndarray:
    """The (lower) median of the values [K] of each group 0 .. G-1, of group [K]; NaN
    for a group without any."""
    count = np.bincount(group)
    medians = np.full(len(count), np.nan)
    middle = np.cumsum(count) - count + (count - 1) // 2
    ordered = values[np.lexsort((values, group))]
    medians[count > 0] = ordered[middle[count > 0]]
    return medians


def map_fit(recording: Recording, graph: LaneGraph) -> dict[str, float]:
    """Whether the vehicles drive where the lanes are, and the lanes lie as far apart as
    lanes do."""
    ego = recording.states[recording.valid[:, recording.ego], recording.ego, :2]
    distance = graph.tree.query(ego)[0]
    driven = displacements(recording)
    pose = driven.pose[np.linalg.norm(driven.moved, axis=-1) > MOVED]
    near = graph.tree.query(
        pose[:, :2],
        k=LANES,
        distance_upper_bound=LANE_RADIUS,
    )[1]
    exists = near < len(graph.points)
    turn = graph.heading[np.where(exists, near, 0)] - pose[:, 2:]
    on = (exists & (np.abs(wrap(turn)) < LANE_ANGLE)).any(-1)
    return {
        "lane_distance": float(np.median(distance)) if len(distance) else np.nan,
        "on_lanes": float(on.mean()) if len(on) >= ENOUGH else np.nan,
        "lane_spacing": lane_spacing(graph),
    }


def lane_spacing(graph: LaneGraph) -> float:
    """Median distance [m] from points of a lane, evenly chosen, to the nearest lane
    that adjoins (NaN: none).

    Roads lie as far apart as they do, and so do the carriageways of one with grass
    between them: of parallel lanes only those tell a map's unit that share a border
    (`_adjoin`), or that the map names neighbours.
    """
    chosen = np.unique(np.linspace(0, len(graph.points) - 1, SAMPLES).astype(int))
    place = graph.points @ [1, 1j]
    unit = np.exp(1j * graph.heading)
    width = np.array([lane.width for lane in graph.lanes.values()])
    width = np.where(width > 0, width, np.nan)
    nearest = []
    for point in chosen:  # one by one: a map may have all its points at one place
        other = graph.tree.query_ball_point(graph.points[point], BESIDE[1])
        turn = unit[point].conj()
        offset = (place[other] - place[point]) * turn
        cosine = (unit[other] * turn).real
        across = np.abs(offset.imag)
        beside = (np.abs(cosine) > np.cos(PARALLEL)) & (across > BESIDE[0])
        beside &= np.abs(offset.real) < LEVEL_WITH
        across = across[beside]
        lane = graph.lane_of[point]
        others = graph.lane_of[other][beside]
        room = (width[lane] + width[others]) / 2
        adjoin = _adjoin(across, room, same=cosine[beside] > 0)
        if named := graph.named_beside.get(graph.ids[lane]):
            adjoin |= np.array([graph.ids[index] in named for index in others], bool)
        if adjoin.any():
            nearest.append(across[adjoin].min())
    return _median(np.array(nearest))


def _adjoin(
    apart: ndarray,
    room: ndarray,
    same: ndarray,
) -> ndarray:
    """Whether parallel lanes [Q] `apart` m from each other share a border.

    Their recorded widths say so, which make them `room` m apart. Where these are
    unknown (NaN), lanes in the same direction do, and oncoming ones where they lie as
    near as lanes do in metres.
    """
    unknown = same | (apart <= LIMITS["lane_spacing"][1])
    return np.where(np.isnan(room), unknown, apart < room + VERGE)


def _median(values: ndarray) -> float:
    return float(np.median(values)) if len(values) >= ENOUGH else np.nan
