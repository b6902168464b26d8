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
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from tqdm import tqdm

from e2rl.run.errors import InputError
from e2rl.run.files import CsvReader, csv_text, read_regular
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
    about = zip(scenes.scene_id, scenes.location, scenes.hashes(), strict=True)
    return [
        hashlib.sha256(json.dumps([*names, scenes.dataset]).encode()).hexdigest()
        for names in about
    ]


def listed(scenes: SceneSet) -> tuple[str, str]:
    """Returns the list of scenes as the content of a file, and the hash of their data's
    files."""
    lines = zip(
        scenes.scene_id,
        scenes.location,
        scenes.number,
        scene_hashes(scenes),
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
                f"scenes={file}: no column scene_id; give the {SCENES} of a run, or a table with one"
            )
        found = dict.fromkeys(_line(file, rows.line_num, row=row) for row in rows)
    except (OSError, ValueError, csv.Error) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"scenes={file}: cannot be read ({error}); give the {SCENES} of a run"
        ) from error
    if not found:
        raise InputError(f"scenes={file}: names no scene; add a line for each")
    return list(found)


def _line(file: Path, number: int, row: dict[str, str | None]) -> Listed:
    name, noise, sha256 = (row.get(key) for key in ("scene_id", "number", "sha256"))
    if not name:
        raise InputError(
            f"scenes={file}, line {number}: no scene_id; name a scene, or remove the line"
        )
    if noise and not (noise.isascii() and noise.isdigit() and int(noise) < LARGEST):
        raise InputError(
            f"scenes={file}, line {number}: number {noise}: expected a whole number of at least 0"
        )
    return Listed(name, int(noise) if noise else None, sha256=sha256 or None)


def listed_scenes(
    path: str | Path,
    load: Callable[[int | None], SceneSet],
    most: int | None = None,
    files: str = "",
) -> SceneSet:
    """The scenes of a list, at most its first `most`, in its order. load: the first so
    many scenes of the data, or all.

    files: SHA-256 of the data files that the list was made of, if it is known; where
    the data's are the same, scenes that differ from the listed ones are told on stderr
    and taken. Raises InputError for those of other files, and for scenes that are not
    there.
    """
    listed = read_list(path)[:most]
    numbers = [
        line.number for line in listed if line.number is not None and line.sha256
    ]
    if (
        len(numbers) == len(listed)
    ):  # perhaps all among the first scenes of the data, in which case no more are built
        scenes = load(max(numbers) + 1)
        hashes = scene_hashes(scenes)
        if {line.sha256 for line in listed} <= set(hashes):
            return _taken(scenes, listed, hashes=hashes)
    scenes = load(None)
    hashes = scene_hashes(scenes)
    known = set(scenes.scene_id)
    count = f"of {len(listed)} scenes are not"
    if missing := [line.scene_id for line in listed if line.scene_id not in known]:
        mend = f"whose first is {scenes.scene_id[0]}; pass the data that the list is of (data=, data.path=)"
        raise InputError(
            f"scenes={path}: {len(missing)} {count} in the data ({_some(missing)}), {mend}"
        )
    if other := [
        line.scene_id for line in listed if line.sha256 and line.sha256 not in hashes
    ]:
        message = f"scenes={path}: {len(other)} {count} those listed ({_some(other)})"
        if not files or files != scenes.files:
            cause = "the data, data.build or e2rl's version are others"
            raise InputError(
                f"{message}: {cause}; restore them, or leave the column sha256 out to run these"
            )
        tqdm.write(
            f"{message}, though the data files are: another version or machine",
            sys.stderr,
        )
    return _taken(scenes, listed, hashes=hashes)


def _taken(
    scenes: SceneSet, listed: Sequence[Listed], hashes: Sequence[str]
) -> SceneSet:
    """The scenes of the lines: those of the same hash, else of the same id."""
    by_hash = {value: index for index, value in reversed(list(enumerate(hashes)))}
    by_name = {
        name: index for index, name in reversed(list(enumerate(scenes.scene_id)))
    }
    keep = [
        by_hash.get(line.sha256 or "", by_name.get(line.scene_id, -1))
        for line in listed
    ]
    chosen = scenes.chosen(keep)
    own = zip(chosen.number, listed, strict=True)
    return replace(
        chosen,
        number=[number if line.number is None else line.number for number, line in own],
    )


def _some(names: Collection[str]) -> str:
    shown = list(names)[:SHOWN]
    return ", ".join(shown) + (", .." if len(names) > len(shown) else "")
