"""What a synthesizer keeps of running scenes, rows of nested states, and noise that depends on a scene alone."""

from dataclasses import dataclass, fields, is_dataclass

import torch
from torch import Tensor

from e2rl.prior.lane_relative import LaneState
from e2rl.prior.routed import RoutedScene


@dataclass
class Episode:
    """What a synthesizer keeps of B running scenes; every tensor has the batch first.

    seed [B]: of the scene's noise; eta [B]; replans [B]; routed; state [B, V]: where the last executed plan led;
    coalition, target [B, V]: C* and whom each acts on; adversaries [B, V]: in C* at any time; leaves [B, V]: on an
    interception instead of its lane; kl, jump [B, V]: path KL of the control so far and energy of anchoring.
    """

    seed: Tensor
    eta: Tensor
    replans: Tensor
    routed: RoutedScene
    state: LaneState
    coalition: Tensor
    target: Tensor
    adversaries: Tensor
    leaves: Tensor
    kl: Tensor
    jump: Tensor

    @classmethod
    def start(cls, seed: Tensor, eta: Tensor, routed: RoutedScene, state: LaneState) -> "Episode":
        """Episodes whose first replan is due: nobody is controlled yet."""
        none, zero = torch.zeros_like(routed.parked), torch.zeros_like(routed.length)
        return cls(seed, eta, torch.zeros_like(seed), routed, state, none, none.long() - 1, none, none, zero, zero)


def take_rows(value, rows: Tensor):
    """Rows of every tensor in a nested dataclass; None stays None."""
    if value is None:
        return None
    if is_dataclass(value):
        return type(value)(*(take_rows(getattr(value, f.name), rows) for f in fields(value)))
    return value[rows]


def put_rows(value, rows: Tensor, new):
    """`value` with `rows` of every tensor replaced by those of `new` (nested dataclasses, out of place)."""
    if is_dataclass(value):
        return type(value)(*(put_rows(getattr(value, f.name), rows, getattr(new, f.name)) for f in fields(value)))
    out = value.clone()
    out[rows] = new
    return out


def noise_of(seed: Tensor, draw: Tensor, shape: tuple[int, ...], uniform: bool = False) -> Tensor:
    """Random numbers [B, *shape] that depend on each scene's seed [B] and number of the draw [B] only, not on the
    batch."""
    rows = []
    for value, number in torch.stack([seed, draw], -1).tolist():
        generator = torch.Generator().manual_seed((value * 1_000_003 + number) % (2**63))
        rows.append((torch.rand if uniform else torch.randn)(shape, generator=generator))
    return torch.stack(rows).to(seed.device)
