"""MCAP files of Foxglove's scene updates, to watch in Foxglove or Lichtblick (extra
`mcap`; docs/guide/export.md).

Topics are foxglove.SceneUpdate, but for /tf, a foxglove.FrameTransform:

| topic | messages |
| --- | --- |
| /map | at the start: centrelines of lanes, borders of the drivable area |
| /traffic | every step, whole: boxes of all agents, lights, the contact |
| /plans | every replan: plans of the ego and the adversaries, where there are some |
| /tf | every step: the frame `ego` in `map`, to follow it |

Time begins at 0 at the start frame. The facts of the rollout are the metadata record
`e2rl`.
"""

import io
import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from matplotlib.colors import to_rgba
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema

from e2rl.report import drawing
from e2rl.report.export.episode import Episode
from e2rl.report.export.scenarionet_writer import HEIGHT
from e2rl.report.failure_tracks import role_of
from e2rl.report.picture import contact_point
from e2rl.run.files import write_atomically
from e2rl.scenes.recording import LIGHT_GREEN, LIGHT_RED, LIGHT_YELLOW
from e2rl.traffic.traffic import REPLAN_STEPS

MAP = "map"  # a frame
EGO = "ego"  # a frame in it
LIGHTS = {
    LIGHT_RED: drawing.CONTACT,
    LIGHT_YELLOW: drawing.VULNERABLE,
    LIGHT_GREEN: "#2e8b57",
}
COLOURS = {
    "ego": drawing.EGO,
    "adversary": drawing.ADVERSARY,
    "traffic": drawing.BACKGROUND,
    "pedestrian": drawing.VULNERABLE,
    "cyclist": drawing.VULNERABLE,
    "replayed": drawing.REPLAYED,
}
ALL = 1  # of foxglove.SceneEntityDeletion.Type
LINE_LIST = 2  # of foxglove.LinePrimitive.Type
SECOND = 1_000_000_000  # ns
KINDS: dict[str, Any] = {  # of messages, by topic
    "/map": SceneUpdate,
    "/traffic": SceneUpdate,
    "/plans": SceneUpdate,
    "/tf": FrameTransform,
}
Entity = dict[str, Any]  # of foxglove.SceneEntity


def write(
    episodes: Iterable[Episode], folder: Path, open_ego: bool = False
) -> Iterator[tuple[Episode, Path]]:
    """Write NAME.mcap of each episode."""
    for episode in episodes:
        path = folder / f"{episode.path.stem}.mcap"
        write_atomically(path, content(episode))
        yield episode, path


def content(episode: Episode) -> bytes:
    """The file of an episode."""
    buffer = io.BytesIO()
    writer = Writer(buffer, compression=CompressionType.ZSTD)
    writer.start(profile="", library="e2rl")
    schemas = {
        kind: register_schema(writer, kind) for kind in (SceneUpdate, FrameTransform)
    }
    channels = {
        topic: writer.register_channel(topic, "protobuf", schemas[kind])
        for topic, kind in KINDS.items()
    }
    for step, topic, fields in messages(episode):
        time = round(step * episode.rollout.dt * SECOND)
        message = KINDS[topic](**stamped(fields, time))
        content = message.SerializeToString(deterministic=True)
        writer.add_message(channels[topic], time, content, time, sequence=step)
    facts = {name: str(value) for name, value in episode.facts.items()}
    writer.add_metadata("e2rl", facts)
    writer.finish()
    return buffer.getvalue()


def stamped(fields: dict[str, Any], time: int) -> dict[str, Any]:
    """The fields of a message with their time [ns]; a scene update takes the place of
    the last one of its topic."""
    stamp = {"timestamp": {"seconds": time // SECOND, "nanos": time % SECOND}}
    if "entities" not in fields:
        return fields | stamp
    return {
        "deletions": [{"type": ALL} | stamp],
        "entities": [entity | stamp for entity in fields["entities"]],
    }


def messages(episode: Episode) -> Iterator[tuple[int, str, dict[str, Any]]]:
    """(step, topic, fields of the message) in the order of time."""
    rollout = episode.rollout
    borders = [np.concatenate([ring, ring[:1]]) for ring in rollout.polygons()]
    lanes = lines("lanes", rollout.lanes(), colour=drawing.BACKGROUND)
    edges = lines("borders", borders, colour="black")
    yield 0, "/map", {"entities": [lanes, edges]}
    for step in range(episode.steps + 1):
        yield step, "/traffic", {"entities": list(traffic(episode, step))}
        number, rest = divmod(step, REPLAN_STEPS)
        if rollout.plans is not None and rest == 0 and number < len(rollout.plans):
            yield step, "/plans", {"entities": list(plans(episode, number))}
        place, rotation = pose_of(rollout.states[step, 0])
        yield (
            step,
            "/tf",
            {
                "parent_frame_id": MAP,
                "child_frame_id": EGO,
                "translation": place,
                "rotation": rotation,
            },
        )


def traffic(episode: Episode, step: int) -> Iterator[Entity]:
    """Everybody who is there at a step, the lights at the beginning of their lanes, and
    the contact."""
    for row in np.flatnonzero(episode.rollout.valid[step]).tolist():
        yield agent(episode, step, row=row)
    if episode.lights:
        lights = [
            (episode.lanes[name].points[0], LIGHTS[int(states[step])], 1.0)
            for name, states in episode.lights.items()
            if int(states[step]) in LIGHTS
        ]
        yield spheres("lights", lights)
    if episode.facts.get("contact_step") == step and "partner" in episode.facts:
        place = contact_point(episode.rollout, step, partner=episode.facts["partner"])
        yield spheres("contact", [(place, drawing.CONTACT, 1.5)])


def plans(episode: Episode, number: int) -> Iterator[Entity]:
    """The plans of a replan."""
    rollout = episode.rollout
    step = number * REPLAN_STEPS
    assert rollout.planners is not None and rollout.plans is not None
    for row, path in zip(rollout.planners.tolist(), rollout.plans[number], strict=True):
        if rollout.valid[step, row] and np.isfinite(path).all():
            whole = np.concatenate([rollout.states[step, row, :2][None], path])
            colour = drawing.EGO if row == 0 else drawing.ADVERSARY
            yield lines(f"plan of {row}", [whole], colour=colour)


def agent(episode: Episode, step: int, row: int) -> Entity:
    """The box of an agent, with what it is."""
    rollout = episode.rollout
    length, width = episode.size(row)
    kind = str(rollout.agent_type[row])
    role = role_of(rollout, row)
    part = role if role in ("ego", "adversary") else kind
    height = HEIGHT[kind]
    place, rotation = pose_of(rollout.states[step, row], z=height / 2)
    cube = {
        "pose": {"position": place, "orientation": rotation},
        "size": {"x": length, "y": width, "z": height},
        "color": rgba(COLOURS[role]),
    }
    pairs = [
        {"key": "part", "value": part},
        {"key": "speed", "value": f"{rollout.states[step, row, 3]:.2f} m/s"},
    ]
    return {"id": f"agent {row}", "frame_id": MAP, "cubes": [cube], "metadata": pairs}


def spheres(name: str, parts: Sequence[tuple[np.ndarray, str, float]]) -> Entity:
    """Spheres at (place, colour, size), 2 m above the ground."""
    spheres = [
        {
            "pose": {"position": {"x": float(x), "y": float(y), "z": 2.0}},
            "size": dict.fromkeys("xyz", size),
            "color": rgba(colour),
        }
        for (x, y), colour, size in parts
    ]
    return {"id": name, "frame_id": MAP, "spheres": spheres}


def lines(name: str, paths: Sequence[np.ndarray], colour: str) -> Entity:
    """Polylines, piece by piece."""
    pieces = [
        {"x": float(x), "y": float(y)}
        for path in paths
        for pair in pairwise(path)
        for x, y in pair
    ]
    line = {
        "type": LINE_LIST,
        "thickness": 0.2,
        "points": pieces,
        "color": rgba(colour),
        "pose": {"orientation": {"w": 1}},
    }
    return {"id": name, "frame_id": MAP, "lines": [line]}


def pose_of(
    state: np.ndarray, z: float = 0.0
) -> tuple[dict[str, float], dict[str, float]]:
    """The place of a state, and its rotation about the vertical."""
    x, y, heading = state[:3].tolist()
    half = heading / 2
    return {"x": x, "y": y, "z": z}, {"z": math.sin(half), "w": math.cos(half)}


def rgba(colour: str) -> dict[str, float]:
    """A colour of matplotlib's as Foxglove's."""
    return dict(zip("rgba", to_rgba(colour), strict=True))
