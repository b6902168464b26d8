"""The pool of episodes: scenes with recorded traffic, stored traffic (D'), or reactive
traffic."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.run.errors import InputError
from e2rl.traffic.decisions import RULE

RECORDED = -1  # sources of a row's traffic that are no position in the stored traffic
LIVE = -2


class StoredTraffic(NamedTuple):
    """Tracks in memory or mapped from a file: states [D, T+1, N, 4], valid [D, T+1, N]."""

    states: Tensor
    valid: Tensor


@dataclass
class TrafficPool:
    """R rows, each a scene with its traffic.

    scene_index [R] int64; source [R] int64: position in the stored traffic, RECORDED:
    the log is replayed, LIVE: a traffic method replans it against the ego; eta [R]:
    adversarial intensity, 0: none; seed [R] int64: of the noise of LIVE rows; decisions
    [R, D]: of the attack (e2rl/traffic/decisions.py). parts: the stored traffic, of
    equal T and N; positions count through all parts. Joined pools share the tracks.
    """

    scene_index: Tensor
    source: Tensor
    eta: Tensor
    seed: Tensor
    decisions: Tensor
    parts: list[StoredTraffic] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.scene_index)

    @property
    def adversarial(self) -> Tensor:
        """Bool [R]: rows with an adversary."""
        return self.eta > 0

    @cached_property
    def _ends(self) -> Tensor:
        return torch.tensor([len(part.states) for part in self.parts]).cumsum(0)

    def tracks(self, position: Tensor) -> tuple[Tensor, Tensor]:
        """Stored states [b, T+1, N, 4] and valid [b, T+1, N] at positions [b]; only
        these are read."""
        first = self.parts[0]
        number = torch.bucketize(position.contiguous(), self._ends, right=True)
        states = first.states.new_empty(len(position), *first.states.shape[1:])
        valid = first.valid.new_empty(len(position), *first.valid.shape[1:])
        for k in number.unique().tolist():
            part = self.parts[k]
            rows = number == k
            inside = position[rows] - (self._ends[k] - len(part.states))
            states[rows] = part.states[inside]
            valid[rows] = part.valid[inside]
        return states, valid

    @staticmethod
    def recorded(scene_index: Tensor) -> "TrafficPool":
        """Rows that replay the recordings of scenes [R]."""
        return _rows(
            scene_index,
            RECORDED,
            eta=torch.zeros(len(scene_index)),
        )

    @staticmethod
    def live(
        scene_index: Tensor,
        eta: Tensor,
        *,
        seed: Tensor,
        decisions: Tensor | None = None,
    ) -> "TrafficPool":
        """Returns rows that are replanned against the ego.

        Args:
            scene_index: scenes [R] int64.
            eta: intensities [R].
            seed: of the noise, [R] int64.
            decisions: of the attack, [R, D]; None: by rule.

        Returns:
            A pool of R rows.
        """
        return _rows(
            scene_index,
            LIVE,
            eta=eta,
            seed=seed,
            decisions=decisions,
        )

    @staticmethod
    def stored(traffic: Mapping[str, Tensor], eta: Tensor | float) -> "TrafficPool":
        """Rows of a synthesizer's traffic at intensities eta [S], or one for all:
        scene_index [S], states [S, T+1, N, 4], valid [S, T+1, N]. Raises InputError for
        a missing key."""
        missing = {"scene_index", *StoredTraffic._fields} - set(traffic)
        if missing:
            raise InputError(
                f"synthesized traffic lacks {', '.join(sorted(missing))}; "
                "return them from synthesize()"
            )
        index = traffic["scene_index"].cpu()
        eta = torch.as_tensor(eta, dtype=torch.float32).cpu().expand(len(index))
        pool = _rows(index, RECORDED, eta=eta)
        pool.source = torch.arange(len(index))
        pool.parts = [StoredTraffic(traffic["states"].cpu(), traffic["valid"].cpu())]
        return pool

    def __add__(self, other: "TrafficPool") -> "TrafficPool":
        """Both pools' rows, this one's first."""
        count = sum(len(part.states) for part in self.parts)
        moved = torch.where(other.source >= 0, other.source + count, other.source)
        joined = {
            name: torch.cat([getattr(self, name), getattr(other, name)])
            for name in ("scene_index", "eta", "seed", "decisions")
        }
        return TrafficPool(
            source=torch.cat([self.source, moved]),
            parts=self.parts + other.parts,
            **joined,
        )

    def probabilities(self, priority: Tensor, fraction: float) -> Tensor:
        """Draw probability [R]: `fraction` for all adversarial rows (1 or 0 where there
        is one kind), within a kind in proportion to the priority [S] of its scene."""
        weight = priority.cpu().double()[self.scene_index].clamp(min=1e-12)
        result = torch.zeros(len(self), dtype=torch.float64)
        for adversarial, share in ((True, fraction), (False, 1 - fraction)):
            rows = self.adversarial == adversarial
            share = 1.0 if rows.all() else share
            if rows.any():
                result[rows] = share * weight[rows] / weight[rows].sum()
        return result


def _rows(
    scene_index: Tensor,
    source: int,
    *,
    eta: Tensor,
    seed: Tensor | None = None,
    decisions: Tensor | None = None,
) -> TrafficPool:
    """Rows from one source; by default of seed 0, by rule."""
    zero = torch.zeros(len(scene_index), dtype=torch.int64)
    return TrafficPool(
        scene_index,
        zero + source,
        eta=eta,
        seed=zero if seed is None else seed,
        decisions=(
            torch.tensor(RULE).repeat(len(zero), 1) if decisions is None else decisions
        ),
    )


class RowDraw:
    """Draws pool rows by probability [R], with a generator of its own."""

    def __init__(self, probability: Tensor, seed: int | None = 0) -> None:
        """seed: None, of the system's entropy, anew in every process that a copy draws
        in until somebody seeds it."""
        self.probability = probability
        self.generator = torch.Generator()
        self._process = os.getpid()
        self._entropy = None
        if seed is None:
            self._entropy = self.generator.seed()
        else:
            self.generator.manual_seed(seed)

    def __call__(self, count: int) -> Tensor:
        """Rows [count]."""
        unseeded = self._entropy == self.generator.initial_seed()
        if unseeded and self._process != os.getpid():
            self._process = os.getpid()
            self._entropy = self.generator.seed()
        return torch.multinomial(
            self.probability,
            count,
            replacement=True,
            generator=self.generator,
        )
