"""The atlas of a run's failures in a file: atlas.json, an atlas for each ego, method and intensity (docs/modes.md)."""

import json
from collections.abc import Sequence
from pathlib import Path

from e2rl.evaluation.summary import GROUP, group_of
from e2rl.metrics.atlas import CELL, Cell, Found, atlas_of, cell_of
from e2rl.sim.rollout_file import rollout_name

ATLAS_FILE = "atlas.json"


def find_atlas(rows: Sequence[dict]) -> dict:
    """The content of atlas.json from all rows of a run."""
    groups: dict[tuple, list[dict]] = {}
    for row in rows:
        groups.setdefault(group_of(row), []).append(row)
    return {"groups": [dict(zip(GROUP, key, strict=True)) | describe(ours) for key, ours in groups.items()]}


def read_atlas(path: Path) -> dict:
    """The only group of an atlas.json of ours."""
    (group,) = json.loads(path.read_text(encoding="utf-8"))["groups"]
    return group


def describe(rows: Sequence[dict]) -> dict:
    """A group's rollouts, scenes, preventable failures, scenes with one, number of cells, and its cells, that of the
    likeliest failure first."""
    atlas = atlas_of(rows)
    scenes, failed = ({row["scene_id"] for row in some} for some in (rows, [row for row in rows if cell_of(row)]))
    failures = sum(found.failures for found in atlas.values())
    cells = [describe_cell(cell, found) for cell, found in atlas.items()]
    counts = {"rollouts": len(rows), "scenes": len(scenes), "preventable": failures, "failed_scenes": len(failed)}
    return counts | {"cells": len(cells), "atlas": cells}


def describe_cell(cell: Cell, found: Found) -> dict:
    """A cell's words, its numbers of failures and of scenes, and its likeliest failure: nats, realism, rollout."""
    row = found.likeliest
    values = {name: row.get(name) for name in ("transport", "real_adv")}
    likeliest = {"scene_id": row["scene_id"], "seed": row["seed"], "file": rollout_name(row)}
    counts = {"failures": found.failures, "scenes": found.scenes}
    return dict(zip(CELL, cell, strict=True)) | counts | values | {"likeliest": likeliest}
