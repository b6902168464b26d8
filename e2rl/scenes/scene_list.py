"""Lists of scenes: CSV files that name scenes, with the number of their noise and the
hash of their content.

A run writes the list of its scenes; with `scenes=FILE` another run takes the same,
wherever its data lie. Columns:

| column | |
| --- | --- |
| scene_id | needed; a scene that is named twice counts once |
| location | for the reader; it is not read |
| number | of the scene's noise; by default its position in the data |
| sha256 | of the scene (see `scene_hashes`), which is checked; by default nothing is |

So a table that a user made by hand serves, and one of rollouts (rollouts.csv or lines
of it) does, too.
"""

import csv
import hashlib
import io
import json
import sys
from collections.abc import (
    Callable,
    Sequence,
)
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from tqdm import tqdm

from e2rl.run.errors import InputError
from e2rl.run.files import (
    CsvReader,
    csv_text,
    read_regular,
)
from e2rl.scenes.scene import SceneSet

SCENES = "scenes.csv"  # of a run's folder
COLUMNS = ("scene_id", "location", "number", "sha256")
LARGEST = 1 << 31  # above all numbers
SHOWN = 3  # scenes that a message names


class Listed(NamedTuple):
    """A line of a list; number, sha256: None where it does not say."""

    scene_id: str
    number: int | None = None
    sha256: str | None = None


def scene_hashes(scenes: SceneSet) -> list[str]:
    """SHA-256 of each scene [S]: of its tensors, id, place and data set. The other
    scenes of the set, to whose size some tensors are padded, do not matter; the
    recording, the builder and the sizes in data.build do."""
    names = zip(
        scenes.scene_id,
        scenes.location,
        scenes.hashes(),
        strict=True,
    )
    texts = [json.dumps([*row, scenes.dataset]) for row in names]
    return [hashlib.sha256(text.encode()).hexdigest() for text in texts]


def listed(scenes: SceneSet) -> tuple[str, str]:
    """Returns the list of scenes as the content of a file, and the hash of their data's
    files."""
    hashes = scene_hashes(scenes)
    lines = zip(
        scenes.scene_id,
        scenes.location,
        scenes.number,
        hashes,
        strict=True,
    )
    return csv_text([COLUMNS, *lines]), scenes.files


def read_list(path: str | Path) -> list[Listed]:
    """The lines of a list, or of the list in a run's folder; raises InputError where it
    is none."""
    file = Path(path) / SCENES if Path(path).is_dir() else Path(path)
    try:
        content = io.StringIO(read_regular(file).decode("utf-8-sig"), newline="")
        rows = CsvReader(content)
        if "scene_id" not in (rows.fieldnames or ()):
            raise InputError(
                f"scenes={file}: no column scene_id; give the {SCENES} of a run, "
                "or a table with one"
            )
        lines = list(
            dict.fromkeys(
                _line(row, f"scenes={file}, line {rows.line_num}") for row in rows
            )
        )
    except InputError:
        raise
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(
            f"scenes={file}: cannot be read ({error}); give the {SCENES} of a run"
        ) from error
    if not lines:
        raise InputError(f"scenes={file}: names no scene; add a line for each")
    return lines


def _line(row: dict[str, str | None], place: str) -> Listed:
    number = row.get("number")
    if not row.get("scene_id"):
        raise InputError(f"{place}: no scene_id; name a scene, or remove the line")
    if number and not (number.isascii() and number.isdigit() and int(number) < LARGEST):
        raise InputError(
            f"{place}: number {number}: expected a whole number of at least 0"
        )
    return Listed(
        str(row["scene_id"]),
        number=int(number) if number else None,
        sha256=row.get("sha256") or None,
    )


def listed_scenes(
    path: str | Path,
    load: Callable[[int | None], SceneSet],
    most: int | None = None,
    files: str = "",
) -> SceneSet:
    """Returns the scenes of a list, in its order.

    Args:
        path: of the list, or of the folder of the run that wrote it.
        load: returns the first so many scenes of the data, or all.
        most: how many scenes at most.
        files: SHA-256 of the data files that the list was made of, if it is known.
            Where the data's are the same, scenes that differ from the listed ones are
            told on stderr and taken.

    Raises:
        InputError: scenes that are not there, or differ and are of other files.
    """
    lines = read_list(path)[:most]
    numbers = [line.number for line in lines if line.number is not None and line.sha256]
    if len(numbers) == len(lines):  # perhaps all are among the first, and no more built
        scenes = load(max(numbers) + 1)
        hashes = scene_hashes(scenes)
        if {line.sha256 for line in lines} <= set(hashes):
            return _taken(scenes, lines, hashes)
    scenes = load(None)
    hashes = scene_hashes(scenes)
    count = f"of {len(lines)} scenes are not"
    places = _places(scenes.scene_id)
    if missing := [line for line in lines if line.scene_id not in places]:
        raise InputError(
            f"scenes={path}: {len(missing)} {count} in the data ({_some(missing)}), "
            f"whose first is {scenes.scene_id[0]}; pass the data that the list is of "
            "(data=, data.path=)"
        )
    same = set(hashes)
    if other := [line for line in lines if line.sha256 and line.sha256 not in same]:
        message = f"scenes={path}: {len(other)} {count} those listed ({_some(other)})"
        if not files or files != scenes.files:
            raise InputError(
                f"{message}: the data, data.build or e2rl's version are others; "
                "restore them, or leave the column sha256 out to run these"
            )
        message += ", though the data files are: another version or machine"
        tqdm.write(message, sys.stderr)
    return _taken(scenes, lines, hashes)


def _taken(
    scenes: SceneSet,
    lines: Sequence[Listed],
    hashes: Sequence[str],
) -> SceneSet:
    """The scenes of the lines: those of the same hash, else of the same id."""
    same = _places(hashes)
    named = _places(scenes.scene_id)
    rows = [same.get(line.sha256 or "", named.get(line.scene_id, -1)) for line in lines]
    chosen = scenes.chosen(rows)
    numbers = [
        default if line.number is None else line.number
        for line, default in zip(lines, chosen.number, strict=True)
    ]
    return replace(chosen, number=numbers)


def _places(values: Sequence[str]) -> dict[str, int]:
    """The index of each value, of equal ones the first."""
    return {value: index for index, value in reversed(list(enumerate(values)))}


def _some(lines: Sequence[Listed]) -> str:
    shown = ", ".join(line.scene_id for line in lines[:SHOWN])
    return shown + (", .." if len(lines) > SHOWN else "")
