"""Tables of a run, written and read whole: rollouts.csv, metrics.json, errored.json
(docs/reference/metrics.md)."""

import csv
import io
import json
import math
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from types import NoneType
from typing import IO, Any

from e2rl.metrics.catalogue import LATER, SOURCE, WORDS, row_columns
from e2rl.metrics.errored import errored_row, lost
from e2rl.run.errors import InputError
from e2rl.run.files import (
    CsvReader,
    csv_text,
    leads_into,
    misfit,
    open_regular,
    read_regular,
    write_atomically,
)
from e2rl.run.parts import PARTS
from e2rl.sim.rollout_file import UNPRINTABLE
from e2rl.traffic.attempt import summary_of

TABLE = "rollouts.csv"
METRICS_FILE = "metrics.json"
ERRORED_FILE = "errored.json"
MODES_FILE = "modes.json"
ATLAS_FILE = "atlas.json"
MAX_JSON, MOST_ROWS = (
    48 << 20,
    300_000,
)  # bytes and lines that take less than 2 GB of memory
DIGITS = 15  # of a whole number: more would not fit a float
NUMBER = (int, float, NoneType)
INTERVAL = {"low": NUMBER, "high": NUMBER, "n": NUMBER, ...: NUMBER}
METRICS_ROW = {  # what readers of metrics.json need
    **dict.fromkeys(("dataset", "split", "method", "ego", "git", "command"), str),
    **dict.fromkeys(("eta", "n_scenes", "n_seeds", "n_rollouts"), (int, float)),
    "metrics": {...: {"mean": NUMBER, **INTERVAL}},
    "paired": {...: {...: {"difference": NUMBER, **INTERVAL}}},
}
SOMETIMES = {
    "errored": {...: int},
    "stage": (str, NoneType),
    "n_trainings": int,
    "headline": {...: (int, float)},
}
TEXTS = (
    *SOURCE,
    "scene_id",
    "location",
    *WORDS,
    *(name for name, value in LATER.items() if value == ""),
)
ENTRY = {  # what readers of errored.json need
    **dict.fromkeys((*SOURCE, "scene_id", "reason", "detail"), str),
    **{"eta": (int, float), "seed": int},
}


def table_columns() -> tuple[str, ...]:
    """Columns of rollouts.csv."""
    return (*SOURCE, *row_columns())


def write_rows(path: Path, rows: Sequence[dict]) -> None:
    """Write rollouts.csv: one line per row of `score_rollouts`, NaN as an empty cell."""
    columns = table_columns()
    lines = ([cell(row.get(column, math.nan)) for column in columns] for row in rows)
    write_atomically(path, csv_text([columns, *lines]))


def write_rollouts(
    folder: Path | None, rows: Sequence[dict], errored: Sequence[dict]
) -> None:
    """Write rollouts.csv and, where rollouts errored, errored.json into a folder (None:
    nothing is written). Raises InputError where the traffic lost all rollouts."""
    if folder is not None:
        write_errored(folder / ERRORED_FILE, errored)
        write_rows(folder / TABLE, rows)
    require_rows([row for row in rows if not lost(row)], errored, folder)


def write_tables(folder: Path, rows: Sequence[dict], modes: dict, atlas: dict) -> None:
    """Write modes.json, atlas.json and metrics.json, whose rows are given."""
    write_json(folder / MODES_FILE, modes)
    write_json(folder / ATLAS_FILE, atlas)
    write_json(folder / METRICS_FILE, rows)


def cell(value: object) -> object:
    """A value as a cell: truth as 0 or 1, NaN as an empty one."""
    if isinstance(value, bool):
        return int(value)
    return "" if isinstance(value, float) and math.isnan(value) else value


def read_rows(path: Path) -> list[dict]:
    """The rows of a rollouts.csv: text columns as text, seed and partner as int, all
    others as float (empty: NaN).

    LATER columns, which tables of earlier versions lack, are filled. Raises InputError
    for a file that is no such table.
    """
    path = Path(path)
    try:
        with opened(path) as file:
            rows = CsvReader(file)
            missing = [
                name for name in table_columns() if name not in (rows.fieldnames or ())
            ]
            if wrong := [name for name in missing if name not in LATER]:
                raise ValueError(f"no column {wrong[0]}")
            later = {name: LATER[name] for name in missing}
            found = [
                _row(rows.line_num, row) | later for row in islice(rows, MOST_ROWS + 1)
            ]
        if len(found) > MOST_ROWS:
            raise ValueError(f"more than {MOST_ROWS:,} rows")
        return found
    except FileNotFoundError as error:
        mend = "give the folder of a run of evaluate.py; shards are merged first"
        if (path.parent / PARTS).is_dir():
            mend = (
                f"the run is not finished; go on with it by e2rl evaluate "
                f"resume={path.parent}; shards are merged first"
            )
        raise InputError(f"{path}: no such table; {mend}") from error
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(
            f"{path}: damaged ({cause(error)}); run evaluate.py again to rewrite it"
        ) from error


def read_run(run: Path) -> list[dict]:
    """The rows of a run's rollouts.csv, and one for each rollout of its errored.json
    that the table lacks, as tables of earlier versions do. Raises InputError where
    either is damaged."""
    rows = read_rows(run / TABLE)
    file = run / ERRORED_FILE
    entries = (
        read_json(file, lambda found: misfit(found, [ENTRY]), printable=False)
        if file.is_file()
        else []
    )
    place = {row["scene_id"]: row["location"] for row in rows}
    identities = set(map(_identity, rows))
    missing = [
        errored_row({"location": place.get(entry["scene_id"], "")} | entry)
        for entry in entries
    ]
    return rows + [row for row in missing if _identity(row) not in identities]


def _identity(row: dict) -> tuple:
    return tuple(row[name] for name in (*SOURCE, "eta", "scene_id", "seed"))


def opened(path: Path) -> IO[str]:
    """A table of a run, to read; raises OSError as `open_regular` does."""
    return io.TextIOWrapper(open_regular(path, within=path.parent), "utf-8", newline="")


def cause(error: Exception) -> str:
    """What an error says, without the path and number of one of the file system."""
    return str(isinstance(error, OSError) and error.strerror or error)


def _row(line: int, row: dict[str, Any]) -> dict:
    """A line of the table with its values; ValueError where it has other cells than the
    head."""
    if None in row or None in row.values():
        raise ValueError(f"line {line} has other cells than the head")
    if odd := [name for name in TEXTS if UNPRINTABLE.search(row.get(name, ""))]:
        raise ValueError(f"line {line}: {odd[0]} holds control characters")
    try:
        return {
            key: value
            if key in TEXTS
            else int(value)
            if key in ("seed", "partner")
            else float(value or "nan")
            for key, value in row.items()
        }
    except ValueError as error:
        raise ValueError(f"line {line}: {error}") from error


def write_json(path: Path, content: object) -> None:
    """Write metrics.json, modes.json, atlas.json, ..., as `json_text` has it."""
    write_atomically(path, json_text(content))


def json_text(content: object) -> str:
    """Returns the content as strict JSON: NaN and infinite numbers are null."""
    return json.dumps(nulls(content), indent=1, allow_nan=False)


def read_metrics(path: Path) -> list[dict]:
    """The rows of a metrics.json, null as NaN inside `metrics` and `paired`."""

    def wrong(rows: Any) -> str | None:
        if problem := misfit(rows, [METRICS_ROW]):
            return problem
        others = (
            {name: shape for name, shape in SOMETIMES.items() if name in row}
            for row in rows
        )
        return next(filter(None, map(misfit, rows, others)), None)

    rows = read_json(path, wrong)
    return [
        {
            key: nans(value) if key in ("metrics", "paired") else value
            for key, value in row.items()
        }
        for row in rows
    ]


def read_json(
    path: Path, wrong: Callable[[Any], str | None], printable: bool = True
) -> Any:
    """The content of a JSON file of a run; raises InputError where it is none, or has
    something wrong.

    Args:
        path: of the file.
        wrong: says what is wrong with its content, if anything is.
        printable: its texts hold no control characters, as those of a traceback do.
    """
    try:
        content = json.loads(
            read_regular(path, MAX_JSON, within=path.parent), parse_int=_whole
        )
        if reason := wrong(content):
            raise ValueError(reason)
        if printable and (
            odd := next(filter(UNPRINTABLE.search, _texts(content)), None)
        ):
            raise ValueError(f"{odd[:40]!r} holds control characters")
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(
            f"{path}: cannot be read ({cause(error)}); give the folder of a finished run"
        ) from error
    return content


def _whole(digits: str) -> int:
    if len(digits) > DIGITS:
        raise ValueError(f"a number of {len(digits)} digits")
    return int(digits)


def _texts(value: object) -> Iterator[str]:
    """All text in nested containers, but for the command line, which is never shown as
    it is."""
    if isinstance(value, dict):
        for key, part in value.items():
            yield key
            yield from () if key == "command" else _texts(part)
    elif isinstance(value, list):
        for part in value:
            yield from _texts(part)
    elif isinstance(value, str):
        yield value


def own_folder(run: Path, *names: str) -> Path:
    """A folder of a run to write to; InputError where a link leads out of the run."""
    folder = run.joinpath(*names)
    if not leads_into(folder, run):
        raise InputError(
            f"{folder}: a link out of {run}; remove it, or name another folder with --out"
        )
    return folder


def nulls(value: object) -> object:
    """The value with every non-finite float replaced by None."""
    if isinstance(value, dict):
        return {key: nulls(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [nulls(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def nans(value: Any) -> Any:
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
    """Write the entries of round `number` of a training into its errored.json, after
    those of earlier rounds; a resumed run repeats some. A damaged file is begun anew.
    """
    try:
        content = json.loads(read_regular(path, MAX_JSON, within=path.parent))
        earlier = [entry for entry in content if entry["round"] < number]
    except (OSError, ValueError, TypeError, LookupError, RecursionError):
        earlier = []
    write_errored(path, [*earlier, *errored])


def require_rows(
    rows: Sequence, errored: Sequence[dict], folder: Path | None = None
) -> None:
    """InputError where all rollouts errored."""
    if rows or not errored:
        return
    first = (
        f", as in {errored[0]['scene_id']}, seed {errored[0]['seed']}"
        if "scene_id" in errored[0]
        else ""
    )
    where = (
        f"; {folder / ERRORED_FILE} has the tracebacks, {TABLE} a row of each"
        if folder is not None
        else ""
    )
    said = f"{summary_of(errored)}{first}{where}"
    raise InputError(
        f"no rollout could be scored: {said}; mend the planner or the traffic"
    )
