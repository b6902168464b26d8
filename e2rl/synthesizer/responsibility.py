"""The duty of care of adversaries towards the ego (docs/adversaries.md).

full: an adversary gives way to the ego unless its plan keeps the law (margin.py) or the ego follows it; rear:
adversaries behind the ego brake for it like any driver; none: no adversary does.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.prior.bounds import Duty
from e2rl.scene.boxes import to_frame
from e2rl.settings import check_range
from e2rl.sim.world import World
from e2rl.synthesizer.margin import competent_margin

RESPONSIBILITIES = ("full", "rear", "none")
NEAR = 4.0  # m ahead of the ego's centre from which on a vehicle leads it
SAME_WAY = 0.5  # cosine between the headings of vehicles that drive the same way


@dataclass(frozen=True)
class CareSettings:
    """How late adversaries give way; conf/synthesizer/e2.yaml explains each."""

    patience: float = 1.0
    max_patience: float = 2.0

    def __post_init__(self) -> None:
        check_range("synthesizer.care.patience", self.patience, 0)
        check_range("synthesizer.care.max_patience", self.max_patience, 0)


def place_of(world: World, vehicles: int) -> tuple[Tensor, Tensor]:
    """Where the ego sees vehicles: m ahead and to the left [B, V, 2]; and whether they drive its way [B, V]."""
    states, ego = world.states[:, :vehicles], world.states[:, :1]
    return to_frame(states[..., :2], ego), (states[..., 2] - ego[..., 2]).cos() > SAME_WAY


def followed(world: World, vehicles: int) -> Tensor:
    """Bool [B, V]: the ego drives behind the vehicle, in its track."""
    place, along = place_of(world, vehicles)
    touch = (world.scene["size"][:, :vehicles] + world.scene["size"][:, :1]) / 2
    return along & (place[..., 0] > touch[..., 0]) & (place[..., 1].abs() < touch[..., 1])


def leading(world: World, vehicles: int) -> Tensor:
    """Bool [B, V]: vehicles that drive the ego's way ahead of it, in its lane or beside it."""
    place, along = place_of(world, vehicles)
    return along & (place[..., 0] > NEAR)


def lawful(world: World, coalition: Tensor, planned: Tensor, ego_plan: Tensor) -> Tensor:
    """Bool [B, V]: members of the coalition whose planned states [B, V, H, 4] a competent driver in the ego's place
    survives; ego_plan [B, H, 4]: what is known of the ego."""
    b, v = coalition.nonzero(as_tuple=True)
    ego = torch.cat([world.states[:, :1], ego_plan], 1)
    motion = torch.cat([world.states[b, v][:, None], planned[b, v]], 1)
    size = world.scene["size"]
    margin = competent_margin(ego[b], size[b, 0], motion, size[b, v])
    return torch.zeros_like(coalition).index_put((b, v), margin > 0)


def duty_of(
    responsibility: str,
    settings: CareSettings,
    world: World,
    coalition: Tensor,
    eta: Tensor,
    planned: Tensor,
    ego_plan: Tensor,
) -> Duty:
    """The Duty of a coalition [B, V] at intensities eta [B].

    planned [B, V, H, 4]: states that adversaries are about to drive; ego_plan [B, H, 4]: what is known of the ego.
    """
    vehicles, nobody, zero = coalition.shape[1], torch.zeros_like(coalition), torch.zeros_like(planned[..., 0, 0])
    if responsibility == "none":
        return Duty(coalition, nobody, zero)
    ahead = coalition & (place_of(world, vehicles)[0][..., 0] > 0)
    if responsibility == "rear":
        return Duty(ahead, nobody, zero)
    free = coalition & (followed(world, vehicles) | lawful(world, coalition, planned, ego_plan))
    patience = (settings.patience * eta).clamp(max=settings.max_patience)[:, None] * ahead
    return Duty(free, coalition & ~free, patience)
