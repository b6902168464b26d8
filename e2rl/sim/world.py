"""What an ego or a synthesizer sees of a batch of running scenes."""

from dataclasses import dataclass

from tensordict import TensorDictBase
from torch import Tensor


@dataclass
class World:
    """The moment of B scenes; agents [0] are the egos, agents [:V] the vehicles.

    scene: Scene TensorDict [B]; step [B] int64, simulated steps since the start frame; states [B, N, 4] x, y, heading,
    speed; valid [B, N]: present now; accel [B, N] m/s^2; route [B, V] int64: the route candidate each vehicle follows;
    plan [B, N, H, 4]: the others' current planned states at 0.1 s, or None where nobody plans (recorded traffic).
    """

    scene: TensorDictBase
    step: Tensor
    states: Tensor
    valid: Tensor
    accel: Tensor
    route: Tensor
    plan: Tensor | None = None
