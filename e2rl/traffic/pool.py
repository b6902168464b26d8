"""The pool of episodes: scenes with recorded traffic, stored traffic (D'), or reactive
traffic."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.run.errors import InputError
from e2rl.traffic.decisions import OWES, RULE
from e2rl.traffic.traffic import FULL

RECORDED, LIVE = (
    -1,
    -2,
)  # sources of a row's traffic that is not a position in the stored traffic


class StoredTraffic(NamedTuple):
    """Tracks in memory or mapped from a file: states [D, T+1, N, 4], valid [D, T+1, N],
    adversaries [D, N] bool; and where an evasion of the ego's contact is known, its
    actions evasion [D, T, 2] and the steps span [D, 2] int64 from .. up to which it
    acts, (0, 0) where none is."""

    states: Tensor
    valid: Tensor
    adversaries: Tensor
    evasion: Tensor
    span: Tensor


TRACKS = StoredTraffic._fields[:3]
EVASIONS = StoredTraffic._fields[3:]


@dataclass
class TrafficPool:
    """R rows, each a scene with its traffic.

    scene_index [R] int64; source [R] int64: position in the stored traffic, RECORDED:
    the log is replayed, LIVE: a traffic method replans it against the ego; eta [R]:
    adversarial intensity, 0: none; template [R] int64: causal template of the attack
    (e2rl/traffic/traffic.py); seed [R] int64: of the noise of LIVE rows; decisions [R,
    D]: of the attack (e2rl/traffic/decisions.py); weight [R]: in draws; fresh [R]
    bool: made for this round, not remembered from an earlier one. parts: the stored
    traffic, of equal T and N; positions count through all parts. Joined pools share the
    tracks.
    """

    scene_index: Tensor
    source: Tensor
    eta: Tensor
    template: Tensor
    seed: Tensor
    decisions: Tensor
    weight: Tensor
    fresh: Tensor
    parts: list[StoredTraffic] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.scene_index)

    @property
    def adversarial(self) -> Tensor:
        """Bool [R]: rows with an adversary."""
        return self.eta > 0

    @cached_property
    def adversaries(self) -> Tensor:
        """Bool [D, N] of all stored traffic; unlike the tracks they are small, and
        every step reads them."""
        return torch.cat([part.adversaries for part in self.parts])

    @cached_property
    def _ends(self) -> Tensor:
        return torch.tensor([len(part.states) for part in self.parts]).cumsum(0)

    def tracks(self, at: Tensor) -> tuple[Tensor, Tensor]:
        """Stored states [b, T+1, N, 4] and valid [b, T+1, N] at positions [b]; only
        these are read."""
        first = self.parts[0]
        number = torch.bucketize(at, self._ends, right=True)
        states = first.states.new_empty(len(at), *first.states.shape[1:])
        valid = first.valid.new_empty(len(at), *first.valid.shape[1:])
        for k in number.unique().tolist():
            part = self.parts[k]
            rows = (number == k).nonzero()[:, 0]
            inside = at[rows] - (self._ends[k] - len(part.states))
            states[rows], valid[rows] = part.states[inside], part.valid[inside]
        return states, valid

    def evaded(self, number: int) -> tuple[Tensor, Tensor, Tensor]:
        """Rows [b] whose traffic is of parts[number] and has an evasion, its actions
        [b, T, 2] and its span [b, 2]."""
        part = self.parts[number]
        at = self.source - (self._ends[number] - len(part.states))
        rows = ((at >= 0) & (at < len(part.states)) & (self.source >= 0)).nonzero()[
            :, 0
        ]
        rows = rows[part.span[at[rows], 1] > 0]
        return rows, part.evasion[at[rows]], part.span[at[rows]]

    @staticmethod
    def recorded(scene_index: Tensor) -> "TrafficPool":
        """Rows that replay the recordings of scenes [R]."""
        return _rows(scene_index, RECORDED, eta=torch.zeros(len(scene_index)))

    @staticmethod
    def live(
        scene_index: Tensor,
        eta: Tensor,
        seed: Tensor,
        template: Tensor | None = None,
        decisions: Tensor | None = None,
    ) -> "TrafficPool":
        """Rows of scenes [R] that are replanned against the ego; eta [R], seed [R],
        template [R] (None: full), decisions [R, D] (None: by rule)."""
        return _rows(
            scene_index,
            LIVE,
            eta=eta,
            seed=seed,
            template=template,
            decisions=decisions,
        )

    @staticmethod
    def stored(
        traffic: Mapping[str, Tensor],
        eta: Tensor | float,
        template: Tensor | None = None,
    ) -> "TrafficPool":
        """Rows of a synthesizer's traffic at intensities eta [S], or one for all, and
        templates [S] (None: full for all): scene_index [S], states [S, T+1, N, 4],
        valid [S, T+1, N] and adversaries [S, N] bool, and if known evasion [S, T, 2]
        with span [S, 2], and owes [S] bool (True for all): adversaries yield. Raises
        InputError for a missing key."""
        missing = {"scene_index", *TRACKS} - set(traffic)
        if missing:
            raise InputError(
                f"synthesized traffic lacks {', '.join(sorted(missing))}; return them from synthesize()"
            )
        states = traffic["states"]
        index = traffic["scene_index"].cpu()
        none = (
            torch.zeros(1, 1, 2).expand(len(states), states.shape[1] - 1, 2),
            torch.zeros(len(states), 2).long(),
        )
        given = dict(zip(EVASIONS, none, strict=True)) | dict(traffic)
        part = StoredTraffic(*(given[name].cpu() for name in StoredTraffic._fields))
        eta = torch.as_tensor(eta, dtype=torch.float32).cpu().expand(len(index))
        owes = given.get("owes", torch.ones(len(index))).cpu()
        pool = _rows(
            index,
            RECORDED,
            eta=eta,
            template=None if template is None else template.cpu(),
        )
        pool.decisions[:, OWES] = owes.to(pool.decisions)
        pool.source = torch.arange(len(index))
        pool.parts = [part]
        return pool

    def __add__(self, other: "TrafficPool") -> "TrafficPool":
        """Both pools' rows, this one's first."""
        count = sum(len(part.states) for part in self.parts)
        moved = torch.where(other.source >= 0, other.source + count, other.source)
        names = (
            "scene_index",
            "eta",
            "template",
            "seed",
            "decisions",
            "weight",
            "fresh",
        )
        joined = {
            name: torch.cat([getattr(self, name), getattr(other, name)])
            for name in names
        }
        return TrafficPool(
            source=torch.cat([self.source, moved]),
            parts=self.parts + other.parts,
            **joined,
        )

    def probabilities(self, priority: Tensor, fraction: float) -> Tensor:
        """Draw probability [R]: `fraction` for all adversarial rows (1 or 0 where there
        is one kind), within a kind in proportion to the row's weight times the priority
        [S] of its scene."""
        weight = self.weight * priority.cpu().double()[self.scene_index].clamp(
            min=1e-12
        )
        result = torch.zeros(len(self), dtype=torch.float64)
        for kind, part in ((True, fraction), (False, 1 - fraction)):
            rows = self.adversarial == kind
            if rows.any():
                result[rows] = (
                    (1.0 if rows.all() else part) * weight[rows] / weight[rows].sum()
                )
        return result


def _rows(
    scene_index: Tensor,
    source: int,
    eta: Tensor,
    seed: Tensor | None = None,
    template: Tensor | None = None,
    decisions: Tensor | None = None,
) -> TrafficPool:
    """Fresh rows of weight 1 from one source; by default of seed 0 and template full,
    by rule."""
    like = torch.zeros(len(scene_index), dtype=torch.int64)
    seed = like if seed is None else seed
    template = like + FULL if template is None else template
    decisions = (
        torch.tensor(RULE).repeat(len(like), 1) if decisions is None else decisions
    )
    fresh = torch.ones_like(like).bool()
    weight = torch.ones(len(like))
    return TrafficPool(
        scene_index,
        like + source,
        eta=eta,
        template=template,
        seed=seed,
        decisions=decisions,
        weight=weight,
        fresh=fresh,
    )
