"""Tables of a run, written and read whole: rollouts.csv, metrics.json, errored.json
(docs/reference/metrics.md)."""

import csv
import io
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from types import NoneType
from typing import Any

from e2rl.metrics.catalogue import LATER, SOURCE, WORDS, row_columns
from e2rl.metrics.errored import lost
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
from e2rl.run.run import PARTS, check_run
from e2rl.sim.rollout_file import UNPRINTABLE
from e2rl.traffic.attempt import summary_of

TABLE = "rollouts.csv"
METRICS_FILE = "metrics.json"
ERRORED_FILE = "errored.json"
MODES_FILE = "modes.json"
ATLAS_FILE = "atlas.json"
RATES_FILE = "rates.json"  # of e2rl rate, which has a table of the failures it draws
# bytes and lines that take less than 2 GB of memory
MAX_JSON = 48 << 20
MOST_ROWS = 300_000
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


def table_columns() -> tuple[str, ...]:
    """Columns of rollouts.csv."""
    return (*SOURCE, *row_columns())


def write_tables(
    folder: Path | None,
    rows: Sequence[dict],
    errored: Sequence[dict],
    **tables: object,
) -> list[dict]:
    """Write rollouts.csv, errored.json where rollouts errored, and the others; returns
    the rows as `read_rows` gives them.

    Args:
        folder: of the run; None: nothing is written.
        rows: of the rollouts.
        errored: entries of errored.json.
        tables: further contents, NAME of NAME.json.

    Raises:
        InputError: where the traffic lost all rollouts; then the others are not
            written.
    """
    counted = [row for row in rows if not lost(row)]
    columns = table_columns()
    if folder is not None:
        texts = {TABLE: rows_text(rows, columns)}
        for name, content in tables.items() if counted else ():
            texts[f"{name}.json"] = json_text(content)
        for name, text in texts.items():
            write_atomically(folder / name, text)
        write_errored(folder / ERRORED_FILE, errored)
    require_rows(counted, errored, folder)
    return [
        {name: value_of(name, str(cell(row.get(name, math.nan)))) for name in columns}
        for row in rows
    ]


def write_rows(path: Path, rows: Sequence[dict]) -> None:
    """Write rollouts.csv."""
    write_atomically(path, rows_text(rows, table_columns()))


def rows_text(rows: Iterable[Mapping], columns: Sequence[str]) -> str:
    """Returns columns of rows as CSV: NaN, and what a row lacks, is an empty cell."""
    lines = ([cell(row.get(column, math.nan)) for column in columns] for row in rows)
    return csv_text([columns, *lines])


def cell(value: object) -> object:
    """A value as a cell: truth as 0 or 1, NaN as an empty one."""
    if isinstance(value, bool):
        return int(value)
    return "" if isinstance(value, float) and math.isnan(value) else value


def value_of(column: str, text: str) -> str | int | float:
    """Returns the value of a cell: of text columns text, of seed and partner a whole
    number, of all others a number, NaN where the cell is empty."""
    if column in TEXTS:
        return text
    return int(text) if column in ("seed", "partner") else float(text or "nan")


def read_rows(path: Path) -> list[dict]:
    """The rows of a rollouts.csv, with values as in `value_of`; InputError for a file
    that is no such table, and where its run is of another format."""
    path = Path(path)
    check_run(path.parent)
    try:
        file = open_regular(path, within=path.parent)
        with io.TextIOWrapper(file, "utf-8", newline="") as lines:
            rows = CsvReader(lines)
            heads = rows.fieldnames or ()
            if missing := [name for name in table_columns() if name not in heads]:
                raise ValueError(f"no column {missing[0]}")
            content = [
                row_of(rows.line_num, row) for row in islice(rows, MOST_ROWS + 1)
            ]
        if len(content) > MOST_ROWS:
            raise ValueError(f"more than {MOST_ROWS:,} rows")
        return content
    except FileNotFoundError as error:
        mend = "give the folder of a run of evaluate.py; shards are merged first"
        if (path.parent / RATES_FILE).is_file():
            mend = f"the run drew no failure ({RATES_FILE} has its rates)"
        elif (path.parent / PARTS).is_dir():
            mend = (
                f"the run is not finished; go on with its command by "
                f"resume={path.parent}; shards are merged first"
            )
        raise InputError(f"{path}: no such table; {mend}") from error
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(
            f"{path}: damaged ({cause(error)}); run evaluate.py again to rewrite it"
        ) from error


def row_of(number: int, cells: dict[str, Any]) -> dict:
    """Returns a line of the table with its values; ValueError where it has other cells
    than the head."""
    if None in cells or None in cells.values():
        raise ValueError(f"line {number} has other cells than the head")
    if odd := [name for name in TEXTS if UNPRINTABLE.search(cells.get(name, ""))]:
        raise ValueError(f"line {number}: {odd[0]} holds control characters")
    try:
        return {name: value_of(name, text) for name, text in cells.items()}
    except ValueError as error:
        raise ValueError(f"line {number}: {error}") from error


def cause(error: Exception) -> str:
    """What an error says, without the path and number of one of the file system."""
    return str(isinstance(error, OSError) and error.strerror or error)


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


def read_json(path: Path, wrong: Callable[[Any], str | None]) -> Any:
    """The content of a JSON file of a run; raises InputError where it is none, has
    texts with control characters, is of a run of another format, or `wrong` says what
    is wrong with it."""
    check_run(path.parent)
    try:
        content = json.loads(
            read_regular(path, MAX_JSON, within=path.parent), parse_int=_whole
        )
        if reason := wrong(content):
            raise ValueError(reason)
        if odd := next(filter(UNPRINTABLE.search, _texts(content)), None):
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


def own_folder(run: Path, name: str) -> Path:
    """A folder of a run to write to; InputError where a link leads out of the run."""
    folder = run / name
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
    rows: Sequence,
    errored: Sequence[dict],
    folder: Path | None = None,
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
