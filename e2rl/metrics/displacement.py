"""Open-loop displacement: how far sampled plans end up from the recording, of moving
vehicles other than the ego.

ADE is the mean distance over all steps of 0.1 s up to a horizon, of vehicles recorded
throughout it. minADE takes each vehicle's best sample, the joint minADE the scene's
best sample for all its vehicles at once. Ratios are quotients of sums over vehicles.
"""

import torch
from torch import Tensor

from e2rl.metrics.catalogue import OPEN_LOOP_STAGE, STAGES, Metric
from e2rl.metrics.realism import MOVING
from e2rl.scenes.recording import DT

HORIZONS = (3, 5)  # s
STAGES[OPEN_LOOP_STAGE] = tuple(
    Metric(f"{name}_{horizon}", about.format(horizon), unit=unit)
    for horizon in HORIZONS
    for name, about, unit in (
        ("min_ade", "mean displacement over {} s, each vehicle's best sample", "m"),
        ("mean_ade", "the same, mean over samples", "m"),
        ("joint_ade", "the same, the scene's best sample for all its vehicles", "m"),
        ("cv_ade", "constant velocity's displacement over {} s, same vehicles", "m"),
        ("min_ade_ratio", "min_ade over cv_ade at {} s", ""),
        ("mean_ade_ratio", "mean_ade over cv_ade at {} s", ""),
    )
)


def moving_vehicles(
    logged: Tensor, logged_valid: Tensor, simulated: Tensor, steps: int
) -> Tensor:
    """Bool [B, V]: simulated vehicles, not the ego, faster than MOVING at step 0 of the
    log and recorded to `steps`.

    logged [B, T+1, V, 4], logged_valid [B, T+1, V], simulated [B, V].
    """
    throughout = (
        logged_valid[:, : steps + 1].all(1)
        if logged.shape[1] > steps
        else torch.zeros_like(simulated)
    )
    counted = simulated & throughout & (logged[:, 0, :, 3] > MOVING)
    return torch.cat([torch.zeros_like(counted[:, :1]), counted[:, 1:]], 1)


def displacement(plans: Tensor, logged: Tensor) -> Tensor:
    """ADE [B, S, V, H] [m] up to each step of plans [B, S, V, H, >= 2] against the log
    [B, V, H, >= 2]."""
    gap = (plans[..., :2] - logged[:, None, ..., :2]).norm(dim=-1)
    return gap.cumsum(-1) / torch.arange(1, gap.shape[-1] + 1, device=gap.device)


def scene_displacements(
    plans: Tensor,
    reference: Tensor,
    logged: Tensor,
    logged_valid: Tensor,
    simulated: Tensor,
) -> dict[str, Tensor]:
    """Sums [B] over each scene's counted vehicles, and their number, for each of
    HORIZONS.

    plans [B, S, V, H, 4]: samples of steps 1..H; reference [B, V, H, 4]: constant
    velocity; logged [B, T+1, V, 4]. Keys, with the horizon in s appended: min_ade_,
    mean_ade_, joint_ade_ (the best joint sample), cv_ade_, vehicles_.
    """
    steps = torch.arange(1, plans.shape[3] + 1, device=logged.device)
    future = logged[:, steps.clamp(max=logged.shape[1] - 1)].transpose(
        1, 2
    )  # no vehicle counts after the log's end
    planned = displacement(plans, future)
    constant = displacement(reference[:, None], future)[:, 0]
    columns: dict[str, Tensor] = {}
    for horizon in HORIZONS:
        last = round(horizon / DT)
        counted = moving_vehicles(logged, logged_valid, simulated=simulated, steps=last)
        ade = torch.where(counted[:, None], planned[..., last - 1], 0.0)
        found = {
            "min_ade": ade.amin(1).sum(-1),
            "mean_ade": ade.mean(1).sum(-1),
            "joint_ade": ade.sum(-1).amin(1),
            "cv_ade": torch.where(counted, constant[..., last - 1], 0.0).sum(-1),
            "vehicles": counted.sum(-1),
        }
        columns |= {f"{name}_{horizon}": value for name, value in found.items()}
    return columns
