"""A run's folder on two scenes of a fork with lights: in the first a car cuts in on the
ego, which hits it."""

import csv
import json
from pathlib import Path

import numpy as np
import torch
from omegaconf import OmegaConf

from e2rl.commands.export import LIST, main
from e2rl.evaluation.rollout_files import TABLE, write_rows
from e2rl.metrics.score import score_rollouts
from e2rl.scenes.recording import CYCLIST, OTHER, PEDESTRIAN
from e2rl.scenes.source import load_scenes
from e2rl.sim.rollout_file import ROLLOUTS, Rollout, rollout_name
from e2rl.sim.rollouts import Rollouts
from tests.metrics.random_rollouts import sourced
from tests.scenes.descriptions import (
    FRAMES,
    data_config,
    description,
    numbered,
    straight,
    track,
    write_folder,
)

PHASES = ["LANE_STATE_STOP"] * 40 + ["LANE_STATE_GO"] * (FRAMES - 40)
GAPS = ((12, 30), (33, 45), (50, 51))  # steps at which LATE is there
CUT_IN, LATE, TRUCK = 1, 2, 3  # rows: vehicles by their distance from the ego


def light(lane: str, states: list[str]) -> dict:
    return {"type": "TRAFFIC_LIGHT", "lane": lane, "state": {"object_state": states}}


def turning() -> dict:
    """A truck of 9 m on a circle, so that its heading passes pi."""
    angle = 2.0 + 0.02 * np.arange(FRAMES)
    place = np.stack([60 + 40 * np.sin(angle), 40 - 40 * np.cos(angle)], 1)
    return track(
        place, (angle + np.pi) % (2 * np.pi) - np.pi, speed=8.0, size=(9.0, 2.5)
    )


def scenes() -> list[dict]:
    tracks = {
        "ego": straight(20, 0, speed=8),
        "cut in": straight(32, 3.5, speed=8),
        "truck": turning(),
        "late": straight(5, 3.5, speed=6),
        "walker": straight(40, -6, speed=1, kind="PEDESTRIAN", size=(0.6, 0.5)),
        "rider": straight(30, -4, speed=4, kind="CYCLIST", size=(1.8, 0.7)),
        "box": straight(70, -7, speed=0, kind="TRAFFIC_CONE", size=(0.4, 0.4)),
    }
    lights = {
        "on": light("on", PHASES),
        "left": light("left", ["LANE_STATE_GO"] * FRAMES),
    }
    return numbered(
        [
            description(tracks, map="a place") | {"dynamic_map_states": lights}
            for _ in range(2)
        ]
    )


def write_run(folder: Path) -> Path:
    """Write the run, and its data beside it; return its folder."""
    data = data_config(write_folder(folder / "data", scenes()), folder / "cache")
    build = {"steps": 80, "vehicles": 8, "others": 4, "field_cells": 64}
    data |= {"build": build, "path": "data"}  # relative to where the command ran
    result = load_scenes(data | {"path": str(folder / "data")})
    batch = {key: result.scenes[key] for key in result.scenes.keys()}  # noqa: SIM118 - not a dict
    states = batch["logged"].clone()
    valid = batch["logged_valid"].clone()
    states[:, 0] = batch["start"]
    states[0, 30:, CUT_IN] = states[0, 30:, 0] + torch.tensor([5.5, 0.6, 0.0, -6.0])
    states[0, 34:, CUT_IN, 0] = states[0, 34, CUT_IN, 0]  # it stops
    states[0, 34:, CUT_IN, 3] = 0.0
    late = torch.zeros(states.shape[1], dtype=torch.bool)
    for first, end in GAPS:
        late[first:end] = True
    valid[:, :, LATE] = late[:, None].T
    rollouts = Rollouts.in_scenes(
        result,
        torch.arange(2),
        states=states,
        valid=valid,
        adversaries=torch.arange(valid.shape[-1])[None].expand(2, -1) == CUT_IN,
        seed=torch.zeros(2, dtype=torch.int64),
        eta=torch.full((2,), 2.0, dtype=torch.float64),
    )
    simulated = torch.arange(valid.shape[-1])[None].expand(2, -1) < 3
    rollouts = sourced(
        rollouts.replace(simulated=simulated, location=["a place"] * 2),
        "made",
        split="data",
        method="e2",
        ego="idm",
    )
    return save_run(folder, data, rollouts=rollouts)


def save_run(folder: Path, data: dict, rollouts: Rollouts) -> Path:
    """Write the run of a command in `folder` that drove `rollouts` in scenes of `data`;
    return its folder."""
    run = folder / "run"
    write_rows(run / TABLE, score_rollouts(rollouts)[0])
    rollouts.to_npz(run / ROLLOUTS)
    (run / ".hydra").mkdir()
    OmegaConf.save({"data": data}, run / ".hydra" / "config.yaml")
    start = {
        "command": "",
        "cwd": str(folder),
        "choices": {},
        "inputs": {},
        "settings": {},
        "files": {},
    }
    (run / "provenance.json").write_text(
        json.dumps(start | {"versions": [{"git": ""}]})
    )
    return run


def rollout_of(run: Path, scene: int) -> Rollout:
    """The rollout file of a scene."""
    row = {
        "method": "e2",
        "ego_policy": "idm",
        "eta": 2.0,
        "scene_id": f"scene-{scene}",
        "seed": 0,
    }
    return Rollout.read(run / ROLLOUTS / rollout_name(row))


def row_of(rollout: Rollout, kind: int) -> int:
    """The row of the only pedestrian, cyclist or other agent."""
    name = {PEDESTRIAN: "pedestrian", CYCLIST: "cyclist", OTHER: "other"}[kind]
    (row,) = np.flatnonzero((rollout.agent_type == name) & rollout.valid.any(0))
    return int(row)


def exported(run: Path, out: Path, *options: str) -> list[Path]:
    """The files that `e2rl export` writes of all rollouts into a new folder, in their
    order."""
    main([str(run), "--all", "--out", str(out), "--to", *options])
    with (out / LIST).open(newline="") as file:
        return [out / line["file"] for line in csv.DictReader(file)]
