"""A run's folder on a bundled scene in which a car appears in the ego, with plans and an
evasion; another car comes late and is away for a while."""

from pathlib import Path

import numpy as np
import torch

import e2rl
from e2rl.evaluation.rollout_files import TABLE, read_rows
from e2rl.sim.rollout_file import Failure, Rollout
from e2rl.sim.rollouts import Rollouts
from tests.metrics.random_rollouts import sourced
from tests.report.export.small_run import save_run
from tests.report.failed_run import planned

CONTACT = 40  # step at which the car is in the ego


def write_run(folder: Path) -> Path:
    """Write the run, whose data are not beside it; return its folder."""
    scenes = e2rl.load_scenes("bundled", num_scenes=1)
    states = scenes.scenes["logged"].clone()
    valid = scenes.scenes["logged_valid"].clone()
    states[:, 0] = scenes.scenes["start"]
    car, late = (np.flatnonzero(valid[0, :, 1:].all(0)) + 1)[:2].tolist()
    states[0, CONTACT:, car] = states[0, CONTACT:, 0]
    valid[0, :10, late] = False
    valid[0, 20:25, late] = False
    agents = states.shape[2]
    rollouts = Rollouts.in_scenes(
        scenes,
        torch.arange(1),
        states=states,
        valid=valid,
        adversaries=torch.arange(agents)[None] == car,
        seed=torch.zeros(1, dtype=torch.int64),
        eta=torch.full((1,), 2.0, dtype=torch.float64),
    )
    rollouts = sourced(rollouts, "bundled", split="test", method="e2", ego="log")
    return save_run(folder, {}, rollouts=planned(rollouts))


def failure_of(run: Path) -> Failure:
    """The failure of the run."""
    (row,) = read_rows(run / TABLE)
    return Failure.read(run, row)


def gaps(rollout: Rollout, states: np.ndarray, partner: int) -> np.ndarray:
    """How far [K] m the shadows of a box of the ego's size in `states` and of the
    partner's lie apart, on that normal of a side on which they are farthest apart."""
    boxes = [
        corners(states, rollout.size[rollout.ego]),
        corners(rollout.states[:, partner], rollout.size[partner]),
    ]
    normals = np.concatenate([box[:, :2] - box[:, 1:3] for box in boxes], 1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    first, second = (np.einsum("knc,kpc->knp", normals, box) for box in boxes)
    apart = np.maximum(
        second.min(-1) - first.max(-1),
        first.min(-1) - second.max(-1),
    )
    return apart.max(-1).clip(min=0)


def corners(states: np.ndarray, size: np.ndarray) -> np.ndarray:
    """The corners [K, 4, 2] m of a box, one beside the next."""
    heading = states[:, 2].astype(float)
    ahead = np.stack([np.cos(heading), np.sin(heading)], -1) * size[0] / 2
    left = np.stack([-np.sin(heading), np.cos(heading)], -1) * size[1] / 2
    offsets = [ahead + left, left - ahead, -ahead - left, ahead - left]
    return np.stack([states[:, :2].astype(float) + offset for offset in offsets], 1)
