"""Whether a recording can be traffic in metres, seconds and radians, on the map that
comes with it.

A log in other units, mirrored, or beside its map would make a scene all the same, and a
wrong one. `extent` bounds what a recording may cost to build; `motion` and `map_fit`
measure it. LIMITS say what is plausible. The genuine logs measured (443 of Waymo, 10 of
nuScenes, 239 bundled ones) stay far inside: their range stands beside each limit.
"""

from math import inf, isnan, pi

import numpy as np
from scipy.spatial import cKDTree

from e2rl.run.errors import InputError
from e2rl.scenes.lane_graph import LaneGraph
from e2rl.scenes.paths import arc_length, wrap
from e2rl.scenes.recording import DT, FEW_FRAMES, VEHICLE, Recording

FRAMES = 5  # between the two poses of a displacement: half a second
MOVED, DRIVES = 1.0, 2.0  # m, m/s: a vehicle that moves
DRIVEN, BACKWARDS = (
    15.0,
    5.0,
)  # m that a vehicle drives before it is looked at alone; m/s up to which it may reverse
ENOUGH = 20  # displacements that a median needs
CROWD = 100_000  # pairs of vehicles at one place at one moment, of which all are one
TWIN = 0.5  # m between the centres of vehicles that are one
LANE_RADIUS, LANE_ANGLE, LANES = 3.0, 0.6, 8  # m, rad, neighbours: a vehicle on a lane
PARALLEL, BESIDE = 0.2, (1.5, 20.0)  # rad, m: lanes side by side
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
        low, high, what, mend = LIMITS[name]
        if name == "states" and value < low:
            raise InputError(f"scene {scene_id[:100]!r}: {FEW_FRAMES}")
        if not isnan(value) and not low <= value <= high:
            bound = f"at least {low:g}" if value < low else f"at most {high:g}"
            raise InputError(
                f"scene {scene_id[:100]!r}: {value:.3g} {what}, plausible is {bound}; {mend}"
            )


def extent(recording: Recording) -> dict[str, float]:
    """Sizes of a validated recording."""
    valid = recording.valid
    points = recording.states[..., :2][recording.valid]
    path = recording.states[valid[:, recording.ego], recording.ego, :2]
    ego = np.median(path, axis=0) if len(path) else np.full(2, np.nan)
    rings = [lane.points for lane in recording.lanes.values()] + [
        ring[:, :2] for ring in recording.drivable
    ]
    ground = np.concatenate([ring for ring in rings if len(ring)])
    lengths = [
        arc_length(lane.points)[-1]
        for lane in recording.lanes.values()
        if len(lane.points) > 1
    ]
    size = recording.size[valid.any(0)]
    return {
        "states": valid.size,
        "coordinate": max(np.abs(points).max(), np.abs(ground).max()),
        "heading": np.abs(recording.states[..., 2][valid]).max(),
        "reach": np.linalg.norm(points - ego, axis=-1).max(),
        "map_reach": np.linalg.norm(ground - ego, axis=-1).max(),
        "lane": max(lengths, default=0.0),
        "lanes": sum(lengths),
        "borders": sum(
            arc_length(ring[:, :2])[-1] for ring in recording.drivable if len(ring)
        ),
        "links": links(recording),
        **_extremes(size[:, 0], "length"),
        **_extremes(size[:, 1], "width"),
    }


def links(recording: Recording) -> int:
    """The most lanes that begin at one place, or are named to follow one: of so many,
    all pairs would be looked at."""
    starts = np.array(
        [lane.points[0] for lane in recording.lanes.values() if len(lane.points)]
    )
    together = (
        cKDTree(starts).query_ball_point(starts, TWIN, return_length=True)
        if len(starts)
        else [0]
    )
    return max(
        int(np.max(together)), *(len(lane.exits) for lane in recording.lanes.values())
    )


def _extremes(sizes: np.ndarray, name: str) -> dict[str, float]:
    """The size that is nearer to a limit."""
    low, high, *_ = LIMITS[name]
    return {name: float(sizes.min() if sizes.min() < low else sizes.max())}


def displacements(
    recording: Recording,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """All displacements [K, 2] m, overlapping ones included, of vehicles that are
    recorded for FRAMES frames on end and drive; the pose [K, 3] in its middle, the mean
    recorded speed [K] m/s without its sign, and the track [K] whose it is."""
    states = recording.states
    valid = recording.valid
    count = len(states) - FRAMES
    if count < 1:
        return np.zeros((0, 2)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, int)
    known = np.logical_and.reduce([valid[k : count + k] for k in range(FRAMES + 1)])
    speed = np.mean(
        [np.abs(states[k : count + k, :, 3]) for k in range(FRAMES + 1)], axis=0
    )
    moved = states[FRAMES:, :, :2] - states[:count, :, :2]
    drives = (np.linalg.norm(moved, axis=-1) > MOVED) | (speed > DRIVES)
    chosen = known & drives & (recording.agent_type == VEHICLE)
    middle = states[FRAMES // 2 :][:count]
    return moved[chosen], middle[chosen][:, :3], speed[chosen], chosen.nonzero()[1]


def motion(recording: Recording) -> dict[str, float]:
    """Sizes of vehicles, and whether headings and speeds are those of the
    displacements."""
    moved, pose, speed, track = displacements(recording)
    distance = np.linalg.norm(moved, axis=-1)
    ego = track == recording.ego
    ratio = (speed * FRAMES * DT + 0.05) / (distance + 0.05)
    far = distance > MOVED
    turned = np.abs(wrap(np.arctan2(moved[:, 1], moved[:, 0]) - pose[:, 2]))
    turned = np.where(
        distance < BACKWARDS * FRAMES * DT, np.minimum(turned, pi - turned), turned
    )  # it may reverse
    single = recording.valid.any(0) & (recording.agent_type == VEHICLE)
    single[[*recording.coupled, *recording.towed]] = False
    length, width = (
        np.median(recording.size[single], axis=0) if single.any() else (np.nan, np.nan)
    )
    return {
        "vehicle_length": float(length),
        "vehicle_width": float(width),
        "speed": _median(distance / (FRAMES * DT)),
        "speed_ratio": _median(ratio),
        "direction": _median(turned[far]),
        "ego_speed_ratio": _median(ratio[ego]),
        "ego_direction": _median(turned[far & ego]),
        "twins": _together(recording, np.unique(track[far])),
        **_worst(distance[far], turned[far], ratio=ratio[far], track=track[far]),
    }


def _together(recording: Recording, tracks: np.ndarray) -> float:
    """The longest time [s] that two of these tracks [K] are at one place."""
    place = recording.states[::FRAMES, tracks, :2]
    valid = recording.valid[::FRAMES, tracks]
    pairs = [np.zeros((0, 2), int)]
    for known, points in zip(valid, place, strict=True):
        there = np.flatnonzero(known)
        if len(there) > 1:
            tree = cKDTree(points[there])
            if tree.count_neighbors(tree, TWIN) > CROWD + len(there):
                return inf
            pairs.append(there[tree.query_pairs(TWIN, output_type="ndarray")])
    _, count = np.unique(np.concatenate(pairs), axis=0, return_counts=True)
    return float(count.max(initial=0) * FRAMES * DT)


def _worst(
    distance: np.ndarray, turned: np.ndarray, ratio: np.ndarray, track: np.ndarray
) -> dict[str, float]:
    """The largest deviations of one vehicle, of those that drive DRIVEN m: of its
    heading and of its speeds."""
    drives = (
        np.bincount(track, distance) / FRAMES > DRIVEN
        if len(track)
        else np.zeros(0, bool)
    )
    turn, factor, moved = (
        _medians(values, track) for values in (turned, np.abs(np.log(ratio)), distance)
    )
    fast = moved > BACKWARDS * FRAMES * DT
    return {
        "track_direction": _largest(turn[drives & fast]),
        "slow_direction": _largest(turn[drives & ~fast]),
        "track_speed": float(np.exp(_largest(factor[drives]))),
    }


def _largest(values: np.ndarray) -> float:
    return float(values.max()) if len(values) else np.nan


def _medians(values: np.ndarray, group: np.ndarray) -> np.ndarray:
    """The (lower) median of the values [K] of each group 0 .. G-1, of group [K]; NaN
    for a group without any."""
    order = np.lexsort((values, group))
    count = np.bincount(group)
    middle = np.cumsum(count) - count + (count - 1) // 2
    return (
        np.where(count > 0, values[order][np.where(count > 0, middle, 0)], np.nan)
        if len(group)
        else np.zeros(0)
    )


def map_fit(recording: Recording, graph: LaneGraph) -> dict[str, float]:
    """Whether the vehicles drive where the lanes are, and the lanes lie as far apart as
    lanes do."""
    ego = recording.states[recording.valid[:, recording.ego], recording.ego, :2]
    moved, pose, *_ = displacements(recording)
    pose = pose[np.linalg.norm(moved, axis=-1) > MOVED]
    _, near = graph.tree.query(pose[:, :2], k=LANES, distance_upper_bound=LANE_RADIUS)
    found = near < len(graph.points)
    aligned = (
        np.abs(wrap(graph.heading[np.where(found, near, 0)] - pose[:, 2:])) < LANE_ANGLE
    )
    on = (found & aligned).any(-1)
    return {
        "lane_distance": float(np.median(graph.tree.query(ego)[0])),
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
    direction = np.exp(1j * graph.heading)
    width = np.array(
        [lane.width if lane.width > 0 else np.nan for lane in graph.lanes.values()]
    )
    nearest = np.full(len(chosen), inf)
    named = graph.named_beside
    for row, point in enumerate(
        chosen
    ):  # one by one: a map may have all its points at one place
        other = np.array(
            graph.tree.query_ball_point(graph.points[point], BESIDE[1]), dtype=int
        )
        turn = direction[point].conj()
        away = (place[other] - place[point]) * turn
        along = (direction[other] * turn).real
        across = np.abs(away.imag)
        beside = (
            (np.abs(along) > np.cos(PARALLEL))
            & (np.abs(away.real) < 1.0)
            & (across > BESIDE[0])
        )
        lane = graph.lane_of[point]
        neighbour = graph.lane_of[other[beside]]
        room = (width[lane] + width[neighbour]) / 2
        adjoin = _adjoin(across[beside], room, same=along[beside] > 0)
        beside_it = named.get(graph.ids[lane], ())
        adjoin |= np.array([graph.ids[index] in beside_it for index in neighbour], bool)
        nearest[row] = across[beside][adjoin].min(initial=inf)
    return _median(nearest[nearest < inf])


def _adjoin(apart: np.ndarray, room: np.ndarray, same: np.ndarray) -> np.ndarray:
    """Whether parallel lanes [Q] `apart` m from each other share a border.

    Their recorded widths say so, which make them `room` m apart. Where these are
    unknown (NaN), lanes in the same direction do, and oncoming ones where they lie as
    near as lanes do in metres.
    """
    unknown = same | (apart <= LIMITS["lane_spacing"][1])
    return np.where(np.isnan(room), unknown, apart < room + VERGE)


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if len(values) >= ENOUGH else np.nan
