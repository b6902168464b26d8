"""MCAP files with Foxglove's schemas, by foxglove-sdk (extra `mcap`;
docs/guide/export.md).

A message of /traffic, /alternatives or /plans is the whole picture of its time, and
deletes what was there before, so a player may seek.
"""

from collections.abc import Iterable, Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from foxglove import Channel, Context, open_mcap
from foxglove.channels import FrameTransformChannel, SceneUpdateChannel
from foxglove.messages import (
    Color,
    CubePrimitive,
    FrameTransform,
    KeyValuePair,
    LinePrimitive,
    Point3,
    Pose,
    Quaternion,
    SceneEntity,
    SceneEntityDeletion,
    SceneEntityDeletionType,
    SceneUpdate,
    Timestamp,
    Vector3,
)

from e2rl.report.export.episode import EGO, Episode
from e2rl.report.export.replay import (
    WIDTH,
    Box,
    alternatives,
    boxes,
    curves,
    map_lines,
    plans,
    times,
)
from e2rl.run.files import write_atomically

LAYOUT = "foxglove_layout.json"
FRAME = "scene"
ALL = SceneEntityDeletionType.All
MOTION = {"type": "object", "title": "e2rl.Motion"}
FACTS = {"type": "object", "title": "e2rl.Facts"}


def write(
    episodes: Iterable[Episode],
    folder: Path,
    open_ego: bool = False,
) -> Iterator[tuple[Episode, Path]]:
    """Write NAME.mcap of each episode, and a layout for Foxglove."""
    layout = files("e2rl") / "assets" / "export" / LAYOUT
    write_atomically(folder / LAYOUT, layout.read_bytes())
    for episode in episodes:
        path = folder / f"{episode.path.stem}.mcap"
        context = Context()
        with open_mcap(path, context=context):
            log_episode(episode, context)
        yield episode, path


def log_episode(episode: Episode, context: Context) -> None:
    """Log the messages of an episode to the file of a context."""
    moments = times(episode)
    traffic = boxes(episode)
    others = alternatives(episode)
    shown = curves(episode, [*traffic, *others])
    scenes = {
        name: SceneUpdateChannel(f"/{name}", context=context)
        for name in ("map", "traffic", "alternatives", "plans")
    }
    frames = FrameTransformChannel("/tf", context=context)
    motion = Channel("/motion", schema=MOTION, context=context)
    Channel("/verdict", schema=FACTS, context=context).log(episode.facts, log_time=0)
    lines = [line_of(points, colour) for points, colour in map_lines(episode)]
    scenes["map"].log(picture([entity("map", 0, lines=lines)], 0), log_time=0)
    for step, moment in enumerate(moments):
        for name, group in (("traffic", traffic), ("alternatives", others)):
            entities = [
                entity_of(box, step, moment) for box in group if box.present[step]
            ]
            scenes[name].log(picture(entities, moment), log_time=moment)
        frames.log(frame_of(traffic[0], step, moment), log_time=moment)
        values = {box.name: values_of(box, step) for box in shown}
        motion.log(values, log_time=moment)
    colours = {box.name: box.colour for box in traffic}
    for step, plan in plans(episode):
        moment = moments[step]
        entities = [
            entity(name, moment, lines=[line_of(points, colours[name])])
            for name, points in plan.items()
        ]
        scenes["plans"].log(picture(entities, moment), log_time=moment)


def values_of(box: Box, step: int) -> dict[str, float]:
    """The series of a box at a step, those that have a value: the SDK would write NaN
    as such, which is no JSON."""
    values = {name: float(series[step]) for name, series in box.series.items()}
    return {name: value for name, value in values.items() if np.isfinite(value)}


def picture(entities: list[SceneEntity], moment: int) -> SceneUpdate:
    """All that a topic shows from a moment on."""
    before = SceneEntityDeletion(type=ALL, timestamp=timestamp(moment))
    return SceneUpdate(deletions=[before], entities=entities)


def entity_of(box: Box, step: int, moment: int) -> SceneEntity:
    """A box at a step."""
    length, width, height = box.size
    cube = CubePrimitive(
        pose=Pose(position=vector(box.centre[step]), orientation=rotation(box, step)),
        size=Vector3(x=length, y=width, z=height),
        color=colour_of(box.colour),
    )
    role = KeyValuePair(key="role", value=box.role)
    return entity(box.name, moment, cubes=[cube], metadata=[role])


def entity(name: str, moment: int, **parts: Any) -> SceneEntity:
    """An entity in the scene's frame."""
    return SceneEntity(
        id=name,
        frame_id=FRAME,
        timestamp=timestamp(moment),
        **parts,
    )


def line_of(points: np.ndarray, colour: tuple[float, ...]) -> LinePrimitive:
    """A line through points [P, 3] m."""
    vertices = [Point3(x=x, y=y, z=z) for x, y, z in points.tolist()]
    return LinePrimitive(points=vertices, thickness=WIDTH, color=colour_of(colour))


def frame_of(ego: Box, step: int, moment: int) -> FrameTransform:
    """Where the ego's frame is at a step: in the middle of its box, x ahead."""
    return FrameTransform(
        timestamp=timestamp(moment),
        parent_frame_id=FRAME,
        child_frame_id=EGO,
        translation=vector(ego.centre[step]),
        rotation=rotation(ego, step),
    )


def timestamp(moment: int) -> Timestamp:
    """A time in ns."""
    return Timestamp(*divmod(moment, 10**9))


def vector(point: np.ndarray) -> Vector3:
    """A point [3] m."""
    x, y, z = point.tolist()
    return Vector3(x=x, y=y, z=z)


def rotation(box: Box, step: int) -> Quaternion:
    """That of a box at a step."""
    x, y, z, w = box.rotation[step].tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def colour_of(colour: tuple[float, ...]) -> Color:
    """A colour [4] in [0, 1]."""
    red, green, blue, opacity = colour
    return Color(r=red, g=green, b=blue, a=opacity)
