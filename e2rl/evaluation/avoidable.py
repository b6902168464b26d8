"""Which collisions the ego could have avoided: columns of the rollouts' rows (docs/method.md, section 10)."""

import time

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.evasion.search import SearchSettings, find_evasions
from e2rl.scene.recording import DT
from e2rl.sim.env import SimSettings

LATE = 1.0  # s before contact at which the late search starts


def add_avoidable(rows: list[dict], rollouts: dict, scene: TensorDictBase, sim: SimSettings) -> Tensor:
    """Add to the rows (of score_rollouts, in place) of rollouts whose ego hit a vehicle: avoidable and avoidable_1s (0
    or 1: an evasion was found from the start frame, from LATE seconds before contact), evasion_accel [m/s^2] of the
    mildest one from the start, evasion_tried (manoeuvres driven) and evasion_seconds. Other rows: NaN.

    rollouts: the rollout dict [B] of the rows; scene: their scenes [B]. Returns the evasions [B, T+1, 4] of the ego,
    the mildest one from the start where there is one; NaN where none was found.
    """
    evasions = torch.full_like(rollouts["states"][:, :, 0], torch.nan)
    collided = [index for index, row in enumerate(rows) if row["cfr"] == 1]
    if not collided:
        return evasions
    begin, picked = time.perf_counter(), torch.tensor(collided)
    given = scene[picked], rollouts["states"][picked], rollouts["valid"][picked]
    contact = torch.tensor([int(rows[index]["contact_step"]) for index in collided])
    early = find_evasions(*given, sim)
    moment = (contact - round(LATE / DT)).clamp(min=0)
    late = find_evasions(*given, sim, moment=moment)
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
    driven = given[1][:, :, 0]
    evasions[picked[late.found]] = spliced(driven, late.states, moment)[late.found]
    evasions[picked[early.found]] = spliced(driven, early.states, torch.zeros_like(moment))[early.found]
    return evasions


def spliced(driven: Tensor, states: Tensor, moment: Tensor) -> Tensor:
    """States [B, T+1, 4] `driven` up to the step `moment` [B], then those of an evasion [B, T, 4] from there on."""
    steps = torch.arange(driven.shape[1], device=driven.device)
    since = (steps - 1 - moment[:, None]).clamp(min=0)
    after = states.gather(1, since[..., None].expand(-1, -1, 4))
    return torch.where((steps > moment[:, None])[..., None], after, driven)


def search_effort(steps: int) -> str:
    """Caption on the search behind `avoidable`, for rollouts of `steps` steps."""
    return f"avoidable: not found after {SearchSettings().effort(steps)} counts as no"
