"""Which lanes follow a lane and which lie beside it: what a map says of it, held
against the map's geometry.

Converters name lanes that were cut away, lanes that follow nowhere near, and all lanes
of the next road; some name nothing at all. Geometry decides: a link is kept where a
vehicle can drive it, and a lane that is left without any is followed by what begins at
its end.
"""

from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from e2rl.scenes.paths import resample, tangent_angle, wrap
from e2rl.scenes.recording import Lane

JOIN_GAP, JOIN_ANGLE, JOIN_HEIGHT = (
    1.5,
    0.6,
    2.0,
)  # where connectivity is inferred: m, rad, m
LINK_GAP, LINK_ANGLE = 5.0, 1.0  # m along the lane, rad: of a link that is recorded
END = 2.0  # m over which the direction of a lane's end is measured
SAMPLES = 9  # points of a lane where its neighbours are looked for
LEVEL_WITH, PARALLEL = (
    1.5,
    0.6,
)  # m along, rad: a point of a neighbour is beside a point of the lane
BESIDE, SPARE = (
    0.5,
    2.0,
)  # m: distance of lanes that do not overlap, and what may lie between neighbours' borders
ABSENT, ITSELF, UNDRIVABLE, INFERRED, NOT_ADJACENT = (
    "links to lanes that are not in the map left out",
    "links of lanes to themselves left out",
    "links that cannot be driven left out",
    "missing links inferred from geometry",
    "neighbours that are not the adjacent lane replaced or left out",
)  # phrases of `repairs`


def plausible_width(width: float) -> float:
    """A recorded lane width, or 3.7 m where it is outside 2.5-6 m: half of Waymo's
    connectors have 0, some 90 m."""
    return float(width) if 2.5 <= width <= 6.0 else 3.7


class Ends(NamedTuple):
    """Where lanes [N] begin and end.

    first, last [N, 2] m; into, out [N] rad: directions there, over END m; low, high [N]
    m: heights there, NaN unknown; width [N] m.
    """

    first: np.ndarray
    last: np.ndarray
    into: np.ndarray
    out: np.ndarray
    low: np.ndarray
    high: np.ndarray
    width: np.ndarray


def ends_of(lanes: Iterable[Lane]) -> Ends:
    """Returns the ends of lanes."""
    rows = []
    for lane in lanes:
        line = resample(lane.points, 1.0)
        near = min(int(END), len(line) - 1)
        begin = line[near] - line[0]
        end = line[-1] - line[-1 - near]
        low, high = (
            (np.nan, np.nan)
            if lane.heights is None
            else (lane.heights[0], lane.heights[-1])
        )
        into = np.arctan2(begin[1], begin[0])
        out = np.arctan2(end[1], end[0])
        rows.append(
            [*line[0], *line[-1], into, out, low, high, plausible_width(lane.width)]
        )
    table = np.array(rows, float).reshape(-1, 9)
    return Ends(table[:, :2], table[:, 2:4], *table[:, 4:].T)


def drivable(ends: Ends, lane: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Whether a vehicle can drive from the end of lanes [Q] into others [Q], both
    indices.

    The other begins at most LINK_GAP m before or behind the end, less than half a lane
    beside it, less than LINK_ANGLE turned, which smoothing makes the tightest turn of a
    car, and on the same level.
    """
    x, y = (ends.first[other] - ends.last[lane]).T
    cos = np.cos(ends.out[lane])
    sin = np.sin(ends.out[lane])
    along = x * cos + y * sin
    across = y * cos - x * sin
    half = np.minimum(ends.width[lane], ends.width[other]) / 2
    turn = np.abs(wrap(ends.into[other] - ends.out[lane]))
    return (
        (np.abs(along) <= LINK_GAP)
        & (np.abs(across) < half)
        & (turn < LINK_ANGLE)
        & _level(ends, lane, other=other)
    )


def _level(ends: Ends, lane: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Whether lanes [Q] end at the height at which others [Q] begin, as far as that is
    known."""
    return ~(np.abs(ends.low[other] - ends.high[lane]) >= JOIN_HEIGHT)


def infer_exits(
    lanes: dict[str, Lane], names: Iterable[str] | None = None
) -> dict[str, list[str]]:
    """Returns the successors by geometry of the lanes `names`, by default of all.

    A lane follows where another ends, in nearly the same direction and, where heights
    are known, on the same level. Lanes that begin together do not follow each other,
    however short they are.
    """
    if not lanes:
        return {}
    ids = list(lanes)
    ends = ends_of(lanes.values())
    into, out = (
        np.array(
            [tangent_angle(resample(lane.points, 1.0))[at] for lane in lanes.values()]
        )
        for at in (0, -1)
    )
    tree = cKDTree(ends.first)
    number = {name: index for index, name in enumerate(ids)}
    exits = {}
    for name in ids if names is None else names:
        lane = number[name]
        other = np.array(tree.query_ball_point(ends.last[lane], JOIN_GAP), int)
        gap = np.linalg.norm(ends.first[other] - ends.last[lane], axis=1)
        follows = (other != lane) & (np.abs(wrap(into[other] - out[lane])) < JOIN_ANGLE)
        follows &= gap <= np.linalg.norm(ends.first[other] - ends.first[lane], axis=1)
        follows &= _level(ends, np.full_like(other, lane), other=other)
        exits[name] = [ids[index] for index in other[follows]]
    return exits


def drivable_exits(lanes: dict[str, Lane]) -> tuple[dict[str, list[str]], Counter[str]]:
    """Returns the successors of lanes, and what was left out of those recorded or
    inferred beside them.

    A lane without a recorded successor that can be driven has those that geometry
    shows.
    """
    repairs: Counter[str] = Counter()
    number = {name: index for index, name in enumerate(lanes)}
    recorded = [
        (name, other)
        for name, lane in lanes.items()
        for other in dict.fromkeys(lane.exits)
    ]
    repairs[ITSELF] = sum(name == other for name, other in recorded)
    known = [
        (number[name], number[other])
        for name, other in recorded
        if other in number and other != name
    ]
    repairs[ABSENT] = len(recorded) - len(known) - repairs[ITSELF]
    lane, other = np.array(known, int).reshape(-1, 2).T
    kept = drivable(ends_of(lanes.values()), lane, other=other)
    repairs[UNDRIVABLE] = int((~kept).sum())
    ids = list(lanes)
    exits: dict[str, list[str]] = {name: [] for name in lanes}
    for first, second in zip(lane[kept], other[kept], strict=True):
        exits[ids[first]].append(ids[second])
    inferred = infer_exits(lanes, [name for name, nexts in exits.items() if not nexts])
    repairs[INFERRED] = sum(map(len, inferred.values()))
    return exits | inferred, +repairs


def adjacent(
    lanes: dict[str, Lane], lines: dict[str, np.ndarray]
) -> tuple[dict[str, Lane], Counter[str]]:
    """Returns lanes with at most one neighbour on each side, and how often that is not
    the first one recorded.

    It is the nearest recorded one that runs beside the lane in its direction, or else
    one that parts from it: some maps name the branches of a fork neighbours. lines: the
    lanes' centrelines with points every 1 m.
    """
    repairs: Counter[str] = Counter()
    angle = {name: tangent_angle(line) for name, line in lines.items()}

    def lateral(name: str, other: str) -> float:
        distance = _lateral(
            lines[name], angle[name], other=lines[other], other_angle=angle[other]
        )
        if np.isnan(
            distance
        ):  # the other may be short, between two places that were compared
            distance = -_lateral(
                lines[other], angle[other], other=lines[name], other_angle=angle[name]
            )
        return distance

    def nearest(name: str, recorded: list[str], side: int) -> list[str]:
        others = [
            other
            for other in dict.fromkeys(recorded)
            if other in lanes and other != name
        ]
        if not others:
            return []
        away = np.array([side * lateral(name, other) for other in others])
        room = [
            (plausible_width(lanes[name].width) + plausible_width(lanes[other].width))
            / 2
            for other in others
        ]
        near = (away > -BESIDE) & (away < np.array(room) + SPARE)
        apart = near & (away > BESIDE)
        least = away[apart].min(initial=np.inf)
        chosen = np.flatnonzero(
            (apart & (away < least + BESIDE)) if apart.any() else near
        )[:1]
        repairs[NOT_ADJACENT] += chosen.tolist() != [0]
        return [others[index] for index in chosen]

    kept = {
        name: replace(
            lane,
            left=nearest(name, lane.left, side=1),
            right=nearest(name, lane.right, side=-1),
        )
        for name, lane in lanes.items()
    }
    return kept, +repairs


def _lateral(
    line: np.ndarray, angle: np.ndarray, other: np.ndarray, other_angle: np.ndarray
) -> float:
    """Median distance [m], left positive, of a line [Q, 2] beside a line [P, 2] with
    points every 1 m; NaN where it runs nowhere beside it in the same direction."""
    rows = np.linspace(0, len(line) - 1, SAMPLES).round().astype(int)
    point = line[rows] @ [1, 1j]
    direction = np.exp(1j * angle[rows])
    offset = (other @ [1, 1j] - point[:, None]) * direction.conj()[:, None]
    nearest = np.abs(offset).argmin(1)
    offset = offset[np.arange(len(rows)), nearest]
    beside = (np.abs(offset.real) < LEVEL_WITH) & (
        np.abs(wrap(other_angle[nearest] - angle[rows])) < PARALLEL
    )
    return float(np.median(offset.imag[beside])) if beside.any() else np.nan
