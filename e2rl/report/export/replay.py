"""What a viewer replays of an episode: boxes, the lines of its map and of plans, speeds
and gaps. `mcap_writer` and `rerun_writer` write it, each in its format."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.colors import to_rgba

from e2rl.report import drawing
from e2rl.report.export.episode import Episode
from e2rl.report.failure_tracks import (
    IN_ITS_PLACE,
    Track,
    channels_of,
    other_egos,
    track_of,
)
from e2rl.traffic.traffic import REPLAN_STEPS

COLOURS: dict[str, drawing.Colour] = {  # by the role of a track
    "ego": drawing.EGO,
    "adversary": drawing.ADVERSARY,
    "traffic": drawing.BACKGROUND,
    "replayed": drawing.REPLAYED,
    "cyclist": drawing.VULNERABLE,
    "pedestrian": drawing.VULNERABLE,
    "driver": (drawing.DRIVER, 0.4),
    "evasion": (drawing.EVASION, 0.4),
    "recorded": (drawing.EGO, 0.4),
}
WIDTH = 0.15  # m, of a line


@dataclass(frozen=True)
class Box:
    """A box in motion over the K = T + 1 steps of an episode.

    role: as of a Track; colour: [4] in [0, 1]; size: [3] m, length, width, height;
    centre: [K, 3] m; rotation: [K, 4], unit quaternions x, y, z, w; present: [K] bool;
    series: by name [K], `speed` m/s, and, of the ego and who else is in its place, the
    `gap` m to its partner, NaN where either is absent.
    """

    name: str
    role: str
    colour: tuple[float, ...]
    size: list[float]
    centre: np.ndarray
    rotation: np.ndarray
    present: np.ndarray
    series: dict[str, np.ndarray]


def times(episode: Episode) -> list[int]:
    """The time [ns] of each step since the start, rounded: writers of both formats cut
    seconds that are floats, so that 4.3 s comes a nanosecond early."""
    seconds = np.arange(episode.steps + 1) * episode.rollout.dt
    return np.rint(seconds * 1e9).astype(np.int64).tolist()


def boxes(episode: Episode) -> list[Box]:
    """The box of each agent, the ego's first."""
    return [
        _box(
            episode,
            track_of(episode.rollout, row, episode.steps + 1),
            name=episode.name(row),
            height=episode.height(row),
        )
        for row in episode.agents
    ]


def alternatives(episode: Episode) -> list[Box]:
    """The boxes of others in the ego's place, each by the name of its role."""
    return [
        _box(episode, track, name=track.role, height=episode.height(0))
        for track in other_egos(episode.rollout, episode.steps + 1)
    ]


def curves(episode: Episode, members: list[Box]) -> list[Box]:
    """Boxes whose series are shown: `members`, and the partner's again under that name,
    which views may know beforehand."""
    row = episode.facts.get("partner")
    name = None if row is None else episode.name(row)
    partner = [replace(box, name="partner") for box in members if box.name == name]
    return [*members, *partner]


def map_lines(episode: Episode) -> list[tuple[np.ndarray, tuple[float, ...]]]:
    """The lines [P, 3] m of the map with their colours: borders of drivable areas and
    centrelines."""
    rings = [np.vstack([ring, ring[:1]]) for ring in episode.rollout.polygons()]
    borders = [(_flat(ring), to_rgba(drawing.REPLAYED)) for ring in rings]
    lanes = episode.rollout.lanes()
    return borders + [(_flat(lane), to_rgba(drawing.MUTED)) for lane in lanes]


def plans(episode: Episode) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """(step, by agent the points [P, 3] m) of each time that the ego and adversaries
    planned; agents that were absent are left out."""
    rollout = episode.rollout
    if rollout.plans is None or rollout.planners is None:
        return
    for number, points in enumerate(rollout.plans):
        step = number * REPLAN_STEPS
        yield (
            step,
            {
                episode.name(row): _flat(plan)
                for row, plan in zip(rollout.planners.tolist(), points, strict=True)
                if rollout.valid[step, row]
            },
        )


def _flat(points: np.ndarray) -> np.ndarray:
    """Points [P, 2] at height 0, [P, 3]."""
    return np.pad(points.astype(np.float64), ((0, 0), (0, 1)))


def _box(episode: Episode, track: Track, name: str, height: float) -> Box:
    """The box of a track.

    Args:
        episode: of the track.
        track: over all steps.
        name: of the box.
        height: of the box [m].
    """
    partner = int(episode.facts.get("partner", -1))
    other = track
    if partner >= 0:
        other = track_of(episode.rollout, partner, episode.steps + 1)
    x, y, heading, speed, _, gap = channels_of(track, other)
    zero = np.zeros_like(heading)
    series = {"speed": np.where(track.present, speed, np.nan)}
    if partner >= 0 and track.role in IN_ITS_PLACE:
        series["gap"] = np.where(track.present & other.present, gap, np.nan)
    return Box(
        name=name,
        role=track.role,
        colour=to_rgba(COLOURS[track.role]),
        size=[*map(float, track.size), height],
        centre=np.stack([x, y, zero + height / 2], -1),
        rotation=np.stack([zero, zero, np.sin(heading / 2), np.cos(heading / 2)], -1),
        present=track.present,
        series=series,
    )
