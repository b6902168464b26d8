"""The readers of files and messages that strangers may have written, each with a
strategy of its inputs."""

import json
import pickle
import socket
import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hypothesis import strategies as st
from omegaconf import OmegaConf

from e2rl.evaluation.modes import read_modes
from e2rl.evaluation.rollout_files import read_metrics, read_rows
from e2rl.metrics.score import score_rollouts
from e2rl.planners.ego_errors import PlannerError
from e2rl.planners.external import ExternalEgo, plans_of
from e2rl.planners.planner_link import PlannerLink
from e2rl.planners.planner_messages import ACTION, FAILED, TRAJECTORY, message
from e2rl.planners.plausibility import drivable
from e2rl.report.tables import metric_tables
from e2rl.run.config import load_config
from e2rl.run.errors import InputError
from e2rl.run.parts import read_state, state_bytes
from e2rl.run.trust import CONFIG, leaves, saved_configuration
from e2rl.scenes.builder import BuildSettings
from e2rl.scenes.scenarionet import ScenarioNetSource, safe_load
from e2rl.scenes.scene_list import read_list
from e2rl.sim.rollouts import Rollouts
from tests.scenes.descriptions import description
from tools.fuzz_commands import called, commands, started
from tools.fuzz_inputs import (
    ARRAYS,
    HOSTILE,
    PLAIN,
    damaged,
    hostile,
    mutated,
    require,
    stored,
    with_program,
)

MOST = 1 << 26  # bytes that a small input may become
SMALL = BuildSettings(steps=20, vehicles=4, others=2, vertices=40, field_cells=32)
CELLS = (int, float, bool, str, bytes, bytearray, complex, type(None), np.generic)
Reader = tuple[st.SearchStrategy[bytes], Callable[[bytes], Any]]


class Readers:
    """The readers by name, with inputs made of a finished run in `folder`/run."""

    NAMES = (
        "pickles",
        "descriptions",
        "tables",
        "rollouts",
        "parts",
        "configurations",
        "planner_replies",
        "commands",
        "scripts",
    )

    def __init__(self, folder: Path, data: str | None) -> None:
        self.folder = folder
        self.mark = folder / "mark"
        self.data = [description()]
        if data:
            source = ScenarioNetSource(data)
            self.data = [
                safe_load(source.content(log), log) for log in source.logs()[:8]
            ]

    def file(self, name: str, content: bytes) -> Path:
        path = self.folder / "inputs" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        return path

    def pickles(self) -> Reader:
        whole = [
            pickle.dumps(scene, protocol)
            for scene in self.data[:3]
            for protocol in (0, 2, 4)
        ]
        inputs = st.sampled_from(whole).flatmap(damaged) | hostile(str(self.mark))
        return inputs, lambda content: require_plain(
            safe_load(content, "input"), 40 * MOST
        )

    def descriptions(self) -> Reader:
        def read(content: bytes) -> None:
            logs = self.file("logs/input.pkl", content).parent
            cache = self.folder / "scenes"
            scenes = ScenarioNetSource(
                str(logs), build=SMALL, workers=1, cache=str(cache)
            ).load()
            for name, value in scenes.scenes.items():
                require(
                    not value.is_floating_point() or bool(value.isfinite().all()),
                    f"{name} is not finite",
                )

        return st.sampled_from(self.data).flatmap(
            lambda data: mutated(data, PLAIN | ARRAYS)
        ).map(pickle.dumps), read

    def tables(self) -> Reader:
        """The tables of a run: metrics, failure modes, rollouts, scenes."""
        run = self.folder / "run"
        readers = {
            "metrics.json": lambda path: metric_tables(read_metrics(path)),
            "modes.json": read_modes,
        }
        readers |= {"rollouts.csv": read_rows, "scenes.csv": read_list}

        def inputs(name: str) -> st.SearchStrategy[bytes]:
            content = (run / name).read_bytes()
            found = damaged(content)
            if name.endswith(".json"):
                found |= mutated(json.loads(content)).map(json.dumps).map(str.encode)
            return found.map(lambda content: name.encode() + b"\n" + content)

        def read(content: bytes) -> None:
            name, _, rest = content.partition(b"\n")
            readers[name.decode()](self.file(name.decode(), rest))

        return st.sampled_from(sorted(readers)).flatmap(inputs), read

    def rollouts(self) -> Reader:
        path = sorted((self.folder / "run" / "rollouts").glob("*.npz"))[0]
        with np.load(path) as whole:
            data = dict(whole)

        def read(content: bytes) -> None:
            rollouts = Rollouts.from_npz(self.file("input.npz", content))
            known = rollouts.valid
            driven = rollouts.states[rollouts.valid]
            require(known.shape == rollouts.states.shape[:3], "states of other agents")
            require(
                bool(driven.isfinite().all() and (driven.abs() < 200_000).all()),
                "no place or speed",
            )
            score_rollouts(rollouts)

        return damaged(path.read_bytes()) | mutated(
            data, ARRAYS | st.floats() | st.text(max_size=9)
        ).map(stored), read

    def parts(self) -> Reader:
        """Finished parts and checkpoints: torch's format after a hash, which a stranger
        can make anew."""
        value = [
            {"scene_id": "a", "cfr": 0.5, "seed": 1},
            [torch.arange(5.0), torch.zeros(3, 2)],
        ]
        whole = state_bytes(value)

        def read(content: bytes) -> None:
            try:
                read_state(self.file("part.pt", content))
            except ValueError as error:  # the part is done again
                raise InputError(str(error)) from error

        return damaged(whole) | hostile(str(self.mark)).map(
            partial(with_program, whole)
        ), read

    def configurations(self) -> Reader:
        """The configuration of a run that is resumed: none may name code outside of
        e2rl."""
        whole = (self.folder / "run" / CONFIG).read_bytes()
        plain = OmegaConf.to_container(OmegaConf.create(whole.decode()))
        given = load_config("evaluate", ["resume=input"])
        folder = self.folder / "inputs" / "resumed"

        def read(content: bytes) -> None:
            self.file(f"resumed/{CONFIG}", content)
            saved = OmegaConf.to_container(
                saved_configuration(given, folder, "resume=input")
            )
            named = [(key, str(value)) for key, value in leaves(saved)]
            code = [
                value
                for key, value in named
                if "_target_" in key and not value.startswith("e2rl.")
            ]
            code += [value for _, value in named if "${" in value and ":" in value]
            require(not code, f"it names {code[:1]}")

        starts = st.just(
            {
                "_target_": "e2rl.planners.external.ExternalEgo",
                "command": f"touch {self.mark}",
            }
        )
        changed = mutated(plain, PLAIN | HOSTILE | starts).map(
            lambda data: OmegaConf.to_yaml(OmegaConf.create(data))
        )
        return damaged(whole) | changed.map(str.encode), read

    def commands(self) -> Reader:
        """Commands on a stranger's folder, called in this process."""
        return commands(self.folder, str(self.mark), called)

    def scripts(self) -> Reader:
        """The same, each in a process of its own."""
        return commands(self.folder, str(self.mark), started)

    def planner_replies(self) -> Reader:
        """Bytes that an outside planner answers with."""
        odd = st.sampled_from([0.0, 1e9, float("nan"), -3.0, float("inf"), 0.5])
        rows = st.sampled_from([0, 1, 2, 7]).map(partial(struct.pack, "<I"))
        action = st.tuples(rows, odd).map(
            lambda g: message(ACTION, g[0] + struct.pack("<2f", g[1], 0.1))
        )
        failed = rows.map(lambda row: message(FAILED, row + b"lost \xff"))
        plan = st.tuples(
            rows, st.sampled_from([50, 5, 4, 0]), st.sampled_from([0, 2**31]), odd
        ).map(
            lambda g: message(
                TRAJECTORY,
                g[0]
                + struct.pack("<I", g[1] or g[2])
                + g[1] * struct.pack("<4f", 0.1, g[3], 0.0, 1.0),
            )
        )
        replies = st.lists(action | plan | failed, min_size=1, max_size=4).map(b"".join)
        now = torch.tensor(
            [[0.0, 0.0, 0.3, 8.0], [5.0, 1.0, -2.0, 0.0], [9.0, 9.0, 0.0, 20.0]]
        )

        def read(content: bytes) -> None:
            ours, theirs = socket.socketpair()
            link = PlannerLink.__new__(PlannerLink)
            link.buffer = bytearray()
            link._socket = ours
            link._process = None
            link._name = "input"
            link.close = ours.close  # type: ignore[method-assign]
            ego = ExternalEgo(command="true", timeout=0.05)
            ego._link = link
            with ours, theirs:
                theirs.sendall(content)
                theirs.shutdown(socket.SHUT_WR)
                try:
                    plans = plans_of(now, ego._ask(b"x", len(now)), steps=5)
                except PlannerError as error:
                    require(
                        all(0 <= row < len(now) for row in error.rows),
                        "a scene that was not asked for",
                    )
                    raise InputError(str(error)) from error
            whole = torch.full((len(now),), plans.shape[1])
            require(
                bool(drivable(now, plans, length=whole).all()),
                "a plan that no vehicle drives",
            )

        return replies | replies.flatmap(damaged), read


def require_plain(data: Any, most: int) -> None:
    """Garbage where data hold anything but containers, numbers, text and arrays, or are
    larger than `most` bytes."""
    size = 0
    waiting = [data]
    seen = set()
    while waiting:
        value = waiting.pop()
        if id(value) in seen:
            continue
        seen.add(id(value))
        if isinstance(value, np.ndarray):
            size += value.nbytes
            waiting += list(value.flat) if value.dtype.kind == "O" else []
        elif isinstance(value, dict | list | tuple | set | frozenset):
            waiting += [*value, *value.values()] if isinstance(value, dict) else value
        else:
            require(isinstance(value, CELLS), f"a {type(value).__name__}")
            size += len(value) if isinstance(value, str | bytes) else 8
        require(size <= most, "more than its bytes can say")
