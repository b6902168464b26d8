"""Which collisions the ego could have avoided: columns of the rollouts' rows (docs/method.md, section 10)."""

import time

import torch
from tensordict import TensorDictBase

from e2rl.evasion.search import SearchSettings, find_evasions
from e2rl.scene.recording import DT
from e2rl.sim.env import SimSettings

LATE = 1.0  # s before contact at which the late search starts


def add_avoidable(rows: list[dict], rollouts: dict, scene: TensorDictBase, sim: SimSettings) -> None:
    """Add to the rows (of score_rollouts, in place) of rollouts whose ego hit a vehicle: avoidable and avoidable_1s (0
    or 1: an evasion was found from the start frame, from LATE seconds before contact), evasion_accel [m/s^2] of the
    mildest one from the start, evasion_tried (manoeuvres driven) and evasion_seconds. Other rows: NaN.

    rollouts: the rollout dict [B] of the rows; scene: their scenes [B].
    """
    collided = [index for index, row in enumerate(rows) if row["cfr"] == 1]
    if not collided:
        return
    begin, picked = time.perf_counter(), torch.tensor(collided)
    given = scene[picked], rollouts["states"][picked], rollouts["valid"][picked]
    contact = torch.tensor([int(rows[index]["contact_step"]) for index in collided])
    early = find_evasions(*given, sim)
    late = find_evasions(*given, sim, moment=(contact - round(LATE / DT)).clamp(min=0))
    found = early.found | late.found  # avoidable late implies avoidable early: drive as in the rollout until then
    peak = torch.where(early.found, early.peak, torch.where(late.found, late.peak, torch.nan))
    spent = (time.perf_counter() - begin) / len(collided)
    for row, index in enumerate(collided):
        rows[index] |= {
            "avoidable": float(found[row]),
            "avoidable_1s": float(late.found[row]),
            "evasion_accel": peak[row].item(),
            "evasion_tried": int(early.tried[row] + late.tried[row]),
            "evasion_seconds": spent,
        }


def search_effort(steps: int) -> str:
    """Caption on the search behind `avoidable`, for rollouts of `steps` steps."""
    return f"avoidable: not found after {SearchSettings().effort(steps)} counts as no"
