"""A metric: in how many rollouts the ego brakes by more than 4 m/s^2, harder than a
comfortable driver would."""

from torch import Tensor

from e2rl.metrics.catalogue import rate, register
from e2rl.scenes.recording import DT


def hard_braking(batch: dict[str, Tensor]) -> Tensor:
    """1 [B] where the ego does so between two steps, 0 elsewhere."""
    speed = batch["states"][:, :, 0, 3]
    valid = batch["valid"][:, :, 0]
    return (
        ((speed.diff(dim=1) / DT < -4.0) & valid[:, 1:] & valid[:, :-1]).any(1).double()
    )


register(
    rate("hard_braking", "ego brakes by more than 4 m/s²", tables="main"), hard_braking
)
