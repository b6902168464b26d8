"""Passes of the prior's network: what a method costs, whatever the machine."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from torch import Tensor, nn

from e2rl.prior.prior import Prior
from e2rl.traffic.traffic import Traffic


@dataclass
class Passes:
    """count: passes so far, of a joint sample each; one whose gradient is wanted counts twice."""

    count: int = 0

    def __call__(self, network: nn.Module, inputs: tuple[Tensor, ...], x0: Tensor) -> None:
        """A forward hook of the denoiser."""
        self.count += len(x0) * (2 if x0.requires_grad else 1)


@contextmanager
def counted_passes(traffic: Traffic) -> Iterator[Passes]:
    """The Passes that a method makes within the block; none for a method without a prior."""
    passes, prior = Passes(), getattr(traffic, "prior", None)
    if not isinstance(prior, Prior):
        yield passes
        return
    hook = prior.denoiser.register_forward_hook(passes)
    try:
        yield passes
    finally:
        hook.remove()
