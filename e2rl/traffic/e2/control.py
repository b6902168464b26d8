"""Sparse control (Sec. IV-B) inside every step of the reverse SDE.

By default anchors and kernels act, as pulls (pull.py). The guidance that the paper
prints (eqs. 14 and 16, paper.py) acts before them where `guidance` is set. The last
step has no noise, so that no control of it has a price in nats; it is the prior's.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.prior.lane_relative import ACCEL_SCALE, KNOTS
from e2rl.prior.prior import Control, Controlled, Denoising, uncontrolled
from e2rl.run.config import configured, setting
from e2rl.run.errors import InputError
from e2rl.traffic.e2.pull import Pull


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


@dataclass
class SparseControl:
    """The control of one replan of B scenes; `Prior.sample` calls it at every noise
    level.

    attacked [B] bool: scenes with an intensity above 0; pulls: in the order in which
    they act; guidance: what moves a sample before them; raw: proposed accelerations
    [B, V, KNOTS] m/s^2 that take the sample's place, NaN where none does; None:
    nowhere.
    """

    attacked: Tensor
    pulls: Sequence[Pull]
    guidance: Control = uncontrolled
    raw: Tensor | None = None

    def __call__(self, step: Denoising) -> Controlled:
        """Returns x after anchoring, the clean estimate x0 and the controlled one,
        [B, V, SIZE] each."""
        x, x0, guided = self.guidance(step)
        if step.k == 1:
            return x, x0, self._with_raw_proposals(x0)
        for pull in self.pulls:
            guided = pull(guided, step.level)
        controlled = step.context.active & self.attacked[:, None]
        return x, x0, torch.where(controlled[..., None], guided, x0)

    def _with_raw_proposals(self, x0: Tensor) -> Tensor:
        """The last x0 [B, V, SIZE] with raw proposals in the sample's place."""
        if self.raw is None:
            return x0
        lateral = torch.zeros_like(x0[..., KNOTS:])
        proposal = torch.cat([self.raw / ACCEL_SCALE, lateral], -1)
        return torch.where(proposal.isnan().any(-1, keepdim=True), x0, proposal)
