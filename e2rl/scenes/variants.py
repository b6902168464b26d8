"""Variants of a log: as recorded, in a mirror, or with what other converters leave out or get wrong (`data.variants`).

A policy that learns one converter's conventions fails on another's. Each variant takes one thing away, so that a
measurement shows what a policy leans on, and a training on several leans on none.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from e2rl.run.errors import InputError
from e2rl.scenes.recording import VEHICLE, Lane, Recording

RECORDED, MARK = "recorded", "~"  # the log itself; stands before the variant in the ids of all others
PARKED = 1.0  # m that a vehicle moves at most while it counts as parked
HEADING_NOISE = 0.05  # rad, standard deviation of disturbed headings, one draw a track
SHIFT = 0.5  # m by which a shifted map lies beside its tracks
CROP = 50.0  # m around the ego's path that a cropped map holds


def check_variants(names: Sequence[str]) -> None:
    """Raises InputError for a variant that is not known, and where there is none."""
    if not names:
        raise InputError(f"data.variants: none; name one of {', '.join((RECORDED, *VARIANTS))}")
    for part in (part for name in names for part in name.split("+")):
        if part not in (RECORDED, *VARIANTS):
            raise InputError(f"data.variants: {part!r} is none of {', '.join((RECORDED, *VARIANTS))}")


def variant_of(recording: Recording, name: str) -> Recording:
    """The variant of a log, whose id ends in its name unless it is the log itself; `a+b` is b of a."""
    if name == RECORDED:
        return recording
    made = recording
    for part in name.split("+"):
        made = VARIANTS.get(part, lambda log: log)(made)
    return replace(made, scene_id=f"{recording.scene_id}{MARK}{name}")


def mirrored(recording: Recording) -> Recording:
    """The traffic in a mirror, y to -y: who turned left turns right, and left-hand traffic keeps right."""
    mirror = np.array([1.0, -1.0])
    lanes = {
        name: replace(lane, points=lane.points * mirror, left=lane.right, right=lane.left)
        for name, lane in recording.lanes.items()
    }
    states = recording.states * np.array([1.0, -1.0, -1.0, 1.0])
    return replace(recording, states=states, lanes=lanes, drivable=[ring * mirror for ring in recording.drivable])


def _lanes(change: Callable[[Lane], Lane]) -> Callable[[Recording], Recording]:
    def changed(recording: Recording) -> Recording:
        return replace(recording, lanes={name: change(lane) for name, lane in recording.lanes.items()})

    return changed


def unlit(recording: Recording) -> Recording:
    """Without traffic lights."""
    return replace(recording, lights={})


def unparked(recording: Recording) -> Recording:
    """Without parked vehicles."""
    xy, valid = recording.states[..., :2], recording.valid[..., None]
    low, high = np.where(valid, xy, np.inf).min(0), np.where(valid, xy, -np.inf).max(0)
    moves = np.linalg.norm(high - low, axis=-1) > PARKED
    keep = moves | (recording.agent_type != VEHICLE) | ~recording.valid.any(0)
    keep[recording.ego] = True
    return _of_tracks(recording, keep, int(keep[: recording.ego].sum()))


def turned(recording: Recording) -> Recording:
    """With headings that are off by HEADING_NOISE, all along a track."""
    noise = np.asarray(_draws(recording).normal(0.0, HEADING_NOISE, recording.valid.shape[1]))
    noise[recording.ego] = 0.0
    states = recording.states.copy()
    states[..., 2] += noise
    return replace(recording, states=states)


def shifted(recording: Recording) -> Recording:
    """With a map that lies SHIFT beside its tracks, in a direction of the log's own."""
    angle = _draws(recording).uniform(0.0, 2 * np.pi)
    step = SHIFT * np.array([np.cos(angle), np.sin(angle)])
    moved = _lanes(lambda lane: replace(lane, points=lane.points + step))(recording)
    return replace(moved, drivable=[ring + step for ring in recording.drivable])


def cropped(recording: Recording) -> Recording:
    """With the lanes that come within CROP of the ego's path alone."""
    path = recording.states[recording.valid[:, recording.ego], recording.ego, :2]
    low, high = path.min(0) - CROP, path.max(0) + CROP
    cut = {
        name: _cut(lane, ((lane.points > low) & (lane.points < high)).all(1)) for name, lane in recording.lanes.items()
    }
    lanes = {name: lane for name, lane in cut.items() if len(lane.points) > 1}
    lights = {name: light for name, light in recording.lights.items() if name in lanes}
    return replace(recording, lanes=lanes, lights=lights)


def other_ego(recording: Recording) -> Recording:
    """With another vehicle as ego: that which drives farthest of those recorded throughout."""
    whole = recording.valid.all(0) & (recording.agent_type == VEHICLE)
    driven = np.linalg.norm(np.diff(recording.states[..., :2], axis=0), axis=-1).sum(0)
    whole[recording.ego] = False
    return replace(recording, ego=int(np.where(whole, driven, -1.0).argmax())) if whole.any() else recording


VARIANTS: dict[str, Callable[[Recording], Recording]] = {
    "mirrored": mirrored,
    "unconnected": _lanes(lambda lane: replace(lane, exits=[], left=[], right=[])),
    "unlit": unlit,
    "unlimited": _lanes(lambda lane: replace(lane, speed_limit=0.0)),
    "unmeasured": _lanes(lambda lane: replace(lane, width=0.0)),
    "unparked": unparked,
    "turned": turned,
    "shifted": shifted,
    "cropped": cropped,
    "other_ego": other_ego,
}
"""Variants by name; `unconnected`: lanes without successors and neighbours, `unlimited`: without speed limits,
`unmeasured`: without widths."""


def _draws(recording: Recording) -> np.random.Generator:
    """Random numbers of a log's own."""
    return np.random.default_rng(list(recording.scene_id.encode()))


def _cut(lane: Lane, inside: np.ndarray) -> Lane:
    """The lane's first vertices, one after another, that are inside."""
    first = int(inside.argmax())
    last = first + int(np.append(inside[first:], False).argmin())
    heights = None if lane.heights is None else lane.heights[first:last]
    return replace(lane, points=lane.points[first:last], heights=heights)


def _of_tracks(recording: Recording, keep: np.ndarray, ego: int) -> Recording:
    """The recording with the tracks keep [A] bool alone."""
    kept = {name: getattr(recording, name)[:, keep] for name in ("states", "valid")}
    return replace(recording, **kept, size=recording.size[keep], agent_type=recording.agent_type[keep], ego=ego)
