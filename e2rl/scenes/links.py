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
from numpy import ndarray
from scipy.spatial import cKDTree

from e2rl.scenes.paths import (
    resample,
    tangent_angle,
    wrap,
)
from e2rl.scenes.recording import Lane

JOIN_GAP = 1.5  # m between ends where a link is inferred
JOIN_ANGLE = 0.6  # rad there
JOIN_HEIGHT = 2.0  # m there
LINK_GAP = 5.0  # m along the lane of a link that is recorded
LINK_ANGLE = 1.0  # rad there
END = 2.0  # m over which the direction of a lane's end is measured
SAMPLES = 9  # points of a lane where its neighbours are looked for
LEVEL_WITH = 1.5  # m along: a point of a neighbour is beside a point of the lane
PARALLEL = 0.6  # rad between both there
BESIDE = 0.5  # m between lanes that do not overlap
SPARE = 2.0  # m that may lie between the borders of neighbours
WIDTHS = (2.5, 6.0)  # m that a recorded width may be
WIDTH = 3.7  # m of other lanes
# phrases of `repairs`
ABSENT = "links to lanes that are not in the map left out"
ITSELF = "links of lanes to themselves left out"
UNDRIVABLE = "links that cannot be driven left out"
INFERRED = "missing links inferred from geometry"
NOT_ADJACENT = "neighbours that are not the adjacent lane replaced or left out"


def plausible_width(width: float) -> float:
    """A recorded lane width, or WIDTH where it is none: half of Waymo's connectors have
    0, some 90 m."""
    return float(width) if WIDTHS[0] <= width <= WIDTHS[1] else WIDTH


class Ends(NamedTuple):
    """Where lanes [N] begin and end.

    first, last [N, 2] m; into, out [N] rad: directions there, over END m; start, end
    [N] rad: directions of the first and last metre; low, high [N] m: heights there, NaN
    unknown; width [N] m.
    """

    first: ndarray
    last: ndarray
    into: ndarray
    out: ndarray
    start: ndarray
    end: ndarray
    low: ndarray
    high: ndarray
    width: ndarray


def ends_of(lanes: Iterable[Lane]) -> Ends:
    """Returns the ends of lanes."""
    rows = []
    for lane in lanes:
        line = resample(lane.points, 1.0)
        near = min(int(END), len(line) - 1)
        chords = np.array([line[near] - line[0], line[-1] - line[-1 - near]])
        angle = tangent_angle(line)
        heights = [np.nan] if lane.heights is None else lane.heights
        rows.append(
            [
                *line[0],
                *line[-1],
                *np.arctan2(chords[:, 1], chords[:, 0]),
                angle[0],
                angle[-1],
                heights[0],
                heights[-1],
                plausible_width(lane.width),
            ]
        )
    columns = np.array(rows, float).reshape(-1, 11).T
    return Ends(columns[:2].T, columns[2:4].T, *columns[4:])


def drivable(
    ends: Ends,
    lane: ndarray,
    other: ndarray,
) -> ndarray:
    """Whether a vehicle can drive from the end of lanes [Q] into others [Q], both
    indices.

    The other begins at most LINK_GAP m before or behind the end, less than half a lane
    beside it, less than LINK_ANGLE turned, which smoothing makes the tightest turn of a
    car, and on the same level.
    """
    x, y = (ends.first[other] - ends.last[lane]).T
    cos = np.cos(ends.out[lane])
    sin = np.sin(ends.out[lane])
    along = np.abs(x * cos + y * sin)
    across = np.abs(y * cos - x * sin)
    half = np.minimum(ends.width[lane], ends.width[other]) / 2
    turn = np.abs(wrap(ends.into[other] - ends.out[lane]))
    near = (along <= LINK_GAP) & (across < half)
    return near & (turn < LINK_ANGLE) & _level(ends, lane, other)


def _level(
    ends: Ends,
    lane: ndarray | int,
    other: ndarray,
) -> ndarray:
    """Whether lanes [Q] end at the height at which others [Q] begin, as far as that is
    known."""
    return ~(np.abs(ends.low[other] - ends.high[lane]) >= JOIN_HEIGHT)


def drivable_exits(lanes: dict[str, Lane]) -> tuple[dict[str, list[str]], Counter[str]]:
    """Returns the successors of lanes, and what was left out of those recorded or
    inferred beside them.

    A lane without a recorded successor that can be driven has those that geometry
    shows: a lane follows where another ends, in nearly the same direction and, where
    heights are known, on the same level. Lanes that begin together do not follow each
    other, however short they are.
    """
    repairs: Counter[str] = Counter()
    exits: dict[str, list[str]] = {name: [] for name in lanes}
    if not lanes:
        return exits, repairs
    ids = list(lanes)
    number = {name: index for index, name in enumerate(ids)}
    links = [
        (name, other)
        for name, lane in lanes.items()
        for other in dict.fromkeys(lane.exits)
    ]
    repairs[ITSELF] = sum(name == other for name, other in links)
    repairs[ABSENT] = sum(other not in number for _, other in links)
    pairs = [
        (number[name], number[other])
        for name, other in links
        if other in number and other != name
    ]
    lane, other = np.array(pairs, int).reshape(-1, 2).T
    ends = ends_of(lanes.values())
    fits = drivable(ends, lane, other)
    repairs[UNDRIVABLE] = int((~fits).sum())
    for first, second in zip(lane[fits], other[fits], strict=True):
        exits[ids[first]].append(ids[second])
    tree = cKDTree(ends.first)
    for name, nexts in exits.items():
        if not nexts:
            nexts += [ids[index] for index in _followers(ends, tree, number[name])]
            repairs[INFERRED] += len(nexts)
    return exits, +repairs


def _followers(
    ends: Ends,
    tree: cKDTree,
    lane: int,
) -> ndarray:
    """Indices of the lanes that follow one by geometry; tree: of their beginnings."""
    last = ends.last[lane]
    other = np.array(tree.query_ball_point(last, JOIN_GAP), int)
    gap = np.linalg.norm(ends.first[other] - last, axis=1)
    turn = np.abs(wrap(ends.start[other] - ends.end[lane]))
    apart = np.linalg.norm(ends.first[other] - ends.first[lane], axis=1)
    follows = (other != lane) & (turn < JOIN_ANGLE) & (gap <= apart)
    return other[follows & _level(ends, lane, other)]


def adjacent(
    lanes: dict[str, Lane], lines: dict[str, ndarray]
) -> tuple[dict[str, Lane], Counter[str]]:
    """Returns lanes with at most one neighbour on each side, and how often that is not
    the first one recorded.

    It is the nearest recorded one that runs beside the lane in its direction, or else
    one that parts from it: some maps name the branches of a fork neighbours. lines: the
    lanes' centrelines with points every 1 m.
    """
    repairs: Counter[str] = Counter()
    angle = {name: tangent_angle(line) for name, line in lines.items()}
    sampled = {name: _sampled(line, angle[name]) for name, line in lines.items()}

    def lateral(name: str, other: str) -> float:
        return _lateral(sampled[name], lines[other], angle[other])

    def nearest(
        name: str,
        recorded: list[str],
        side: int,
    ) -> list[str]:
        others = [
            other
            for other in dict.fromkeys(recorded)
            if other in lanes and other != name
        ]
        if not others:
            return []
        width = plausible_width(lanes[name].width)
        room = [(width + plausible_width(lanes[other].width)) / 2 for other in others]
        offset = np.array([lateral(name, other) for other in others])
        # the other may be short, between two places that were compared
        for row in np.flatnonzero(np.isnan(offset)):
            offset[row] = -lateral(others[row], name)
        offset *= side
        near = (offset > -BESIDE) & (offset < np.array(room) + SPARE)
        apart = near & (offset > BESIDE)
        if apart.any():
            near = apart & (offset < offset[apart].min() + BESIDE)
        chosen = np.flatnonzero(near)[:1].tolist()
        repairs[NOT_ADJACENT] += chosen != [0]
        return [others[index] for index in chosen]

    neighboured = {
        name: replace(
            lane,
            left=nearest(name, lane.left, side=1),
            right=nearest(name, lane.right, side=-1),
        )
        for name, lane in lanes.items()
    }
    return neighboured, +repairs


class Sampled(NamedTuple):
    """SAMPLES points of a line, evenly chosen: complex, with unit tangent and angle."""

    point: ndarray
    unit: ndarray
    angle: ndarray


def _sampled(line: ndarray, angle: ndarray) -> Sampled:
    rows = np.linspace(0, len(line) - 1, SAMPLES).round().astype(int)
    return Sampled(line[rows] @ [1, 1j], np.exp(1j * angle[rows]), angle[rows])


def _lateral(line: Sampled, other: ndarray, other_angle: ndarray) -> float:
    """Median distance [m], left positive, of a line [Q, 2] with points every 1 m beside
    another; NaN where it runs nowhere beside it in the same direction."""
    offset = (other @ [1, 1j] - line.point[:, None]) * line.unit.conj()[:, None]
    nearest = np.abs(offset).argmin(1)
    offset = offset[np.arange(SAMPLES), nearest]
    parallel = np.abs(wrap(other_angle[nearest] - line.angle)) < PARALLEL
    beside = (np.abs(offset.real) < LEVEL_WITH) & parallel
    if not beside.any():
        return np.nan
    apart = np.sort(offset.imag[beside])
    middle = len(apart) // 2  # `np.median` takes eight times as long of so few
    return float((apart[middle] + apart[-1 - middle]) / 2)
