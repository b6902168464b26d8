"""The reward of a step: TERMS, and their weighted sum (weights in
conf/sim/default.yaml)."""

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.run.errors import InputError
from e2rl.scenes.recording import DT

TERMS = (
    "progress",
    "contact",
    "fault",
    "off_road",
    "comfort",
    "acceleration",
    "speeding",
    "lane_offset",
)
# m/s: progress at this speed is rewarded even where the recorded ego stands.
LEAST_TOP_SPEED = 5.0


class Conduct(NamedTuple):
    """What egos did in a step.

    progress [B]: m along the mission (`rewarded_progress`); contact, fault, off_road
    [B] bool, fault: a contact of the ego's own making; action, last_action [B, 2]:
    executed acceleration m/s^2 and yaw rate rad/s; speed, limit [B] m/s, limit 0:
    unknown, never exceeded; offset [B]: m from the mission route.
    """

    progress: Tensor
    contact: Tensor
    fault: Tensor
    off_road: Tensor
    action: Tensor
    last_action: Tensor
    speed: Tensor
    limit: Tensor
    offset: Tensor


def rewarded_progress(progress: Tensor, limit: Tensor, top_speed: Tensor) -> Tensor:
    """The part [B] m of a step's progress [B] m that is rewarded: driving faster than
    allowed does not pay.

    Allowed is the recorded ego's top_speed [B] m/s, which counts as at least
    LEAST_TOP_SPEED, and no more than the speed limit [B] m/s where it is known (not 0).
    """
    allowed = top_speed.clamp(min=LEAST_TOP_SPEED)
    allowed = torch.where(limit > 0, torch.minimum(limit, allowed), allowed)
    return torch.minimum(progress, allowed * DT)


def reward_terms(conduct: Conduct) -> dict[str, Tensor]:
    """The TERMS, each [B], of one step."""
    acceleration, yaw_rate = conduct.action.unbind(-1)
    jerk = (acceleration - conduct.last_action[:, 0]) / DT
    lateral = conduct.speed * yaw_rate
    comfort = (acceleration / 4) ** 2 + (lateral / 4) ** 2 + (jerk / 20) ** 2
    limit = conduct.limit
    excess = (conduct.speed - limit).clamp(min=0) / limit.clamp(min=1.0)
    return {
        "progress": conduct.progress,
        "contact": conduct.contact.float(),
        "fault": conduct.fault.float(),
        "off_road": conduct.off_road.float(),
        "comfort": comfort.clamp(max=3.0),
        "acceleration": (acceleration.abs() / 4).clamp(max=1.0),
        "speeding": torch.where(limit > 0, excess, 0.0).clamp(max=1.0),
        "lane_offset": (conduct.offset.abs() / 2).clamp(max=1.0),
    }


def check_weights(weights: Mapping[str, float]) -> list[float]:
    """The weights in the order of TERMS; raises InputError for an unknown name or a
    missing term."""
    wrong = set(weights) ^ set(TERMS)
    if wrong:
        raise InputError(
            f"sim.reward: {', '.join(sorted(wrong))} missing or unknown; give exactly "
            f"{', '.join(TERMS)}"
        )
    return [float(weights[name]) for name in TERMS]


def weighted_sum(terms: Mapping[str, Tensor], weights: Tensor) -> Tensor:
    """Reward [B]; weights [8] in the order of TERMS."""
    return torch.stack([terms[name] for name in TERMS], -1) @ weights
