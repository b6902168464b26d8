"""The rollouts of a run that ended without a score (e2rl/traffic/attempt.py): their file, and what they mean for it.

Files of a run, written and read: rollouts/*.npz, rollouts.csv, metrics.json (docs/method.md, section 11).

Files are written atomically (`e2rl.run.files.write_atomically`).
"""

import csv
import io
import json
import math
import re
import shlex
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np
from torch import Tensor

import e2rl
from e2rl.metrics.catalogue import WORDS, row_columns
from e2rl.run.errors import InputError
from e2rl.run.files import misfit, write_atomically
from e2rl.scenes.recording import AGENT_TYPES, DT
from e2rl.traffic.attempt import summary_of

FORMAT = "e2rl-rollout/1"
ROLLOUTS, TABLE, METRICS_FILE = "rollouts", "rollouts.csv", "metrics.json"
OPTIONAL = ("ran_light",)  # arrays of a rollout that verdicts use where they are known
SCORE = "python -m e2rl.report.score_files"
NEEDED = ("dataset", "split", "method", "ego_policy", "scene_id", "seed", "eta")
NUMBER = (int, float, NoneType)
INTERVAL = {"low": NUMBER, "high": NUMBER, "n": NUMBER, ...: NUMBER}
METRICS_ROW = {  # what readers of metrics.json need
    **dict.fromkeys(("dataset", "split", "method", "ego"), str),
    **dict.fromkeys(("eta", "n_scenes", "n_seeds", "n_rollouts"), (int, float)),
    "metrics": {...: {"mean": NUMBER, **INTERVAL}},
    "paired": {...: {...: {"difference": NUMBER, **INTERVAL}}},
}
SOMETIMES = {"ended": {...: int}, "stage": (str, NoneType), "git": str, "command": str, "n_trainings": int}
TEXT_COLUMNS = ("dataset", "split", "method", "ego_policy", "scene_id", "location", *WORDS)


@dataclass(frozen=True)
class Source:
    """The source of rollouts: the columns that a rollout dict lacks."""

    dataset: str
    split: str
    method: str
    ego_policy: str


# --- rollouts


def write_rollouts(folder: Path, rollouts: dict, source: Source) -> list[Path]:
    """Write one npz per rollout of a rollout dict into folder/ and return their paths."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for index in range(len(rollouts["states"])):
        arrays: dict[str, Any] = rollout_arrays(rollouts, index, source)
        path = folder / rollout_name(arrays)
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)
        write_atomically(path, buffer.getvalue())
        paths.append(path)
    return paths


def rollout_name(arrays: dict) -> str:
    """<method>__<ego>__<eta>__<scene_id>__<seed>.npz; characters not allowed in file names become '-'."""
    parts = (arrays["method"], arrays["ego_policy"], f"{float(arrays['eta']):g}", arrays["scene_id"], arrays["seed"])
    return "__".join(re.sub(r"[^A-Za-z0-9._+-]", "-", str(part)) for part in parts) + ".npz"


def rollout_arrays(rollouts: dict, index: int, source: Source) -> dict[str, np.ndarray]:
    """The arrays of one rollout of a rollout dict, in the format e2rl-rollout/1."""
    tensors = {key: value for key, value in rollouts.items() if isinstance(value, Tensor) and value.dim()}
    row = {key: value[index].detach().cpu() for key, value in tensors.items()}
    eta = row["eta"].item() if "eta" in row else float(rollouts["eta"])
    kinds = np.array(AGENT_TYPES)[row["agent_type"].numpy()]
    lanes, lane_offsets, lanes_kept = polylines(row["lane_points"], row["lane_index"], minimum=2)
    rings, ring_offsets, _ = polylines(row["drivable_points"], row["drivable_index"], minimum=3)
    return {
        "format": np.array(FORMAT),
        "scene_id": np.array(str(rollouts["scene_id"][index])),
        "location": np.array(str(rollouts["location"][index])),
        "dataset": np.array(source.dataset),
        "split": np.array(source.split),
        "method": np.array(source.method),
        "ego_policy": np.array(source.ego_policy),
        "seed": np.array(int(row["seed"]), np.int64),
        "eta": np.array(eta, np.float64),
        "dt": np.array(DT, np.float64),
        "ego": np.array(0, np.int64),
        "states": row["states"].float().numpy(),
        "valid": row["valid"].bool().numpy(),
        "size": row["size"].float().numpy(),
        "agent_type": kinds,
        "simulated": row["simulated"].bool().numpy(),
        "adversaries": row["adversaries"].bool().numpy(),
        "logged": row["logged"].float().numpy(),
        "logged_valid": row["logged_valid"].bool().numpy(),
        "lane_points": lanes,
        "lane_offsets": lane_offsets,
        "lane_width": row["lane_width"].float().numpy()[lanes_kept],
        "drivable_points": rings,
        "drivable_offsets": ring_offsets,
        **{name: row[name].numpy() for name in OPTIONAL if name in row},
        **plan_arrays(row),
    }


def plan_arrays(row: dict[str, Tensor]) -> dict[str, np.ndarray]:
    """The evasion of the ego, where one was found, and the plans and targets of the ego and the adversaries, where the
    rollout knows them."""
    arrays = {}
    if "evasion" in row and not row["evasion"].isnan().any():
        arrays["evasion"] = row["evasion"].float().numpy()
    if "plans" in row:
        planners = row["adversaries"][: row["plans"].shape[1]].bool().clone()
        planners[0] = True
        arrays["planners"] = planners.nonzero()[:, 0].numpy()
        arrays["plans"] = row["plans"][:, planners].float().numpy()
        arrays["targets"] = row["targets"][:, planners].numpy()
    return arrays


def polylines(points: Tensor, index: Tensor, minimum: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(points [M, 2] float32, offsets [L + 1] int64, kept line numbers [L]) of padded points [P, 2], index [P].

    Lines of fewer than `minimum` points are omitted.
    """
    line = index.numpy()
    counts = np.bincount(line[line >= 0], minlength=1)
    kept = np.flatnonzero(counts >= minimum)
    chosen = np.isin(line, kept)
    order = np.argsort(line[chosen], kind="stable")
    return points.float().numpy()[chosen][order], np.concatenate([[0], np.cumsum(counts[kept])]).astype(np.int64), kept


# --- rows


def table_columns() -> tuple[str, ...]:
    """Columns of rollouts.csv: a row's source, then `metrics.catalogue.row_columns`."""
    return (*(field.name for field in fields(Source)), *row_columns())


def write_rows(path: Path, rows: Sequence[dict]) -> None:
    """Write rollouts.csv: one line per rollout, NaN as an empty cell.

    rows: those of score_rollouts, with the columns of `label_rows`.
    """
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    columns = table_columns()
    writer.writerow(columns)
    writer.writerows([cell(row.get(column, math.nan)) for column in columns] for row in rows)
    write_atomically(path, buffer.getvalue())


def label_rows(rows: Iterable[dict], source: Source) -> list[dict]:
    """Rows with the columns of their source: dataset, split, method, ego_policy."""
    return [vars(source) | row for row in rows]


def cell(value: object) -> object:
    if isinstance(value, bool):
        return int(value)
    return "" if isinstance(value, float) and math.isnan(value) else value


def read_rows(path: Path) -> list[dict]:
    """The rows of a rollouts.csv: text columns as text, seed and partner as int, all others as float (empty: NaN).

    Raises InputError for a file that is no such table.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such table; give the folder of a run that evaluate.py wrote")
    try:
        with path.open(newline="") as file:
            rows = csv.DictReader(file, strict=True)
            if missing := [name for name in NEEDED if name not in (rows.fieldnames or ())]:
                raise ValueError(f"no column {missing[0]}")
            return [_row(rows.line_num, row) for row in rows]
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(f"{path}: damaged ({error}); make it again from the rollouts: {SCORE} RUN_DIR") from error


def _row(line: int, row: dict[str, Any]) -> dict:
    """A line of the table with its values; ValueError where it has other cells than the head."""
    if None in row or None in row.values():
        raise ValueError(f"line {line} has other cells than the head")
    try:
        return {
            key: value if key in TEXT_COLUMNS else int(value) if key in ("seed", "partner") else float(value or "nan")
            for key, value in row.items()
        }
    except ValueError as error:
        raise ValueError(f"line {line}: {error}") from error


# --- metrics


def write_metrics(path: Path, rows: Sequence[dict]) -> None:
    """Write metrics.json from the rows of `evaluation.summary.metric_rows`; NaN becomes null (strict JSON)."""
    write_atomically(path, json.dumps(nulls(list(rows)), indent=1, allow_nan=False))


def read_metrics(path: Path) -> list[dict]:
    """The rows of a metrics.json, null as NaN inside `metrics` and `paired`."""
    path = Path(path)
    try:
        rows = json.loads(path.read_text())
        if wrong := misfit(rows, [METRICS_ROW]) or next(filter(None, map(_other, rows)), None):
            raise ValueError(wrong)
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: no readable metrics ({error}); give a metrics.json that a run wrote") from error
    return [{key: nans(value) if key in ("metrics", "paired") else value for key, value in row.items()} for row in rows]


def _other(row: dict) -> str | None:
    """What has another shape in the entries that not every row of metrics.json has."""
    return misfit(row, {name: shape for name, shape in SOMETIMES.items() if name in row})


def nulls(value: object) -> object:
    """The value with every non-finite float replaced by None."""
    if isinstance(value, dict):
        return {key: nulls(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [nulls(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def nans(value: object) -> object:
    """The value with None replaced by NaN, in nested dicts."""
    if isinstance(value, dict):
        return {key: nans(part) for key, part in value.items()}
    return math.nan if value is None else value


@cache
def git_commit() -> str:
    """The package's commit, with '+changes' where tracked files differ from it; "" outside a git checkout."""

    def git(*arguments: str) -> str | None:
        try:
            done = subprocess.run(
                ["git", *arguments], cwd=Path(e2rl.__file__).parent, capture_output=True, text=True, timeout=20
            )
        except (OSError, subprocess.TimeoutExpired):
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    commit = git("rev-parse", "HEAD")
    changes = git("status", "--porcelain", "--untracked-files=no")
    return "" if commit is None else commit + ("+changes" if changes else "")


def command_line() -> str:
    """The running command, quoted for a shell."""
    return shlex.join(["python", *sys.argv])


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
