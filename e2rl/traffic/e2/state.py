"""What the attack remembers of its scenes between two replans."""

from dataclasses import dataclass

from torch import Tensor

from e2rl.traffic.decisions import Decisions
from e2rl.traffic.grouping import no_vehicles
from e2rl.traffic.nominal import PriorState


@dataclass
class E2State(PriorState):
    """B attacked scenes.

    eta [B]: intensity; decided [B, D]: the decisions; coalition [B, V]: C*; target
    [B, V] int64: whom each member acts on (0 the ego, -1 none); off_lane [B, V]: on an
    interception instead of its lane; committed [B, V]: with a proposal, knots
    [B, V, KNOTS]: its accelerations [m/s^2]; drawn [B, V]: by a kernel; since [B, V] s:
    see `foresee`; settled [B, V]: once drawn to what the competent driver prevents;
    path_kl, anchor_jump [B, V] nats: path KL of the control, and energy of eq. 14's
    shift, since the start.
    """

    eta: Tensor = no_vehicles()
    decided: Tensor = no_vehicles()
    coalition: Tensor
    target: Tensor
    off_lane: Tensor
    committed: Tensor
    knots: Tensor
    drawn: Tensor
    since: Tensor
    settled: Tensor
    path_kl: Tensor
    anchor_jump: Tensor

    @property
    def decisions(self) -> Decisions:
        """The decisions, [B] each."""
        return Decisions(*self.decided.unbind(-1))

    @property
    def attacked(self) -> Tensor:
        """Bool [B]: scenes with an intensity above 0."""
        return self.eta > 0

    def nats_left(self, budget: float | None) -> Tensor | None:
        """Nats [B] that control may still add under a budget a rollout; None: any."""
        if budget is None:
            return None
        return (budget - self.path_kl.sum(-1)).clamp(min=0)
