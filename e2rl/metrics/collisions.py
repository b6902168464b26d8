"""The collisions of a batch of rollouts: the ego and the vehicle that it hits first."""

from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.metrics.catalogue import Batch

EGO = 0
PARTNER = 1


@dataclass(frozen=True)
class Collisions:
    """C of the B rollouts of a batch; vehicles are the ego and its partner, in this
    order."""

    hit: Tensor  # [B] bool, which rollouts
    states: Tensor  # [C, T+1, 2, 4]
    valid: Tensor  # [C, T+1, 2] bool
    size: Tensor  # [C, 2, 2]
    stop: Tensor  # [C] int64, step of the contact
    before: Tensor  # [C] int64, the step before it
    kind: Tensor  # [C] int64, index into contact.KINDS
    red: Tensor  # [C, 2] int64, step of the last stop line crossed at red, -1: none
    lane_points: Tensor  # [C, M, 2]
    lane_index: Tensor  # [C, M] int64, the lane of each point, -1: padding

    @classmethod
    def of(cls, batch: Batch) -> "Collisions":
        """Those of a batch with the fields of `contact.first_contact`."""
        hit = batch["hit"]
        partner = batch["partner"][hit]
        pair = torch.stack([torch.zeros_like(partner), partner], 1)
        rows = torch.arange(len(pair))[:, None]
        ran_light = batch.get("ran_light")
        return cls(
            hit=hit,
            states=batch["states"][hit].transpose(1, 2)[rows, pair].transpose(1, 2),
            valid=batch["valid"][hit].transpose(1, 2)[rows, pair].transpose(1, 2),
            size=batch["size"][hit][rows, pair],
            stop=batch["stop"][hit],
            before=batch["before"][hit],
            kind=batch["kind"][hit],
            red=torch.full_like(pair, -1)
            if ran_light is None
            else ran_light[hit][rows, pair],
            lane_points=batch["lane_points"][hit],
            lane_index=batch["lane_index"][hit],
        )

    def __len__(self) -> int:
        return len(self.stop)

    def states_at(self, step: Tensor) -> Tensor:
        """States [C, 2, 4] at a step [C], or [C, K, 2, 4] at steps [C, K]."""
        rows = torch.arange(len(self))
        return self.states[rows if step.ndim == 1 else rows[:, None], step]

    def known_at(self, step: Tensor) -> Tensor:
        """Whether [C, K, 2] vehicles are there at steps [C, K], which may be < 0."""
        rows = torch.arange(len(self))[:, None]
        return self.valid[rows, step.clamp(min=0)] & (step >= 0)[..., None]

    def window(self, end: Tensor, steps: int) -> tuple[Tensor, Tensor]:
        """States [C, steps + 1, 2, 4] up to the step `end` [C], and the number [C] of
        steps back that both are known without a gap; earlier states repeat the first
        known one."""
        step = end[:, None] + torch.arange(-steps, 1)
        present = self.known_at(step).all(-1)
        last_present = (present.flip(1).long().cumprod(1).sum(1) - 1).clamp(min=0)
        return self.states_at(
            torch.maximum(step, (end - last_present)[:, None])
        ), last_present

    def column(self, values: Tensor, unknown: float) -> Tensor:
        """Column [B] (or [B, ...]) of values [C] (or [C, ...]), `unknown` in the other
        rollouts."""
        column = values.new_full((len(self.hit), *values.shape[1:]), unknown)
        column[self.hit] = values
        return column
