"""The rollouts of a run that ended without a score (e2rl/traffic/attempt.py): their file, and what they mean for it."""

import json
from collections.abc import Sequence
from pathlib import Path

from e2rl.errors import InputError
from e2rl.files import write_atomically
from e2rl.traffic.attempt import summary_of

ENDED_FILE = "ended.json"


def write_ended(path: Path, ended: Sequence[dict]) -> None:
    """Write ended.json, where rollouts ended without a score; remove an older one where none did."""
    if ended:
        write_atomically(path, json.dumps(list(ended), indent=1))
    else:
        path.unlink(missing_ok=True)


def add_ended(path: Path, number: int, ended: Sequence[dict]) -> None:
    """Write the entries of round `number` of a training into its ended.json, after those of earlier rounds; a resumed
    run repeats some. A damaged file is begun anew."""
    try:
        known = json.loads(path.read_text()) if path.is_file() else []
        earlier = [entry for entry in known if entry["round"] < number]
    except (OSError, ValueError, TypeError, KeyError):
        earlier = []
    write_ended(path, [*earlier, *ended])


def require_rows(rows: Sequence[dict], ended: Sequence[dict], folder: Path | None) -> None:
    """InputError where all rollouts ended without a score."""
    if rows or not ended:
        return
    where = f"; {folder / ENDED_FILE} has the tracebacks" if folder is not None else ""
    raise InputError(f"no rollout could be scored: {summary_of(ended)}{where}; mend the planner or the traffic")
