"""How near a rollout comes to a preventable failure: a continuous verdict that guides a
search.

Without a contact it is minus the least over time of the distance of the ego to a
vehicle that moves relative to it, in time and space: (t^2 + d^2)^(1/2) of their closest
approach at constant velocities, t s ahead and d m between the sides. A contact has 0 to
1, by how much of the ego's speed the competent driver in its place loses before its own
contact; a preventable one has 2.
"""

import torch
from torch import Tensor

from e2rl.metrics.catalogue import Batch, Metric, columns
from e2rl.metrics.contact import steps_until
from e2rl.metrics.geometry import velocity
from e2rl.metrics.preventable import CREEPING
from e2rl.scenes.recording import VEHICLE

FARTHEST = 30.0  # s and m: nobody who counts is nearer
CLOSING = 1.0  # m/s of relative velocity from which on a pair counts
PREVENTED = 2.0


@columns(Metric("margin", "nearness to a preventable failure (docs/guide/evaluate.md)"))
def margin_columns(batch: Batch) -> Batch:
    """margin [B]."""
    return {
        "margin": torch.where(
            batch["hit"],
            contact_margin(batch),
            -approach_distance(batch).amin(1),
        )
    }


def approach_distance(batch: Batch) -> Tensor:
    """(t^2 + d^2)^(1/2) [B, T+1] of the ego's nearest closest approach at each step
    until its first contact, at most FARTHEST; FARTHEST at step 0 and after a contact.
    """
    states = batch["states"]
    valid = batch["valid"]
    size = batch["size"]
    moving = velocity(states)
    offset = states[..., :2] - states[:, :, :1, :2]
    closing = moving - moving[:, :, :1]
    speed = closing.norm(dim=-1)
    time = (-(offset * closing).sum(-1) / speed.square().clamp(min=1e-6)).clamp(min=0)
    half = (size[:, :, 1] + size[:, :1, 1])[:, None] / 2  # as if side by side
    miss = ((offset + closing * time[..., None]).norm(dim=-1) - half).clamp(min=0)
    counted = (
        valid
        & valid[..., :1]
        & (batch["agent_type"] == VEHICLE)[:, None]
        & (speed > CLOSING)
    )
    counted = counted & steps_until(batch["stop"], states.shape[1])[..., None]
    counted[..., 0] = False
    return (
        torch.hypot(time, miss)
        .masked_fill(~counted, FARTHEST)
        .amin(-1)
        .clamp(max=FARTHEST)
    )


def contact_margin(batch: Batch) -> Tensor:
    """Of rollouts [B] with a contact: PREVENTED where it is preventable, else the
    fraction of the ego's speed that the competent driver has lost at the step before
    the contact; 0 where the ego hardly moves."""
    row = torch.arange(len(batch["stop"]), device=batch["stop"].device)
    speed = batch["states"][row, batch["before"], 0, 3].abs()
    speed_lost = 1 - batch["driver"][row, batch["before"], 3] / speed.clamp(
        min=CREEPING
    )
    speed_lost = (speed_lost.nan_to_num(0.0) * (speed > CREEPING)).clamp(0, 1)
    return torch.where(batch["preventable"] == 1, PREVENTED, speed_lost)
