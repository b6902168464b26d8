"""Exports for the clients: of a small run with a contact and lights, and of the bundled
places."""

import os
import subprocess
import sys

import pytest
import torch

from e2rl.scenes.bundled import BundledSource
from e2rl.scenes.source import load_scenes
from e2rl.sim.rollouts import Rollouts
from tests.metrics.random_rollouts import sourced
from tests.report.export.clients.environment import environment
from tests.report.export.small_run import save_run


@pytest.fixture(scope="session")
def places(tmp_path_factory):
    """The folder of a run that replays the first scene of each place of the bundled
    test scenes."""
    folder = tmp_path_factory.mktemp("places")
    recordings = reversed(list(BundledSource(split="test").recordings()))
    first = {recording.location: recording.scene_id for recording in recordings}
    listed = folder / "scenes.csv"
    listed.write_text("\n".join(["scene_id", *sorted(first.values())]) + "\n")
    data = {
        "_target_": "e2rl.scenes.bundled.BundledSource",
        "split": "test",
        "cache": str(folder / "cache"),
    }
    data |= {"build": {"field_cells": 64}}
    scenes = load_scenes(data, scenes=listed)
    batch = {key: scenes.scenes[key] for key in ("start", "logged", "logged_valid")}
    states = batch["logged"].clone()
    states[:, 0] = batch["start"]
    count = len(states)
    agents = states.shape[2]
    rollouts = Rollouts.in_scenes(
        scenes,
        torch.arange(count),
        states=states,
        valid=batch["logged_valid"],
        adversaries=torch.zeros(count, agents, dtype=torch.bool),
        seed=torch.zeros(count, dtype=torch.int64),
        eta=torch.zeros(count, dtype=torch.float64),
    )
    return save_run(
        folder,
        data,
        rollouts=sourced(rollouts, "bundled", split="test", method="replay", ego="log"),
    )


@pytest.fixture(scope="session")
def commonroad_files(tmp_path_factory):
    """Exports a run to CommonRoad: its files, in the order of scenes."""
    library = environment("commonroad-io")
    (packages,) = library.glob("lib/python*/site-packages")

    def files(run, name):
        out = tmp_path_factory.mktemp(name) / "out"
        variables = os.environ | {
            "PYTHONPATH": os.pathsep.join([os.getcwd(), str(packages)])
        }
        command = [
            sys.executable,
            "-m",
            "e2rl.commands.cli",
            "export",
            run,
            "--all",
            "--out",
            out,
            "--to",
            "commonroad",
        ]
        process = subprocess.run(
            [str(part) for part in command],
            env=variables,
            capture_output=True,
            text=True,
        )
        assert process.returncode == 0, process.stderr[-3000:]
        return sorted(
            out.glob("*.xml"),
            key=lambda path: int(path.stem.split("-")[1].split("_")[0]),
        )

    return files
