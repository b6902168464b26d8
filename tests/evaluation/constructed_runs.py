"""Folders of runs whose table is written by hand."""

import json
import math
from pathlib import Path

from e2rl.evaluation.rollout_files import TABLE, write_rows
from e2rl.run.files import write_atomically
from e2rl.run.run import PROVENANCE

SETTINGS = {
    "seeds": [0, 1],
    "eta": 2.0,
    "methods": ["e2"],
    "prior": {"checkpoint": "bundled"},
    "processes": 1,
}
INPUTS = {"scenes": "ab12", "synthesizer=e2": {"gain": 1.0}, "ego.file=a.pt": "cd34"}
HIT = {
    **{
        "cfr": 1.0,
        "cfr_counted": 1.0,
        "cfr_preventable": 1.0,
        "cfr_clean": 0.0,
        "counted": 1.0,
        "preventable": 1.0,
    },
    **{
        "at_fault": 0.0,
        "contact_type": "front",
        "partner": 3,
        "contact_time": 2.0,
        "contact_step": 20.0,
        "margin": 2.0,
    },
    **{
        "approach": "oncoming",
        "partner_manoeuvre": "brakes",
        "ego_manoeuvre": "brakes",
        "duty": "none",
    },
    **{"ego_speed": 7.0, "partner_speed": 5.0, "relvel": 3.0, "margin": 2.0},
}


def row_of(
    scene: int, seed: int = 0, hit: dict | bool = False, ego: str = "a", **values
) -> dict:
    """A row of rollouts.csv; every scene is a place of its own."""
    about = {
        "dataset": "d",
        "split": "s",
        "method": "e2",
        "ego_policy": ego,
        "eta": 2.0,
        "seed": seed,
    }
    about |= {
        "scene_id": f"scene_{scene}",
        "location": f"place_{scene}",
        "progress": 30.0,
        "min_dtc": 1.5,
    }
    fractions = (
        "cfr",
        "cfr_counted",
        "cfr_preventable",
        "cfr_clean",
        "cfr_vru",
        "cfr_object",
    )
    row = about | dict.fromkeys(fractions, 0.0)
    row |= {"partner": -1, "contact_step": math.nan, "margin": -3.0}
    return row | (HIT if hit else {}) | (hit if isinstance(hit, dict) else {}) | values


def run_of(
    folder: Path,
    rows: list[dict],
    settings: dict | None = None,
    inputs: dict | None = None,
) -> Path:
    """A run's folder with its table and provenance."""
    write_rows(folder / TABLE, rows)
    provenance = {
        "command": "evaluate",
        "cwd": "/",
        "choices": {},
        "files": {},
        "versions": [{"git": "", "e2rl": "1"}],
    }
    provenance |= {
        "settings": SETTINGS | (settings or {}),
        "inputs": INPUTS | (inputs or {}),
    }
    write_atomically(folder / PROVENANCE, json.dumps(provenance))
    return folder
