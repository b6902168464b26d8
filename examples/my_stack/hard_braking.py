"""A metric: in how many rollouts the ego brakes harder than a comfortable driver would."""

from torch import Tensor

from e2rl.metrics.catalogue import Metric, register
from e2rl.scenes.recording import DT

LIMIT = 4.0  # m/s^2


def hard_braking(batch: dict[str, Tensor]) -> Tensor:
    """1 [B] where the ego brakes by more than LIMIT between two steps before its first contact, 0 elsewhere."""
    speed, valid = batch["states"][:, :, 0, 3], batch["valid"][:, :, 0]
    both = valid[:, 1:] & valid[:, :-1]
    return ((speed.diff(dim=1) / DT < -LIMIT) & both).any(1).double()


register(Metric("hard_braking", "ego brakes by more than 4 m/s²", fraction=True, tables=("main",)), hard_braking)
