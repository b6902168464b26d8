"""An episode: one rollout of a run with its map and what is known of its failure, as
every exporter takes it."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from e2rl.evaluation.rollout_files import cell
from e2rl.run.errors import InputError
from e2rl.scenes.boxes import unit_vectors
from e2rl.scenes.builder import BuildSettings, SceneBuilder
from e2rl.scenes.lane_graph import LaneGraph
from e2rl.scenes.recording import Lane, Recording
from e2rl.sim.rollout_file import ROLLOUTS, Failure, Rollout

# Columns of rollouts.csv that go along (docs/reference/verdicts.md, metrics.md there).
FACTS = (
    "dataset",
    "split",
    "location",
    "scene_id",
    "method",
    "ego_policy",
    "eta",
    "seed",
    "cfr",
    "partner",
    "contact_step",
    "contact_type",
    "approach",
    "ego_manoeuvre",
    "partner_manoeuvre",
    "duty",
    "counted",
    "at_fault",
    "preventable",
    "avoidable",
)
EGO = "Ego"  # the name of row 0
LONG = 7.0  # m: longer vehicles are trucks
HEIGHT = {  # m, by kind; rollouts hold none
    "vehicle": 1.6,
    "truck": 3.0,
    "cyclist": 1.75,
    "pedestrian": 1.75,
    "other": 1.0,
}
SAME = 0.01  # m: a map or a start that differs by more is another one


@dataclass(frozen=True)
class Episode:
    """A rollout, its map and its facts. Positions are relative to the scene's origin,
    as in the rollout file.

    path: the rollout file; rollout: its content; facts: FACTS that are known, and
    `adversaries`, rows of agents; lanes: by id, with points every 1 m; lights: lane id
    -> [T + 1] light states. Where the scene is known: `scene`, with `origin` [2] m, its
    place in the recording's coordinates, and `light_past`: lane id -> states of the
    frames before the start, the last one 0.1 s before it.
    """

    path: Path
    rollout: Rollout
    facts: dict[str, Any]
    lanes: dict[str, Lane]
    lights: dict[str, np.ndarray] = field(default_factory=dict)
    light_past: dict[str, np.ndarray] = field(default_factory=dict)
    scene: TensorDict | None = None
    origin: np.ndarray | None = None

    @property
    def steps(self) -> int:
        """Simulated steps T; there are T + 1 states."""
        return len(self.rollout.states) - 1

    @property
    def agents(self) -> list[int]:
        """Rows of the agents that are there at any step; the ego is row 0."""
        return np.flatnonzero(self.rollout.valid.any(0)).tolist()

    def appearances(self, row: int) -> list[tuple[int, int]]:
        """[first, end) steps of each time that an agent is there."""
        edges = np.flatnonzero(
            np.diff(self.rollout.valid[:, row], prepend=False, append=False)
        ).tolist()
        return list(zip(edges[::2], edges[1::2], strict=True))

    def size(self, row: int) -> tuple[float, float]:
        """Length and width [m] of an agent."""
        length, width = self.rollout.size[row].tolist()
        return length, width

    def kind(self, row: int) -> str:
        """One of `recording.AGENT_TYPES`, or truck for a long vehicle."""
        kind = str(self.rollout.agent_type[row])
        truck = kind == "vehicle" and self.rollout.size[row, 0] > LONG
        return "truck" if truck else kind

    def height(self, row: int) -> float:
        """The height [m] of an agent's box."""
        return HEIGHT[self.kind(row)]

    def name(self, row: int) -> str:
        """The name of an agent in files that name them."""
        return EGO if row == 0 else f"agent_{row}"

    def entries(self) -> dict[str, list[str]]:
        """By lane the lanes that lead into it."""
        entries: dict[str, list[str]] = {name: [] for name in self.lanes}
        for name, lane in self.lanes.items():
            for other in lane.exits:
                entries[other].append(name)
        return entries

    def text(self) -> str:
        """The facts in one line."""
        return "; ".join(f"{name}: {value}" for name, value in self.facts.items())


def recorded_episode(
    run: Path,
    row: Mapping,
    recording: Recording,
    build: BuildSettings,
) -> Episode:
    """The episode of a row of rollouts.csv in the scene that a recording makes.

    Args:
        run: folder of the run.
        row: of rollouts.csv.
        recording: of the scene.
        build: settings of scenes, those of the run.

    Raises:
        InputError: where the rollout was driven in another scene.
    """
    bare = rollout_episode(run, row)
    rollout = bare.rollout
    builder = SceneBuilder(recording, build)
    scene = builder.scene(recording)
    graph = builder.graph
    close = partial(np.allclose, rtol=0, atol=SAME)
    same = len(graph.points) == len(rollout.lane_points)
    same &= len(scene["logged"]) == bare.steps + 1
    if same:
        origin = np.round(graph.points[0] - rollout.lane_points[0])
        same = close(graph.points - origin, rollout.lane_points)
        same &= close(scene["start"][0, :2].numpy(), rollout.states[0, 0, :2])
    if not same:
        raise InputError(
            f"{bare.path}: not driven in the scene {row['scene_id']!r} that the data "
            "make now; restore the data and the `data` settings of the run, or pass "
            "--no-scene"
        )
    start = recording.current
    assert start is not None
    frames = np.minimum(start + np.arange(bare.steps + 1), len(recording.states) - 1)
    lights = {
        name: states for name, states in recording.lights.items() if name in graph.lanes
    }
    return replace(
        bare,
        lanes={
            name: _linked(graph, name, lane=lane)
            for name, lane in zip(graph.ids, bare.lanes.values(), strict=True)
        },
        lights={name: states[frames] for name, states in lights.items()},
        light_past={name: states[:start] for name, states in lights.items()},
        scene=scene,
        origin=origin,
    )


def rollout_episode(run: Path, row: Mapping) -> Episode:
    """The episode of a row of rollouts.csv as its file alone has it: lanes without
    links, limits or lights."""
    rollout = Failure.read(run, row).rollout
    pairs = zip(rollout.lanes(), rollout.lane_width.tolist(), strict=True)
    lanes = {
        str(index): Lane(points.astype(float), width)
        for index, (points, width) in enumerate(pairs)
    }
    facts: dict[str, Any] = {}  # those known, as words and plain numbers
    for name in FACTS:
        value = row.get(name, "")
        if cell(value) != "" and not (name == "partner" and value < 0):
            whole = isinstance(value, float) and value.is_integer()
            facts[name] = int(value) if whole else value
    facts["adversaries"] = np.flatnonzero(rollout.adversaries).tolist()
    path = run / ROLLOUTS / rollout.name
    return Episode(path, rollout, facts=facts, lanes=lanes)


def _linked(graph: LaneGraph, name: str, lane: Lane) -> Lane:
    """A lane of a rollout with the links and the limit that the recording's map has."""
    recorded = graph.lanes[name]
    limit = recorded.speed_limit
    return Lane(
        points=lane.points,
        width=lane.width,
        speed_limit=limit if math.isfinite(limit) else 0.0,
        exits=list(graph.graph.successors(name)),
        left=[other for other in recorded.left if other in graph.lanes],
        right=[other for other in recorded.right if other in graph.lanes],
    )


def past_of(episode: Episode) -> Iterator[tuple[int, np.ndarray]]:
    """(row, states [PAST, 4]) of the vehicles before the start, oldest first, as
    traffic and ego were told them.

    The speed is that of the displacement to the next frame, negative where that leads
    backwards.
    """
    if episode.scene is None:
        return
    start = episode.scene["start"].double()
    for row, past in enumerate(episode.scene["past"].double()):
        if not episode.rollout.valid[0, row]:
            continue
        x, y, heading, _ = start[row]
        ahead, left, turned = past.flip(0).T
        cos = heading.cos()
        sin = heading.sin()
        pose = torch.stack(
            [
                x + cos * ahead - sin * left,
                y + sin * ahead + cos * left,
                heading + turned,
            ],
            -1,
        )
        moved = torch.cat([pose[1:], start[row, None, :3]])[:, :2] - pose[:, :2]
        forwards = (moved * unit_vectors(pose[:, 2])).sum(-1, keepdim=True) >= 0
        speed = (
            moved.norm(dim=-1, keepdim=True)
            / episode.rollout.dt
            * (2.0 * forwards - 1.0)
        )
        yield row, torch.cat([pose, speed], -1).numpy()
