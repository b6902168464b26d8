"""Speed profiles of planners: nodes PLAN_DT apart, under the caps of a path."""

import torch
from torch import Tensor

from e2rl.planners.ego import PLAN_STEPS
from e2rl.planners.path import look_up
from e2rl.run.fused import fused
from e2rl.scenes.recording import DT

PLAN_DT = 0.2  # s between nodes of a profile
NODES = 25  # nodes after the first, which is now: 5 s


def targets(
    start: Tensor,
    top: Tensor,
    *,
    reach: float,
    count: int,
) -> Tensor:
    """Returns target speeds [..., count], evenly from max(0, start - reach) to min(top,
    start + reach).

    Args:
        start: [...] m/s.
        top: [...] m/s.
        reach: m/s.
        count: of targets.
    """
    low = (start - reach).clamp(min=0)
    high = torch.minimum(top, start + reach)
    fraction = torch.linspace(0, 1, count, device=start.device, dtype=start.dtype)
    return low[..., None] + fraction * (high - low)[..., None]


def approach(
    start: Tensor,
    target: Tensor,
    *,
    slope: float,
    steps: int,
) -> Tensor:
    """Returns speeds [..., steps] moving from start [...] to target [...] by at most
    `slope` a step, then holding.

    Args:
        start: [...] m/s.
        target: [...] m/s.
        slope: m/s, of a step.
        steps: number of speeds.
    """
    reach = slope * torch.arange(1, steps + 1, device=start.device, dtype=start.dtype)
    change = (target - start)[..., None]
    return start[..., None] + change.sign() * torch.minimum(change.abs(), reach)


def capped(
    wanted: Tensor,
    caps: Tensor,
    slope: float,
) -> Tensor:
    """Speeds [B, C, NODES + 1] that follow wanted [B, C, NODES + 1] under the squared
    caps [B, K] of the path, braking by at most `slope` a node."""
    nodes = wanted.movedim(-1, 0)
    return follow_capped(nodes, caps, caps.new_tensor(slope)).movedim(0, -1)


@fused(f"{NODES + 1} B C", "B K", "")
def follow_capped(wanted: Tensor, caps: Tensor, slope: Tensor) -> Tensor:
    """`capped`, of nodes [NODES + 1, B, C]. The caps depend on the distance driven so
    far, so this loops over the nodes, for all profiles at once."""
    speed = wanted[0]
    speeds = [speed]
    driven = torch.zeros_like(speed)
    for target in wanted[1:]:
        allowed = look_up(caps, driven + speed * PLAN_DT)
        slowed = torch.maximum(allowed, (speed - slope).clamp(min=0))
        following = torch.minimum(target, slowed)
        driven = driven + (speed + following) / 2 * PLAN_DT
        speed = following
        speeds.append(speed)
    return torch.stack(speeds)


def upsample(speed: Tensor) -> Tensor:
    """Speeds [..., PLAN_STEPS + 1] every DT, linear between nodes [..., NODES + 1]."""
    tick = torch.arange(PLAN_STEPS + 1, device=speed.device) * (DT / PLAN_DT)
    low = tick.floor().long().clamp(max=speed.shape[-1] - 2)
    fraction = tick - low
    return speed[..., low] * (1 - fraction) + speed[..., low + 1] * fraction
