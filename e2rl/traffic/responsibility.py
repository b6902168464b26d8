"""The yielding rule: what adversaries owe the ego (docs/reference/attack.md).

full: an adversary yields to the ego wherever its plan meets the ego's expected motion,
late but in time, unless the ego follows it; rear: adversaries behind the ego brake for
it like any driver; none: no adversary does.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.prior.bounds import Duty
from e2rl.run.config import configured, setting
from e2rl.scenes.boxes import to_frame
from e2rl.sim.dynamics import wrap
from e2rl.sim.world import World

RESPONSIBILITIES = ("full", "rear", "none")
NEAR = 4.0  # m ahead of the ego's centre from which on a vehicle leads it
# rad between headings above which a vehicle crosses the ego's path.
CROSSING = torch.pi / 6
# Cosine between the headings of vehicles that drive in the same direction.
SAME_DIRECTION = 0.5


@configured("synthesizer/e2", "yielding")
@dataclass(frozen=True)
class YieldingSettings:
    """How late adversaries yield; conf/synthesizer/e2.yaml explains each."""

    patience: float = setting(low=0)
    max_patience: float = setting(low=0)


def place_of(world: World, vehicles: int) -> tuple[Tensor, Tensor]:
    """Where the ego sees vehicles, m ahead and to the left [B, V, 2]; whether they
    drive in its direction [B, V]."""
    states = world.states[:, :vehicles]
    ego = world.states[:, :1]
    along = (states[..., 2] - ego[..., 2]).cos() > SAME_DIRECTION
    return to_frame(states[..., :2], ego), along


def followed(world: World, vehicles: int) -> Tensor:
    """Bool [B, V]: the ego drives behind the vehicle, in its track."""
    place, along = place_of(world, vehicles)
    touch = (world.scene["size"][:, :vehicles] + world.scene["size"][:, :1]) / 2
    return (
        along & (place[..., 0] > touch[..., 0]) & (place[..., 1].abs() < touch[..., 1])
    )


def leading(world: World, vehicles: int) -> Tensor:
    """Bool [B, V]: vehicles that drive in the ego's direction ahead of it, in its lane
    or beside it."""
    place, along = place_of(world, vehicles)
    return along & (place[..., 0] > NEAR)


def yields_at_once(world: World, vehicles: int) -> Tensor:
    """Bool [B, V]: vehicles that cross the ego's path from its left, and so yield where
    nothing else decides."""
    angle = wrap(world.states[:, :vehicles, 2] - world.states[:, :1, 2])
    return (angle < -CROSSING) & (angle > CROSSING - torch.pi)


def duty_of(
    responsibility: str,
    settings: YieldingSettings,
    world: World,
    coalition: Tensor,
    eta: Tensor,
    lateness: Tensor | None = None,
    owes: Tensor | None = None,
) -> Duty:
    """Returns the Duty of a coalition.

    Args:
        responsibility: one of RESPONSIBILITIES.
        settings: how late they yield.
        world: B scenes.
        coalition: [B, V] bool.
        eta: [B], intensities.
        lateness: [B] factor of the patience, and where it is above 1 of its bound
            (None: 1).
        owes: [B] bool, false: it owes the ego nothing (None: it does).
    """
    vehicles = coalition.shape[1]
    nobody = torch.zeros_like(coalition)
    zero = torch.zeros_like(eta[:, None] * coalition)
    if responsibility == "none":
        return Duty(coalition, nobody, patience=zero)
    ahead = coalition & (place_of(world, vehicles)[0][..., 0] > 0)
    if responsibility == "rear":
        return Duty(ahead, nobody, patience=zero)
    free = coalition & followed(world, vehicles)
    waits = ahead & ~yields_at_once(world, vehicles)
    lateness = torch.ones_like(eta) if lateness is None else lateness
    patience = torch.minimum(
        settings.patience * eta * lateness,
        settings.max_patience * lateness.clamp(min=1),
    )
    if owes is not None:
        free = torch.where(owes[:, None], free, coalition)
    return Duty(free, coalition & ~free, patience=patience[:, None] * waits)
