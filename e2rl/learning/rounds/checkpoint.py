"""Checkpoints of an evolution run: all state that later rounds depend on, written
atomically.

A checkpoint is a folder checkpoints/round-000002 of state.pt (optimiser, curriculum,
sampler, counters, generators, and which rounds are in memory, whose traffic stays in
memory/ beside checkpoints/; read with weights_only) and actor.safetensors (weights and
observation statistics; also what `ego.checkpoint` takes). It is sealed by the hashes of
these files: a torn or altered one is noticed, and the one before it is used.
"""

import io
import shutil
import sys
from pathlib import Path

import torch

from e2rl.learning.generators import generator_states, restore_generators
from e2rl.learning.rounds.evolution import Evolution
from e2rl.planners.actor import ActorEgo
from e2rl.planners.network import WEIGHTS
from e2rl.run.errors import InputError
from e2rl.run.files import (
    altered,
    check_format,
    misfit,
    read_regular,
    seal,
    written_whole,
)
from e2rl.run.parts import load_plain

STATE = "state.pt"
FORMAT = "e2rl-checkpoint/13"


def save_checkpoint(folder: Path, run: Evolution, keep_last: int = 2) -> Path:
    """Write checkpoints/round-<rounds done> under a run's folder; only the keep_last
    newest are kept, and of the memory the files that these name."""
    parent = Path(folder) / "checkpoints"
    target = parent / f"round-{run.round:06d}"
    with written_whole(target) as part:
        _write(part, run)
        shutil.rmtree(target, ignore_errors=True)
    folders = sorted(parent.glob("round-*"))
    for old in folders[:-keep_last]:
        shutil.rmtree(old)
    states = [
        load_plain(read_regular(whole / STATE, within=whole))
        for whole in folders[-keep_last:]
        if altered(whole) is None
    ]
    rounds = [entry["round"] for state in states for entry in state["memory"]]
    run.memory.prune(min(rounds, default=0))  # files that no checkpoint names
    return target


def _write(folder: Path, run: Evolution) -> None:
    """The files of a checkpoint, sealed."""
    state = io.BytesIO()  # a full disk is an OSError then
    content = {"format": FORMAT, "memory": run.memory.index(), "run": run.state_dict()}
    torch.save(content | {"generators": generator_states()}, state)
    (folder / STATE).write_bytes(state.getbuffer())
    if isinstance(run.ego, ActorEgo):
        run.ego.network.save(folder / WEIGHTS)
    seal(folder)


def checkpoints(path: str | Path) -> list[Path]:
    """The checkpoint folders that `path` names, the oldest first: itself, or those of a
    run's folder."""
    path = Path(path)
    return (
        [path] if (path / STATE).is_file() else sorted(path.glob("checkpoints/round-*"))
    )


def rounds_done(path: str | Path | None) -> int:
    """Rounds of the newest checkpoint that `path` names; 0 without one."""
    folders = checkpoints(path) if path else []
    return int(folders[-1].name.rpartition("-")[2]) if folders else 0


def load_checkpoint(path: str | Path, run: Evolution) -> int:
    """Restore a run built from the same configuration, generators last; returns the
    rounds done.

    Of a run's folder it is the newest checkpoint that is whole; those that are not are
    named on stderr. Raises InputError where none is, and for one of another
    configuration or version.
    """
    damages = []
    for folder in reversed(checkpoints(path)):
        try:
            state = _whole(folder, run)
        except InputError as error:
            damages.append(str(error))
            print(f"passed over: {error}", file=sys.stderr)
            continue
        _restore(folder, state, run=run)
        return run.round
    missing = (
        f"{path}: holds no checkpoint; "
        "give a run's folder or one of its checkpoints/round-*"
    )
    raise InputError(damages[0] if damages else missing)


def _whole(folder: Path, run: Evolution) -> dict:
    """The state in a checkpoint, and its memory restored; InputError where either is
    damaged."""
    file = folder / STATE
    if name := altered(folder):
        raise InputError(
            f"{folder / name}: missing or damaged; resume from an older checkpoint"
        )
    try:
        state = load_plain(read_regular(file, within=folder))
        written = state["format"]
    except Exception as error:  # a stranger's pickle can raise any exception
        raise InputError(
            f"{file}: damaged ({type(error).__name__}); resume from an older checkpoint"
        ) from error
    check_format(file, written, expected=FORMAT, mend="begin a new run")
    if wrong := misfit(state, {"memory": [{"round": int, "crc32": int}]}):
        raise InputError(f"{file}: damaged ({wrong}); resume from an older checkpoint")
    run.memory.restore(state["memory"])
    return state


def _restore(folder: Path, state: dict, run: Evolution) -> None:
    """Weights, learner, curriculum and generators of a whole checkpoint."""
    if isinstance(run.ego, ActorEgo):
        run.ego.network.load(folder / WEIGHTS)
    try:
        run.load_state_dict(state["run"])
        restore_generators(state["generators"])
    except InputError:
        raise
    except (
        LookupError,
        ValueError,
        TypeError,
        AttributeError,
        RuntimeError,
        ArithmeticError,
    ) as error:
        raise InputError(
            f"{folder / STATE}: its learner is of another kind or shape ({error}); "
            "resume with the configuration of its run"
        ) from None
