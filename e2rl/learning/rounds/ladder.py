"""A frontier that is held: where an attack hits the policy too seldom to teach it, a
harder one takes over as many scenes of a round as it takes."""

import torch
from torch import Tensor

DECAY = 0.5  # of a count, a round later


class Ladder:
    """The mix of two attacks, 0 and 1, of which a fraction `hits` is to hit.

    With hit rates p_0 < hits < p_1 it is the share (hits - p_0) / (p_1 - p_0) of the
    second. The rates are those of past attacks, the last round's most of all. An attack
    that has not been made is taken to hit, so that it is tried.
    """

    def __init__(self, hits: float, seed: int = 0) -> None:
        self._hits = hits
        self._counts = torch.zeros(2, 2, dtype=torch.float64)  # attempts and hits
        self._generator = torch.Generator().manual_seed(seed)

    def share(self) -> float:
        """The fraction of a round's scenes in which the harder attack is made."""
        attempts, hits = self._counts.unbind(-1)
        own, harder = ((hits + 1) / (attempts + 1)).tolist()
        missing = self._hits - own
        return missing / max(harder - own, missing) if missing > 0 else 0.0

    def draw(self, count: int) -> Tensor:
        """Attacks [count] int64 of a round's scenes, in random order."""
        attack = (torch.arange(count) < round(self.share() * count)).long()
        return attack[torch.randperm(count, generator=self._generator)]

    def observe(self, attack: Tensor, hit: Tensor) -> None:
        """Count attacks [A] int64 that were made, and whether they hit [A] bool."""
        outcome = torch.stack([torch.ones(len(hit)), hit.float()], -1).double()
        self._counts = DECAY * self._counts
        self._counts.index_add_(0, attack, outcome)

    def state_dict(self) -> dict:
        """All state."""
        return {"counts": self._counts, "generator": self._generator.get_state()}

    def load_state_dict(self, state: dict) -> None:
        """Restore a `state_dict`."""
        self._counts = state["counts"].clone()
        self._generator.set_state(state["generator"].cpu())
