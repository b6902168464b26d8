"""Whether a run fits into the machine's memory: an estimate, told before the first rollout.

The constants are peaks of resident memory, measured on Linux with the bundled scenes (docs/robustness.md, `python
benchmarks/run.py --only memory`); they grow with a scene's vehicles and steps. Unknown are outside planners, models and
metrics, and a device's own memory.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from omegaconf import DictConfig

from e2rl.evaluation.protocol import Method
from e2rl.run.errors import InputError
from e2rl.scenes.scene import SceneSet
from e2rl.scenes.scene_cache import PackedRows

MB = 1e6
LIBRARIES = 500 * MB  # of the first process
FORKED = 60 * MB  # of each further one, which shares the first one's scenes and libraries
ROLLOUT, ATTACKED = 3.0 * MB, 5.0 * MB  # of a rollout of 32 vehicles and 80 steps, in nominal and adversarial traffic
KEPT = 0.025 * MB  # of a finished rollout, until the tables
ENVIRONMENT = 1.0 * MB  # of an environment that a policy learns in
DECISION = 0.02 * MB  # of a collected decision, with what the update makes of it
MEMORY_MAX = ("sys/fs/cgroup/memory.max", "sys/fs/cgroup/memory/memory.limit_in_bytes")
MEMORY_NOW = ("sys/fs/cgroup/memory.current", "sys/fs/cgroup/memory/memory.usage_in_bytes")


class Need(NamedTuple):
    """Bytes that a run needs; of what they are made; which settings make them fewer."""

    total: float
    parts: str
    mend: str


class Room(NamedTuple):
    """Bytes of memory that a process may ever have, and that it may have now."""

    most: float
    now: float


def check_fits(need: Need, room: Room | None = None) -> None:
    """InputError for a run that needs more than the machine has; a line on stderr for one that needs more than is free
    now. Nothing where the machine does not tell."""
    room = room or room_here()
    if room is None or need.total <= room.now:
        return
    text = f"memory: the run needs about {need.total / 1e9:.1f} GB ({need.parts})"
    if need.total > room.most:
        raise InputError(f"{text}, this machine has {room.most / 1e9:.1f} GB; set {need.mend}")
    print(f"{text}, {room.now / 1e9:.1f} GB are free; if it is killed, set {need.mend}", file=sys.stderr)


def evaluation_need(
    scenes: SceneSet, methods: Sequence[Method], seeds: int, egos: int, batch: int, processes: int
) -> Need:
    """What the rollouts of every method, seed and ego in the scenes need; processes: that they are spread over."""
    tasks = len(scenes) * seeds
    batch = min(batch, tasks)
    rollout = batch * rollout_bytes(scenes, any(method.eta > 0 for method in methods))
    finished = tasks * len(methods) * egos * KEPT
    own = scene_bytes(scenes) * (processes if isinstance(scenes.rows, PackedRows) else 1)  # each unpacks its own
    total = LIBRARIES + own + finished + processes * rollout + (processes > 1) * processes * FORKED
    parts = f"{len(scenes)} scenes {gb(own)}, {processes} x {batch} rollouts {gb(processes * rollout)}"
    return Need(total, parts, "a smaller batch, fewer processes, or num_scenes")


def training_need(config: DictConfig, scenes: SceneSet, measured: SceneSet, processes: int) -> Need:
    """What rounds of evolution need: collecting and updating beside the synthesis of the next round, or measuring with
    so many processes."""
    batch, round_ = config.batch, config.learner.round.scenes
    attack = min(batch, round_) * rollout_bytes(scenes, True) + FORKED
    collect = config.learner.get("collect")
    learning = attack  # a planner is tuned on as many rollouts
    if collect is not None:
        learning = collect.batch * (size_of(scenes) * ENVIRONMENT + collect.steps * DECISION)
    measuring = processes * (min(batch, len(measured)) * rollout_bytes(measured, True) + FORKED)
    own = scene_bytes(scenes) + scene_bytes(measured)
    parts = f"{len(scenes)} + {len(measured)} scenes {gb(own)}, learning {gb(learning)}, synthesis {gb(attack)}"
    total = LIBRARIES + own + max(learning + attack, measuring)
    return Need(total, parts, "a smaller batch, learner.collect.batch or num_scenes")


def rollout_bytes(scenes: SceneSet, attacked: bool) -> float:
    """Of a rollout while it is driven."""
    return size_of(scenes) * (ATTACKED if attacked else ROLLOUT)


def size_of(scenes: SceneSet) -> float:
    """Vehicles x steps of a scene, relative to the scenes that were measured."""
    scene = scenes.batch([0])
    steps, vehicles = scene["logged"].shape[1] - 1, scene["route_log"].shape[1]
    return max(steps * vehicles / (80 * 32), 0.1)


def scene_bytes(scenes: SceneSet) -> float:
    """Of the tensors of those scenes that a process keeps at once, which are all of one size."""
    kept = scenes.rows.room if isinstance(scenes.rows, PackedRows) else len(scenes)
    return kept * float(sum(value.numel() * value.element_size() for value in scenes.batch([0]).values()))


def gb(size: float) -> str:
    return f"{size / 1e9:.1f} GB" if size >= 1e8 else f"{size / 1e6:.0f} MB"


def room_here(root: Path = Path("/")) -> Room | None:
    """The machine's memory, or the part of it that a container may have; None where it is not told."""
    try:
        lines = [line.split() for line in (root / "proc/meminfo").read_text().splitlines()]
        known = {parts[0].rstrip(":"): int(parts[1]) * 1024.0 for parts in lines if len(parts) > 1}
        most, now = known["MemTotal"], known["MemAvailable"]
    except (OSError, KeyError, ValueError):
        return None
    for limit, usage in zip(MEMORY_MAX, MEMORY_NOW, strict=True):
        try:
            allowed = float((root / limit).read_text())  # "max" is no number
            most, now = min(most, allowed), min(now, allowed - float((root / usage).read_text()))
        except (OSError, ValueError):
            continue
    return Room(most, now)
