"""Sparse control (Sec. IV-B) inside every step of the reverse SDE.

By default anchors and kernels act, as pulls (pull.py). The guidance that the paper
prints (eqs. 14 and 16, paper.py) acts before them where `guidance` is set. The last
step has no noise, so that no control of it has a price in nats; it is the prior's.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from e2rl.prior.lane_relative import ACCEL_SCALE, KNOTS
from e2rl.prior.prior import Context
from e2rl.run.config import configured, setting
from e2rl.run.errors import InputError
from e2rl.traffic.e2.pull import Pull

Denoise = Callable[[Tensor], Tensor]  # x [B, V, SIZE] -> clean estimate [B, V, SIZE]


@configured("synthesizer/e2", "control")
@dataclass(frozen=True)
class ControlSettings:
    """How anchors act, and what control may cost; conf/synthesizer/e2.yaml explains
    each."""

    anchoring: str = setting(choices=("clean", "literal", "raw", "off"))
    transport_budget: float | None = setting(low=0, optional=True)

    def __post_init__(self) -> None:
        """Raises InputError for a budget of nats beside raw proposals, which have no
        price."""
        if self.anchoring == "raw" and self.transport_budget is not None:
            raise InputError(
                "synthesizer.control.anchoring=raw drives proposals as they are, at no "
                "price in nats: set transport_budget=null"
            )


class Guidance(Protocol):
    """What moves a sample before the pulls do (`paper.MaskedGuidance`)."""

    def blend(
        self,
        x: Tensor,
        level: Tensor,
        k: int,
        context: Context,
        denoise: Denoise,
    ) -> Tensor:
        """Returns x after anchoring; arguments of `SparseControl`.

        Args:
            x: [B, V, SIZE], of step k.
            level: noise level of the step.
            k: steps left, this one included.
            context: of the replan.
            denoise: the prior's clean estimate of x at this level.
        """

    def estimate(
        self,
        x: Tensor,
        level: Tensor,
        k: int,
        context: Context,
        denoise: Denoise,
    ) -> tuple[Tensor, Tensor]:
        """Returns the clean estimate x0 and the guided one, [B, V, SIZE] each.

        Args:
            x: [B, V, SIZE], of step k.
            level: noise level of the step.
            k: steps left, this one included.
            context: of the replan.
            denoise: the prior's clean estimate of x at this level.
        """


@dataclass
class SparseControl:
    """The control of one replan of B scenes; `Prior.sample` calls it at every noise
    level.

    attacked [B] bool: scenes with an intensity above 0; pulls: in the order in which
    they act; guidance: None, pulls alone; raw: proposed accelerations [B, V, KNOTS]
    m/s^2 that take the sample's place, NaN where none does; None: nowhere.
    """

    attacked: Tensor
    pulls: Sequence[Pull]
    guidance: Guidance | None = None
    raw: Tensor | None = None

    def __call__(
        self,
        x: Tensor,
        level: Tensor,
        k: int,
        context: Context,
        denoise: Denoise,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Returns x after anchoring, the clean estimate x0 and the controlled one.

        Args:
            x: [B, V, SIZE], of step k.
            level: noise level of the step.
            k: steps left, this one included.
            context: of the replan.
            denoise: the prior's clean estimate of x at this level.
        """
        if self.guidance is None:
            with torch.no_grad():
                x0 = guided = denoise(x)
        else:
            x = self.guidance.blend(x, level, k=k, context=context, denoise=denoise)
            x0, guided = self.guidance.estimate(
                x,
                level,
                k=k,
                context=context,
                denoise=denoise,
            )
        if k == 1:
            return x, x0, self._with_raw_proposals(x0)
        for pull in self.pulls:
            guided = pull(guided, level)
        controlled = context.active & self.attacked[:, None]
        return x, x0, torch.where(controlled[..., None], guided, x0)

    def _with_raw_proposals(self, x0: Tensor) -> Tensor:
        """The last x0 [B, V, SIZE] with raw proposals in the sample's place."""
        if self.raw is None:
            return x0
        lateral = torch.zeros_like(x0[..., KNOTS:])
        proposal = torch.cat([self.raw / ACCEL_SCALE, lateral], -1)
        return torch.where(proposal.isnan().any(-1, keepdim=True), x0, proposal)
