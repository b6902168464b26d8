"""Tables of a run, written and read whole: rollouts.csv, metrics.json, errored.json (docs/method.md, section 11)."""

import csv
import io
import json
import math
from collections.abc import Sequence
from pathlib import Path
from types import NoneType
from typing import Any

from e2rl.metrics.catalogue import SOURCE, WORDS, row_columns
from e2rl.run.errors import InputError
from e2rl.run.files import misfit, write_atomically
from e2rl.traffic.attempt import summary_of

TABLE, METRICS_FILE, ERRORED_FILE = "rollouts.csv", "metrics.json", "errored.json"
NEEDED = (*SOURCE, "scene_id", "seed", "eta")
NUMBER = (int, float, NoneType)
INTERVAL = {"low": NUMBER, "high": NUMBER, "n": NUMBER, ...: NUMBER}
METRICS_ROW = {  # what readers of metrics.json need
    **dict.fromkeys(("dataset", "split", "method", "ego"), str),
    **dict.fromkeys(("eta", "n_scenes", "n_seeds", "n_rollouts"), (int, float)),
    "metrics": {...: {"mean": NUMBER, **INTERVAL}},
    "paired": {...: {...: {"difference": NUMBER, **INTERVAL}}},
}
SOMETIMES = {"errored": {...: int}, "stage": (str, NoneType), "git": str, "command": str, "n_trainings": int}
TEXTS = (*SOURCE, "scene_id", "location", *WORDS)


def table_columns() -> tuple[str, ...]:
    """Columns of rollouts.csv."""
    return (*SOURCE, *row_columns())


def write_rows(path: Path, rows: Sequence[dict]) -> None:
    """Write rollouts.csv: one line per row of `score_rollouts`, NaN as an empty cell."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    columns = table_columns()
    writer.writerow(columns)
    writer.writerows([cell(row.get(column, math.nan)) for column in columns] for row in rows)
    write_atomically(path, buffer.getvalue())


def cell(value: object) -> object:
    """A value as a cell: truth as 0 or 1, NaN as an empty one."""
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
        raise InputError(f"{path}: damaged ({error}); run evaluate.py again to rewrite it") from error


def _row(line: int, row: dict[str, Any]) -> dict:
    """A line of the table with its values; ValueError where it has other cells than the head."""
    if None in row or None in row.values():
        raise ValueError(f"line {line} has other cells than the head")
    try:
        return {
            key: value if key in TEXTS else int(value) if key in ("seed", "partner") else float(value or "nan")
            for key, value in row.items()
        }
    except ValueError as error:
        raise ValueError(f"line {line}: {error}") from error


def write_metrics(path: Path, rows: Sequence[dict]) -> None:
    """Write metrics.json from the rows of `evaluation.summary.metric_rows`; NaN becomes null (strict JSON)."""
    write_atomically(path, json.dumps(nulls(list(rows)), indent=1, allow_nan=False))


def read_metrics(path: Path) -> list[dict]:
    """The rows of a metrics.json, null as NaN inside `metrics` and `paired`."""
    path = Path(path)
    try:
        rows = json.loads(path.read_text())
        wrong = misfit(rows, [METRICS_ROW])
        for row in [] if wrong else rows:
            wrong = wrong or misfit(row, {name: shape for name, shape in SOMETIMES.items() if name in row})
        if wrong:
            raise ValueError(wrong)
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: no readable metrics ({error}); give a metrics.json that a run wrote") from error
    return [{key: nans(value) if key in ("metrics", "paired") else value for key, value in row.items()} for row in rows]


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


def write_errored(path: Path, errored: Sequence[dict]) -> None:
    """Write errored.json, where rollouts errored; remove an older one where none did."""
    if errored:
        write_atomically(path, json.dumps(list(errored), indent=1))
    else:
        path.unlink(missing_ok=True)


def add_errored(path: Path, number: int, errored: Sequence[dict]) -> None:
    """Write the entries of round `number` of a training into its errored.json, after those of earlier rounds; a resumed
    run repeats some. A damaged file is begun anew."""
    try:
        known = json.loads(path.read_text()) if path.is_file() else []
        earlier = [entry for entry in known if entry["round"] < number]
    except (OSError, ValueError, TypeError, KeyError):
        earlier = []
    write_errored(path, [*earlier, *errored])


def require_rows(rows: Sequence[dict], errored: Sequence[dict], folder: Path | None) -> None:
    """InputError where all rollouts errored."""
    if rows or not errored:
        return
    where = f"; {folder / ERRORED_FILE} has the tracebacks" if folder is not None else ""
    raise InputError(f"no rollout could be scored: {summary_of(errored)}{where}; mend the planner or the traffic")
