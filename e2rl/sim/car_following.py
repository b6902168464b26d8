"""What all car-following here shares: the gap that the Intelligent Driver Model wants (Treiber et al. 2000)."""

from torch import Tensor


def desired_gap(
    speed: Tensor, leading: Tensor, headway: float, standstill_gap: float, acceleration: float, braking: float
) -> Tensor:
    """s* [...] m behind a leader driving `leading` m/s: s0 + max(0, v T + v (v - v_leader) / (2 sqrt(a b)))."""
    closing = speed * (speed - leading) / (2 * (acceleration * braking) ** 0.5)
    return standstill_gap + (speed * headway + closing).clamp(min=0)
