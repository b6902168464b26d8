"""The pool of episodes: scenes with recorded traffic, stored traffic (D'), or reactive traffic."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from e2rl.errors import InputError

RECORDED, LIVE = -1, -2  # sources of a row's traffic that is not a position in the stored traffic


@dataclass
class TrafficPool:
    """R rows, each a scene with its traffic.

    scene_index [R] int64; source [R] int64: position in the stored traffic, RECORDED: the log is replayed, LIVE: a
    traffic method replans it against the ego; eta [R]: adversarial intensity, 0: none; seed [R] int64: of the noise
    of LIVE rows. Stored: states [D, T+1, N, 4], valid [D, T+1, N], adversaries [D, N] bool.
    """

    scene_index: Tensor
    source: Tensor
    eta: Tensor
    seed: Tensor
    states: Tensor | None = None
    valid: Tensor | None = None
    adversaries: Tensor | None = None

    def __len__(self) -> int:
        return len(self.scene_index)

    @property
    def adversarial(self) -> Tensor:
        """Bool [R]: rows with an adversary."""
        return self.eta > 0

    @property
    def tracks(self) -> tuple[Tensor, Tensor, Tensor]:
        """The stored states, valid and adversaries of a pool with stored traffic."""
        assert self.states is not None and self.valid is not None and self.adversaries is not None
        return self.states, self.valid, self.adversaries

    @staticmethod
    def recorded(scene_index: Tensor) -> "TrafficPool":
        """Rows that replay the recordings of scenes [R]."""
        zero = torch.zeros(len(scene_index))
        return TrafficPool(scene_index, torch.full((len(zero),), RECORDED), zero, zero.long())

    @staticmethod
    def live(scene_index: Tensor, eta: Tensor, seed: Tensor) -> "TrafficPool":
        """Rows of scenes [R] whose traffic is replanned against the ego; eta [R], seed [R]."""
        return TrafficPool(scene_index, torch.full((len(scene_index),), LIVE), eta, seed)

    @staticmethod
    def stored(traffic: Mapping[str, Tensor], eta: float) -> "TrafficPool":
        """Rows of a synthesizer's traffic at one intensity: scene_index [S], states [S, T+1, N, 4], valid [S, T+1, N]
        and adversaries [S, N] bool. Raises InputError for a missing key."""
        missing = {"scene_index", "states", "valid", "adversaries"} - set(traffic)
        if missing:
            raise InputError(f"synthesized traffic lacks {', '.join(sorted(missing))}; return them from synthesize()")
        index = traffic["scene_index"].cpu()
        count = len(index)
        tracks = (traffic[name].cpu() for name in ("states", "valid", "adversaries"))
        rows = torch.arange(count)
        return TrafficPool(index, rows, torch.full((count,), float(eta)), torch.zeros_like(rows), *tracks)

    def __add__(self, other: "TrafficPool") -> "TrafficPool":
        """Both pools' rows, this one's first."""
        count = 0 if self.states is None else len(self.states)
        source = torch.where(other.source >= 0, other.source + count, other.source)
        parts = {field.name: (getattr(self, field.name), getattr(other, field.name)) for field in fields(self)}
        parts["source"] = (self.source, source)
        joined: dict[str, Any] = {name: _joined(*pair) for name, pair in parts.items()}
        return TrafficPool(**joined)

    def probabilities(self, priority: Tensor, share: float) -> Tensor:
        """Draw probability [R] of each row: adversarial rows have total probability `share`; within a kind, rows are
        weighted by the priority [S] of their scene. If one kind has no rows, the other has probability 1."""
        weight = priority.cpu().double()[self.scene_index].clamp(min=1e-12)
        result = torch.zeros(len(self), dtype=torch.float64)
        for kind, part in ((True, share), (False, 1 - share)):
            rows = self.adversarial == kind
            if rows.any():
                result[rows] = (1.0 if rows.all() else part) * weight[rows] / weight[rows].sum()
        return result


def _joined(first: Tensor | None, second: Tensor | None) -> Tensor | None:
    if first is None or second is None:
        return second if first is None else first
    return torch.cat([first, second])
