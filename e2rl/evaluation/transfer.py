"""Attacks that were made against one planner, driven against others: sets of attacks, and
the matrix planner x set (docs/guide/compare.md)."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product, starmap
from pathlib import Path
from statistics import median
from typing import Any

import torch

from e2rl.driving.batches import Batch, split_tasks
from e2rl.driving.setup import Method, Setup, Task, scene_seed
from e2rl.evaluation.plan import Evaluation
from e2rl.evaluation.rollout_files import NUMBER, nans, read_json, write_json
from e2rl.evaluation.summary import UNKNOWN
from e2rl.metrics.errored import lost
from e2rl.metrics.realism import NO_SAMPLES
from e2rl.metrics.statistics import summarise
from e2rl.run.errors import InputError
from e2rl.run.files import misfit, write_atomically
from e2rl.run.parts import read_state, state_bytes
from e2rl.run.run import read_provenance
from e2rl.scenes.scene import SceneSet, content_hash
from e2rl.scenes.scene_list import read_list, scene_hashes
from e2rl.search.tries_file import TRIES_FILE, failures_of
from e2rl.sim.rollout_file import ROLLOUTS, Rollout, rollout_name
from e2rl.traffic.attack_replay import AttackReplay, AttackTracks

FORMAT = "e2rl-attacks/1"
ENDING = ".attacks"  # of the file of a set
CROSS_FILE = "cross.json"
KEPT = {"preventable": "cfr_preventable", "hit": "cfr", "all": ""}  # columns that are 1
# of rollouts.csv, what is kept of each attack
ATTACK = {
    **dict.fromkeys(("scene_id", "method"), str),
    "seed": int,
    **dict.fromkeys(("eta", "cfr", "cfr_preventable"), float),
    **dict.fromkeys(("transport_adversary", "transport_others"), float),
}
REPLAY = "replay"
AGAIN = "again"
MODES = {REPLAY: "against", AGAIN: "again"}  # how methods' names begin
RATES = {"hit": "cfr", "preventable": "cfr_preventable"}
RATE = dict.fromkeys(("mean", "low", "high", "n"), NUMBER)
MATRIX = {
    "egos": [str],
    "sets": [{"name": str, "ego": str, "attacks": int, "scenes": int, "nats": NUMBER}],
    "cells": [{"mode": str, "set": str, "ego": str, **dict.fromkeys(RATES, RATE)}],
}


@dataclass(frozen=True)
class AttackSet:
    """Attacks that were made against one planner.

    Args:
        ego: the planner.
        rows: of each attack what ATTACK names.
        tracks: what they drove.
        scenes: SHA-256 of each scene.
        origin: versions, weights, data and command that they were made by.
    """

    ego: str
    rows: list[dict[str, Any]]
    tracks: AttackTracks
    scenes: dict[str, str]
    origin: dict[str, str]

    @classmethod
    def of_run(
        cls, run: Path, rows: Sequence[Mapping], begun: Path
    ) -> "list[AttackSet]":
        """Returns a set for each planner in rows of rollouts.csv.

        Args:
            run: folder of the rollouts' files.
            rows: of the attacks, none of which errored.
            begun: folder with the list of scenes and the provenance of the run.

        Raises:
            InputError: where a file is missing, damaged or of another version.
        """
        provenance = read_provenance(begun)
        origin = {"command": provenance["command"], **provenance["versions"][-1]}
        for kind in ("inputs", "files"):
            texts = provenance[kind].items()
            origin |= {name: text for name, text in texts if isinstance(text, str)}
        hashes = {line.scene_id: line.sha256 or "" for line in read_list(begun)}
        by_ego: dict[str, list[Mapping]] = {}
        for row in rows:
            by_ego.setdefault(row["ego_policy"], []).append(row)
        return [
            cls(
                ego,
                [{name: row[name] for name in ATTACK} for row in attacks],
                tracks=tracks_of(run / ROLLOUTS, attacks),
                scenes={row["scene_id"]: hashes[row["scene_id"]] for row in attacks},
                origin=origin,
            )
            for ego, attacks in by_ego.items()
        ]

    @classmethod
    def read(cls, path: Path) -> "AttackSet":
        """Returns the set in a file; InputError where a byte of it changed, or it is
        none."""
        mend = "give a file of e2rl export RUN --to attacks"
        try:
            content = read_state(path)
            if content.pop("format") != FORMAT:
                raise ValueError(f"not of format {FORMAT}")
            tracks = AttackTracks(**content.pop("tracks"))
            attacks = cls(tracks=tracks, **content)
            shape = {"ego": str, "rows": [ATTACK], "scenes": {...: str}}
            if reason := misfit(vars(attacks), shape):
                raise ValueError(reason)
            attacks.check_shapes()
        except (ValueError, TypeError, LookupError, AttributeError) as error:
            raise InputError(f"{path}: no set of attacks ({error}); {mend}") from error
        return attacks

    def check_shapes(self) -> None:
        """Raises ValueError where the tracks are not those of the rows."""
        count, frames, agents, _ = self.tracks.states.shape
        shapes = {
            "states": ((count, frames, agents, 4), torch.float32),
            "valid": ((count, frames, agents), torch.bool),
            "adversaries": ((count, agents), torch.bool),
            "routes": ((count, agents), torch.int64),
            "nats": ((count, 2), torch.float32),
        }
        for name, expected in shapes.items():
            value = getattr(self.tracks, name)
            if (tuple(value.shape), value.dtype) != expected or count != len(self.rows):
                raise ValueError(f"{name} has shape {list(value.shape)}")

    def write(self, path: Path) -> Path:
        """Write its file, which begins with the hash of its content; returns the path."""
        content = vars(self) | {"format": FORMAT, "tracks": vars(self.tracks)}
        write_atomically(path, state_bytes(content))
        return path

    @property
    def digest(self) -> str:
        """SHA-256 of the tracks."""
        arrays = {name: value.numpy() for name, value in vars(self.tracks).items()}
        return content_hash(arrays)

    def tasks(self, scenes: SceneSet) -> list[Task]:
        """Returns a rollout for each attack, whose seed is its number in the set.
        Raises InputError where its scene is not there or another one."""
        hashes = dict(zip(scenes.scene_id, scene_hashes(scenes), strict=True))
        for name, sha256 in self.scenes.items():
            if hashes.get(name) != sha256:
                raise InputError(
                    f"attacks on {self.ego}: scene {name} is not in the data, or another "
                    "there; give the data, data.build and num_scenes of their run"
                )
        return [
            Task(scenes.index(row["scene_id"]), seed=number, noise=number)
            for number, row in enumerate(self.rows)
        ]


def kept(rows: Sequence[Mapping], keep: str) -> list[Mapping]:
    """Returns the rows of rollouts that have a file, and of these those of KEPT."""
    ended = [row for row in rows if row["errored"] != 1]
    return [row for row in ended if not KEPT[keep] or row[KEPT[keep]] == 1]


def tracks_of(folder: Path, rows: Sequence[Mapping]) -> AttackTracks:
    """Returns what attacks drove, from their rollouts' files; InputError as
    `AttackSet.of_run`."""
    arrays: dict[str, list] = {name: [] for name in ("states", "valid", "adversaries")}
    arrays["routes"] = []
    for row in rows:
        path = folder / rollout_name(row)
        rollout = Rollout.read(path, folder)
        if rollout.routes is None:
            raise InputError(
                f"{path}: holds no routes, of an older version; make its run again"
            )
        for name, values in arrays.items():
            values.append(torch.from_numpy(getattr(rollout, name)))
    nats = [[row["transport_adversary"], row["transport_others"]] for row in rows]
    stacked = {name: torch.stack(values) for name, values in arrays.items()}
    return AttackTracks(**stacked, nats=torch.tensor(nats, dtype=torch.float32))


def named(sets: Sequence[AttackSet]) -> dict[str, AttackSet]:
    """Returns the sets by the names of their planners, further ones of one planner with
    a number."""
    result: dict[str, AttackSet] = {}
    for attacks in sets:
        count = sum(other.ego == attacks.ego for other in result.values())
        name = f"{attacks.ego}-{count + 1}" if count else attacks.ego
        result[name] = attacks
    return result


def replays(plan: Evaluation, sets: Mapping[str, AttackSet]) -> list[Batch]:
    """Returns every planner in the traffic of every set, which drives as it did. Raises
    InputError for other scenes than those of the set, or of other sizes."""
    batches: list[Batch] = []
    for name, attacks in sets.items():
        tasks = attacks.tasks(plan.scenes)
        frames, agents = attacks.tracks.valid.shape[1:]
        scenes = plan.scenes.scenes["logged_valid"]
        if (frames, agents) != tuple(scenes.shape[1:]):
            raise InputError(
                f"attacks on {attacks.ego}: have {frames} frames of {agents} agents, the "
                f"scenes {list(scenes.shape[1:])}; set data.build as in their run"
            )
        method = Method(f"{MODES[REPLAY]}-{name}", AttackReplay(attacks.tracks))
        batches += batches_of(plan.setups, method, tasks)
    return batches


def batches_of(
    setups: Sequence[Setup], method: Method, tasks: Sequence[Task]
) -> Iterator[Batch]:
    """Yields tasks of one method against every planner."""
    for setup in setups:
        for part in split_tasks(tasks, setup.batch):
            yield Batch(setup, method, part)


def made_again(
    plan: Evaluation, sets: Mapping[str, AttackSet], found: Path
) -> list[Batch]:
    """Returns the attacks of every set made anew against every planner, in the same
    scenes, with the same noise and decisions.

    Args:
        plan: that the attacks were found by.
        sets: by name.
        found: folder of their tries, where they were searched for.
    """
    batches: list[Batch] = []
    for (name, attacks), setup in product(sets.items(), plan.setups):
        numbers = {
            (row["method"], row["eta"], row["scene_id"], row["seed"]): number
            for number, row in enumerate(attacks.rows)
        }
        searched = {row["method"] for row in attacks.rows}
        first = once_each(plan, setup)
        for search in plan.searches:
            if search.name in searched:
                first += failures_of(
                    found / TRIES_FILE, attacks.ego, method=search, setup=setup
                )
        for batch in first:
            method = batch.method
            tasks = []
            for task in batch.tasks:
                scene_id = plan.scenes.scene_id[task.scene]
                key = (method.name, method.eta, scene_id, task.seed)
                if key in numbers:
                    tasks.append(task._replace(seed=numbers[key]))
            again = replace(method, name=f"{MODES[AGAIN]}-{name}")
            if tasks:
                batches += batches_of([setup], again, tasks)
    return batches


def once_each(plan: Evaluation, setup: Setup) -> list[Batch]:
    """Returns the rollouts of a planner that a plan without a budget drives."""
    numbers = plan.scenes.number
    tasks = [
        Task(scene, seed, noise=scene_seed(numbers[scene], seed))
        for seed in plan.settings.seeds
        for scene in plan.work.scenes(setup)
    ]
    return [Batch(setup, method, tasks) for method in plan.methods]


# --- the matrix


@dataclass(frozen=True)
class Matrix:
    """How often every planner fails under the attacks of every set, content of
    CROSS_FILE.

    Args:
        egos: the planners that drive.
        sets: `name`, planner, number of attacks and of their scenes, median of nats.
        cells: RATES of each of `egos` under each set, by mode. Where the set or the ego
            is "": of all together, but for planners under their own attacks.
    """

    egos: list[str]
    sets: list[dict[str, Any]]
    cells: list[dict[str, Any]]

    @classmethod
    def of(
        cls,
        egos: Sequence[str],
        sets: Mapping[str, AttackSet],
        rows: Sequence[Mapping],
    ) -> "Matrix":
        """Returns the matrix of rollouts.

        Args:
            egos: the planners that drive.
            sets: by name.
            rows: of rollouts.csv, their methods named after modes and sets.
        """
        cells = []
        for mode, beginning in MODES.items():
            names = {f"{beginning}-{name}": name for name in sets}
            driven = [
                (names[row["method"]], row["ego_policy"], row)
                for row in rows
                if row["method"] in names and not lost(row)
            ]
            for name, ego in product((*sets, ""), (*egos, "")) if driven else ():
                chosen = [
                    row
                    for source, driver, row in driven
                    if name in ("", source)
                    and ego in ("", driver)
                    and ((name and ego) or sets[source].ego != driver)
                ]
                identity = {"mode": mode, "set": name, "ego": ego}
                cells.append(identity | rates_of(chosen))
        return cls(list(egos), list(starmap(facts_of, sets.items())), cells)

    @classmethod
    def read(cls, run: Path) -> "Matrix":
        """Returns the matrix in a run's folder; InputError where its file is
        damaged."""
        content = read_json(run / CROSS_FILE, lambda value: misfit(value, MATRIX))
        sets, cells = (list(map(nans, content[name])) for name in ("sets", "cells"))
        return cls(content["egos"], sets, cells)

    def write(self, run: Path) -> None:
        """Write CROSS_FILE into a run's folder."""
        write_json(run / CROSS_FILE, vars(self))

    def rate(self, mode: str, name: str, ego: str, event: str) -> dict[str, float]:
        """Returns one of RATES of a cell."""
        for cell in self.cells:
            if (cell["mode"], cell["set"], cell["ego"]) == (mode, name, ego):
                return cell[event]
        return UNKNOWN


def facts_of(name: str, attacks: AttackSet) -> dict[str, Any]:
    """Returns what the matrix says of a set."""
    return {
        "name": name,
        "ego": attacks.ego,
        "attacks": len(attacks.rows),
        "scenes": len(attacks.scenes),
        "nats": median(attacks.tracks.nats.sum(1).tolist()),
        "origin": attacks.origin,
    }


def rates_of(rows: Sequence[Mapping]) -> dict[str, dict[str, float]]:
    """Returns RATES of rollouts with intervals over their places."""
    if not rows:
        return dict.fromkeys(RATES, UNKNOWN)
    metrics = summarise(rows, [NO_SAMPLES] * len(rows), realism_draws=0)
    return {event: metrics[column] for event, column in RATES.items()}
