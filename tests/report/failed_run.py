"""The folder of a run with failures, written from synthetic rollouts."""

from pathlib import Path

import torch

from e2rl.driving.scored import Scored
from e2rl.evaluation.record import record
from e2rl.evaluation.rollout_files import TABLE, read_rows, write_rows
from e2rl.metrics.failure_modes import is_failure
from e2rl.metrics.score import score_rollouts
from e2rl.sim.rollout_file import ROLLOUTS
from e2rl.sim.rollouts import Rollouts
from tests.metrics.random_rollouts import random_rollouts

SCENE = "<img src=x onerror=alert(1)></script>&"  # the name of a stranger's scene


def planned(rollouts: Rollouts) -> Rollouts:
    """The rollouts with straight plans of everybody, adversaries that aim at the ego,
    and an evasion of the ego."""
    replans = torch.arange(0, rollouts.states.shape[1] - 1, 5)
    current = rollouts.states[:, replans].nan_to_num()
    ahead = torch.stack([current[..., 2:3].cos(), current[..., 2:3].sin()], -1)
    distance = current[..., 3:] * 0.5 * torch.arange(1, 11)
    rollouts.plans = current[..., None, :2] + distance[..., None] * ahead
    rollouts.targets = torch.where(rollouts.adversaries, 0, -1)[:, None].expand(
        -1, len(replans), -1
    )
    rollouts.evasion = rollouts.states[:, :, 0] + torch.tensor([0.0, 3.0, 0.0, 0.0])
    return rollouts


def write_run(folder: Path, rollouts: dict[str, Rollouts]) -> Path:
    """Write all files of a run of {method: rollouts} into a folder."""
    scored = Scored()
    for method, driven in rollouts.items():
        driven.scene_id = [f"{SCENE}{index}" for index in range(len(driven))]
        driven.method = [method] * len(driven)
        scores, samples = score_rollouts(driven)
        driven.to_npz(folder / ROLLOUTS)
        scored.add(Scored(scores, samples))
    record(scored, folder, draws=20, realism_draws=2)
    return folder


def failed_run(folder: Path) -> Path:
    """A run of two methods with failures; `planned` ones know plans and evasions."""
    return write_run(
        folder,
        {
            "e2": random_rollouts(12, seed=21),
            "planned": planned(random_rollouts(12, seed=20)),
        },
    )


def preventable_run(folder: Path) -> Path:
    """The same run, but each failure is preventable, in one of three cells of the
    atlas; those of the first know no nats."""
    rows = read_rows(failed_run(folder) / TABLE)
    same = {
        "cfr_preventable": 1.0,
        "partner_manoeuvre": "brakes",
        "contact_type": "front",
        "ego_speed": 7.0,
    }
    for number, row in enumerate(filter(is_failure, rows)):
        row |= same | {
            "duty": ("none", "none", "light")[number % 3],
            "approach": ("ahead", "oncoming")[number % 3 > 0],
        }
        row["transport"] = float(97 * number % 31) if number % 3 else float("nan")
    write_rows(folder / TABLE, rows)
    return folder
