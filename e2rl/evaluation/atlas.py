"""Atlas of a run: atlas.json, the cells of each ego, method and intensity
(docs/reference/metrics.md)."""

import json
from collections.abc import Sequence
from pathlib import Path

from e2rl.evaluation.modes import GROUP, key_of
from e2rl.metrics.atlas import CELL, Cell, atlas_of, cell_of
from e2rl.metrics.errored import lost
from e2rl.metrics.failure_modes import Row
from e2rl.sim.rollout_file import rollout_name


def find_atlas(rows: Sequence[dict]) -> dict:
    """The content of atlas.json from all rows of a run: an atlas for each ego, method
    and intensity."""
    groups: dict[tuple, list[dict]] = {}
    for row in rows:
        if not lost(row):
            groups.setdefault(key_of(row), []).append(row)
    return {
        "groups": [
            dict(zip(GROUP, key, strict=True)) | group_atlas(ours)
            for key, ours in groups.items()
        ]
    }


def group_atlas(rows: Sequence[dict]) -> dict:
    """A group's rollouts, scenes, preventable failures, scenes with one, number of
    cells, and its cells, that of the likeliest failure first."""
    failures = [row for row in rows if cell_of(row)]
    cells = [describe_cell(cell, ours) for cell, ours in atlas_of(failures).items()]
    scenes, failed = (
        len({row["scene_id"] for row in some}) for some in (rows, failures)
    )
    counts = {
        "rollouts": len(rows),
        "scenes": scenes,
        "preventable": len(failures),
        "failed_scenes": failed,
    }
    return counts | {"cells": len(cells), "atlas": cells}


def describe_cell(cell: Cell, failures: Sequence[Row]) -> dict:
    """A cell's words, its numbers of failures and of scenes, and its likeliest failure:
    nats, realism, rollout."""
    row = failures[0]
    counts = {
        "failures": len(failures),
        "scenes": len({row["scene_id"] for row in failures}),
    }
    values = {name: row.get(name) for name in ("transport", "real_adv")}
    likeliest = {
        "scene_id": row["scene_id"],
        "seed": row["seed"],
        "file": rollout_name(row),
    }
    return (
        dict(zip(CELL, cell, strict=True)) | counts | values | {"likeliest": likeliest}
    )


def read_atlas(path: Path) -> dict:
    """The only group of an atlas.json of ours."""
    (group,) = json.loads(path.read_text(encoding="utf-8"))["groups"]
    return group
