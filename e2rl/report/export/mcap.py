"""MCAP files of Foxglove's scene updates, to watch in Foxglove or Lichtblick (extra `mcap`; docs/export.md).

| topic | schema | messages |
| --- | --- | --- |
| /map | foxglove.SceneUpdate | at the start: centrelines of lanes, borders of the drivable area |
| /traffic | foxglove.SceneUpdate | every step, whole: boxes of all agents, lights, the contact |
| /plans | foxglove.SceneUpdate | every replan: plans of the ego and the adversaries, where the rollout has them |
| /tf | foxglove.FrameTransform | every step: the frame `ego` in `map`, to follow it |
| /ego | JSON | every step: speed [m/s], acceleration [m/s^2], and the gap to the partner of a contact [m], to plot |

Time begins at 0 at the start frame. The facts of the rollout are the metadata record `e2rl`.
"""

import io
import json
import math
from collections.abc import Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.colors import to_rgba

from e2rl.report import drawing
from e2rl.report.export.episode import Episode
from e2rl.report.export.scenarionet_writer import HEIGHT
from e2rl.report.picture import contact_point
from e2rl.run.errors import InputError
from e2rl.run.files import write_atomically
from e2rl.scenes.boxes import distance
from e2rl.scenes.recording import LIGHT_GREEN, LIGHT_RED, LIGHT_YELLOW
from e2rl.traffic.traffic import REPLAN_STEPS

MAP, EGO = "map", "ego"  # frames
LIGHTS = {LIGHT_RED: drawing.CONTACT, LIGHT_YELLOW: drawing.VULNERABLE, LIGHT_GREEN: "#2e8b57"}
ALL, LINE_LIST = 1, 2  # of foxglove.SceneEntityDeletion.Type and foxglove.LinePrimitive.Type
SECOND = 1_000_000_000  # ns
NUMBERS = {"type": "object", "properties": {name: {"type": "number"} for name in ("speed", "acceleration", "gap")}}


def write(episodes: Iterable[Episode], folder: Path, open_ego: bool = False) -> Iterator[tuple[Episode, Path]]:
    """Write NAME.mcap of each episode."""
    _check_library()
    for episode in episodes:
        path = folder / f"{episode.path.stem}.mcap"
        write_atomically(path, content(episode))
        yield episode, path


def _check_library() -> None:
    try:
        import foxglove_schemas_protobuf.SceneUpdate_pb2  # noqa: F401
        import mcap.writer  # noqa: F401
        import mcap_protobuf.schema  # noqa: F401
    except ImportError as error:
        reason = f"mcap, mcap-protobuf-support or foxglove-schemas-protobuf cannot be imported ({error})"
        raise InputError(f"--to mcap: {reason}; install e2rl with its extra: pip install 'e2rl[mcap]'") from error


def content(episode: Episode) -> bytes:
    """The file of an episode."""
    from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
    from mcap.writer import CompressionType, Writer
    from mcap_protobuf.schema import register_schema

    buffer = io.BytesIO()
    writer = Writer(buffer, compression=CompressionType.ZSTD)
    writer.start(profile="", library="e2rl")
    update, frame = register_schema(writer, SceneUpdate), register_schema(writer, FrameTransform)
    numbers = writer.register_schema("e2rl.planners", "jsonschema", json.dumps(NUMBERS).encode())
    topics = {"/map": update, "/traffic": update, "/plans": update, "/tf": frame}
    channels = {topic: writer.register_channel(topic, "protobuf", schema) for topic, schema in topics.items()}
    channels["/ego"] = writer.register_channel("/ego", "json", numbers)
    for step, topic, message in messages(episode):
        time = round(step * episode.rollout.dt * SECOND)
        writer.add_message(channels[topic], time, message, time, sequence=step)
    writer.add_metadata("e2rl", {name: str(value) for name, value in episode.facts.items()})
    writer.finish()
    return buffer.getvalue()


def messages(episode: Episode) -> Iterator[tuple[int, str, bytes]]:
    """(step, topic, message) in the order of time."""
    drawn, rollout, told = Drawn(episode), episode.rollout, ego_numbers(episode)
    yield 0, "/map", drawn.road()
    for step in range(episode.steps + 1):
        yield step, "/traffic", drawn.traffic(step)
        if rollout.plans is not None and step % REPLAN_STEPS == 0 and step // REPLAN_STEPS < len(rollout.plans):
            yield step, "/plans", drawn.plans(step // REPLAN_STEPS)
        yield step, "/tf", drawn.frame(step)
        yield step, "/ego", json.dumps({name: values[step] for name, values in told.items()}).encode()


def ego_numbers(episode: Episode) -> dict[str, list[float | None]]:
    """Speed and acceleration of the ego, and its gap to the partner where there is one, at every step; None where a
    number is not known."""
    rollout, partner = episode.rollout, episode.facts.get("partner")
    speed = rollout.states[:, 0, 3].astype(float)
    found = {"speed": speed, "acceleration": np.append(np.diff(speed) / rollout.dt, math.nan)}
    if partner is not None:
        poses = torch.from_numpy(rollout.states[:, [0, partner]]).double()
        sizes = torch.from_numpy(rollout.size[[0, partner]]).double().expand(len(poses), -1, -1)
        gap = distance(poses[:, 0], sizes[:, 0], poses[:, 1], sizes[:, 1]).numpy()
        found["gap"] = np.where(rollout.valid[:, [0, partner]].all(1), gap, math.nan)
    return {name: [None if math.isnan(x) else x for x in values.tolist()] for name, values in found.items()}


class Drawn:
    """The messages of an episode, as bytes."""

    def __init__(self, episode: Episode) -> None:
        self.episode, self.rollout = episode, episode.rollout

    def road(self) -> bytes:
        """Lanes, and borders of the drivable area."""
        lanes, borders = self.rollout.lanes(), self.rollout.polygons()
        closed = [np.concatenate([ring, ring[:1]]) for ring in borders]
        return self._update(
            0, [self._lines("lanes", lanes, drawing.BACKGROUND), self._lines("borders", closed, "black")]
        )

    def traffic(self, step: int) -> bytes:
        """Everybody who is there at a step, the lights and the contact."""
        present = np.flatnonzero(self.rollout.valid[step]).tolist()
        entities = [self._agent(step, row) for row in present]
        if self.episode.lights:
            entities.append(self._lights(step))
        if self.episode.facts.get("contact_step") == step and "partner" in self.episode.facts:
            place = contact_point(self.rollout, step, self.episode.facts["partner"])
            entities.append(self._spheres("contact", [(place, drawing.CONTACT, 1.5)]))
        return self._update(step, entities)

    def plans(self, number: int) -> bytes:
        """The plans of a replan."""
        step, paths = number * REPLAN_STEPS, self.rollout.plans[number]
        entities = []
        for row, path in zip(self.rollout.planners.tolist(), paths, strict=True):
            start = self.rollout.states[step, row, :2]
            colour = drawing.EGO if row == 0 else drawing.ADVERSARY
            if self.rollout.valid[step, row] and np.isfinite(path).all():
                entities.append(self._lines(f"plan of {row}", [np.concatenate([start[None], path])], colour))
        return self._update(step, entities)

    def frame(self, step: int) -> bytes:
        """Where the ego is."""
        from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform

        x, y, heading, _ = self.rollout.states[step, 0].tolist()
        made = FrameTransform(parent_frame_id=MAP, child_frame_id=EGO)
        made.translation.x, made.translation.y = x, y
        made.rotation.z, made.rotation.w = math.sin(heading / 2), math.cos(heading / 2)
        made.timestamp.FromNanoseconds(self._time(step))
        return made.SerializeToString(deterministic=True)

    def _time(self, step: int) -> int:
        return round(step * self.rollout.dt * SECOND)

    def _update(self, step: int, entities: list[Any]) -> bytes:
        """A message in place of the last one of its topic."""
        from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

        made = SceneUpdate()
        made.deletions.add(type=ALL).timestamp.FromNanoseconds(self._time(step))
        for entity in entities:
            entity.timestamp.FromNanoseconds(self._time(step))
        made.entities.extend(entities)
        return made.SerializeToString(deterministic=True)

    def _agent(self, step: int, row: int) -> Any:
        """The box of an agent, with what it is."""
        kind, (length, width) = self.rollout.agent_type[row], self.episode.size(row)
        x, y, heading, speed = self.rollout.states[step, row].tolist()
        made, height = self._entity(f"agent {row}"), HEIGHT[kind]
        pose = {"position": {"x": x, "y": y, "z": height / 2}}
        pose["orientation"] = {"z": math.sin(heading / 2), "w": math.cos(heading / 2)}
        made.cubes.add(pose=pose, size={"x": length, "y": width, "z": height}, color=rgba(self._colour(row)))
        part = "ego" if row == 0 else "adversary" if self.rollout.adversaries[row] else kind
        for key, value in (("part", part), ("speed", f"{speed:.2f} m/s")):
            made.metadata.add(key=key, value=value)
        return made

    def _colour(self, row: int) -> str:
        if row == 0 or self.rollout.adversaries[row]:
            return drawing.EGO if row == 0 else drawing.ADVERSARY
        if self.rollout.agent_type[row] in ("pedestrian", "cyclist"):
            return drawing.VULNERABLE
        return drawing.BACKGROUND if self.rollout.simulated[row] else drawing.REPLAYED

    def _lights(self, step: int) -> Any:
        """A sphere where each lane with a light begins."""
        lit = [(self.episode.lanes[name].points[0], int(states[step])) for name, states in self.episode.lights.items()]
        return self._spheres("lights", [(place, LIGHTS[state], 1.0) for place, state in lit if state in LIGHTS])

    def _spheres(self, name: str, parts: list[tuple[np.ndarray, str, float]]) -> Any:
        made = self._entity(name)
        for (x, y), colour, size in parts:
            position = {"x": float(x), "y": float(y), "z": 2.0}
            made.spheres.add(pose={"position": position}, size=dict.fromkeys("xyz", size), color=rgba(colour))
        return made

    def _lines(self, name: str, paths: list[np.ndarray], colour: str) -> Any:
        made = self._entity(name)
        pieces = [{"x": float(x), "y": float(y)} for path in paths for pair in pairwise(path) for x, y in pair]
        made.lines.add(type=LINE_LIST, thickness=0.2, points=pieces, color=rgba(colour), pose={"orientation": {"w": 1}})
        return made

    def _entity(self, name: str) -> Any:
        from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity

        return SceneEntity(id=name, frame_id=MAP)


def rgba(colour: str) -> dict[str, float]:
    """A colour of matplotlib's as Foxglove's."""
    return dict(zip("rgba", to_rgba(colour), strict=True))
