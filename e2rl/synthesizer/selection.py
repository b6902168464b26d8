"""What a choice of coalitions rested on: handed to whoever listens to a synthesizer (`Synthesizer.on_selection`)."""

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Selection:
    """B scenes whose coalitions have just been chosen, in the batch's order of the moment.

    seed [B]: of the scene's noise, which names the rollout; step [B]: of the choice; reference [B, T', V, 4]: states of
    the reference rollout at the steps looked at, moments [B, T'] s after the choice; weights [B, T', V, V]: pair risks
    there, eq. (ttc_weight_t); candidates, feasible [B, V] bool: S_top and F; coalition, target [B, V]: C* and whom each
    of it acts on (0 the ego, -1: in no coalition).
    """

    seed: Tensor
    step: Tensor
    reference: Tensor
    moments: Tensor
    weights: Tensor
    candidates: Tensor
    feasible: Tensor
    coalition: Tensor
    target: Tensor
