"""The atlas of a run's failures in a file: atlas.json, an atlas for each ego, method and intensity (docs/modes.md)."""

import json
from collections.abc import Sequence
from pathlib import Path
from types import NoneType

from e2rl.evaluation.rollout_files import nulls, read_json
from e2rl.evaluation.summary import GROUP, group_of
from e2rl.metrics.atlas import CELL, Cell, Found, atlas_of
from e2rl.run.files import misfit, write_atomically
from e2rl.sim.rollout_file import rollout_name

ATLAS_FILE = "atlas.json"
NUMBER = (int, float)
SHAPE = {  # what readers of atlas.json need
    "groups": [
        {**dict.fromkeys(("dataset", "split", "method", "ego_policy"), str), "eta": NUMBER}
        | dict.fromkeys(("rollouts", "preventable", "cells"), int)
        | {
            "atlas": [
                {**dict.fromkeys(CELL, str), "failures": int, "scenes": int}
                | dict.fromkeys(("transport", "real_adv"), (*NUMBER, NoneType))
                | {"likeliest": {"scene_id": str, "seed": int, "file": str}}
            ]
        }
    ]
}


def find_atlas(rows: Sequence[dict]) -> dict:
    """The content of atlas.json from all rows of a run."""
    groups: dict[tuple, list[dict]] = {}
    for row in rows:
        groups.setdefault(group_of(row), []).append(row)
    return {"groups": [dict(zip(GROUP, key, strict=True)) | describe(ours) for key, ours in groups.items()]}


def describe(rows: Sequence[dict]) -> dict:
    """A group's rollouts, preventable failures, number of cells, and its cells, that of the likeliest failure first."""
    atlas = atlas_of(rows)
    failures = sum(found.failures for found in atlas.values())
    cells = [describe_cell(cell, found) for cell, found in atlas.items()]
    return {"rollouts": len(rows), "preventable": failures, "cells": len(cells), "atlas": cells}


def describe_cell(cell: Cell, found: Found) -> dict:
    """A cell's words, its numbers of failures and of scenes, and its likeliest failure: nats, realism, rollout."""
    row = found.likeliest
    values = {name: row.get(name) for name in ("transport", "real_adv")}
    likeliest = {"scene_id": row["scene_id"], "seed": row["seed"], "file": rollout_name(row)}
    counts = {"failures": found.failures, "scenes": found.scenes}
    return dict(zip(CELL, cell, strict=True)) | counts | values | {"likeliest": likeliest}


def _mismatch(found: dict) -> str | None:
    """Which group does not say what it has, or names a file elsewhere; None: none."""
    for group in found["groups"]:
        if len(group["atlas"]) != group["cells"]:
            return f"{group['method']} has {len(group['atlas'])} cells, not {group['cells']}"
        files = [cell["likeliest"]["file"] for cell in group["atlas"]]
        if elsewhere := [name for name in files if Path(name).name != name]:
            return f"{group['method']} names the file {elsewhere[0][:60]!r}"
    return None


def write_atlas(path: Path, found: dict) -> None:
    """Write atlas.json from the result of `find_atlas`."""
    write_atomically(path, json.dumps(nulls(found), indent=1, allow_nan=False))


def read_atlas(path: Path) -> dict:
    """The content of an atlas.json; raises InputError where it is none."""
    return read_json(path, lambda found: misfit(found, SHAPE) or _mismatch(found))
