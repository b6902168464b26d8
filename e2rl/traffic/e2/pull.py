"""The pull: how anchors and kernels move a joint sample, by which formula, at what price.

A pull draws the clean estimate x0 of some vehicles to a goal at every noise level of
the reverse SDE. Where the prior's law of x is a Gaussian of covariance C it is the
exact posterior mean under the potential

    strength (x - goal)^T C^-1 (x - goal) / 2.

What it costs is booked exactly, step by step, as path KL (eq. 5, `Prior.sample`);
`nats` says beforehand what a displacement of x costs about: delta^T C^-1 delta / 2.
"""

from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from e2rl.prior.lane_relative import KNOTS, SIZE
from e2rl.prior.sde import NoiseSchedule
from e2rl.run.fused import fused

# Standard deviations of x over 12 samples of a Waymo prior (48 scenes, DPM-Solver++),
# and the correlation of knots that are neighbours. They set how a pull is spread over x
# and over the noise levels, not what is booked.
SPREAD = (0.85, 0.53, 0.51, 0.51, 0.52, 0.54, 0.57, 0.60, 0.63, 0.71, 1.02, 0.89)
CORRELATION = 0.57


@cache
def covariance(device: torch.device) -> Tensor:
    """C [SIZE, SIZE]: knots of the acceleration are correlated like an AR(1) sequence,
    lateral knots with nothing."""
    deviation = torch.tensor(SPREAD, device=device)
    index = torch.arange(SIZE, device=device)
    lag = (index[:, None] - index).abs()
    knots = (index < KNOTS)[:, None] & (index < KNOTS)
    correlation = torch.where(knots | (lag == 0), CORRELATION**lag, 0.0)
    return deviation[:, None] * correlation * deviation


@cache
def principal_axes(device: torch.device) -> tuple[Tensor, Tensor]:
    """Eigenvalues [SIZE] and eigenvectors [SIZE, SIZE] of C."""
    values, vectors = torch.linalg.eigh(covariance(device))
    return values, vectors


def nats(displacement: Tensor) -> Tensor:
    """What displacements [..., SIZE] of x cost: delta^T C^-1 delta / 2 [...]."""
    variance, axes = principal_axes(displacement.device)
    return ((displacement @ axes).square() / variance).sum(-1) / 2


def pulled(
    x0: Tensor,
    goal: Tensor,
    strength: Tensor,
    level: Tensor,
    schedule: NoiseSchedule,
) -> Tensor:
    """Returns the posterior means [..., SIZE] of clean estimates under a pull.

    With P = (C^-1 + alpha^2 / sigma^2)^-1, the posterior covariance of the prior at
    this noise level, x0 + P (P + C / strength)^-1 (goal - x0). Strength 0 is the prior.

    Args:
        x0: [..., SIZE], clean estimates.
        goal: [..., SIZE].
        strength: [..., 1], weight of the potential.
        level: noise level in [0, 1].
        schedule: alpha and sigma of a level.
    """
    variance, axes = principal_axes(x0.device)
    ratio = (schedule.alpha(level) / schedule.sigma(level)) ** 2
    weight = strength / (strength + 1 + variance * ratio)
    return x0 + ((goal - x0) @ axes * weight) @ axes.T


@dataclass
class Pull:
    """goal [B, V, SIZE], NaN where nothing is pulled; vehicles [B, V] bool that are
    pulled to it; strength [B]."""

    goal: Tensor
    vehicles: Tensor
    strength: Tensor

    def __call__(self, x0: Tensor, level: Tensor) -> Tensor:
        """x0 [B, V, SIZE] after the pull at a noise level."""
        return pull_to(x0, self.goal, self.vehicles, self.strength, level)


@fused(f"B V {SIZE}", f"B V {SIZE}", "B V:bool", "B", "")
def pull_to(
    x0: Tensor,
    goal: Tensor,
    vehicles: Tensor,
    strength: Tensor,
    level: Tensor,
) -> Tensor:
    """Returns x0 after a `Pull`, compiled.

    Args:
        x0: [B, V, SIZE].
        goal: [B, V, SIZE], NaN where nothing is pulled.
        vehicles: [B, V] bool.
        strength: [B].
        level: noise level.
    """
    goal = torch.where(goal.isnan(), x0, goal)
    schedule = NoiseSchedule()
    moved = pulled(
        x0,
        goal,
        strength=strength[:, None, None],
        level=level,
        schedule=schedule,
    )
    return torch.where(vehicles[..., None], moved, x0)
