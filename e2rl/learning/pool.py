"""The traffic that episodes of a round are driven in: rows of synthesized (D') and nominal traffic, or recordings."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.errors import InputError
from e2rl.sim.env import DrivingEnv

RECORDED = -1  # traffic of a row that replays its recording


@dataclass
class TrafficPool:
    """R rows to drive in. scene_index [R] int64; adversarial [R] bool; traffic [R] int64: position in the stored
    traffic, RECORDED for the recording; states [D, T+1, N, 4], valid [D, T+1, N], route [D, V] of what is stored."""

    scene_index: Tensor
    adversarial: Tensor
    traffic: Tensor
    states: Tensor | None = None
    valid: Tensor | None = None
    route: Tensor | None = None

    def __len__(self) -> int:
        return len(self.scene_index)

    @staticmethod
    def recorded(scene_index: Tensor) -> "TrafficPool":
        """Rows that replay the recordings of scenes [R]."""
        return TrafficPool(
            scene_index, torch.zeros(len(scene_index), dtype=torch.bool), torch.full((len(scene_index),), RECORDED)
        )

    @staticmethod
    def synthesized(traffic: Mapping[str, Tensor], adversarial: bool) -> "TrafficPool":
        """Rows of a synthesizer's traffic: scene_index [S], states [S, T+1, N, 4], valid [S, T+1, N] and, if the
        vehicles did not keep to their recorded route candidates, route [S, V]."""
        missing = {"scene_index", "states", "valid"} - set(traffic)
        if missing:
            raise InputError(f"synthesized traffic lacks {', '.join(sorted(missing))}; return them from synthesize()")
        index = traffic["scene_index"].cpu()
        return TrafficPool(
            index,
            torch.full((len(index),), adversarial),
            torch.arange(len(index)),
            traffic["states"].cpu(),
            traffic["valid"].cpu(),
            _optional(traffic.get("route")),
        )

    def __add__(self, other: "TrafficPool") -> "TrafficPool":
        """Both pools' rows, this one's first."""
        stored = 0 if self.states is None else len(self.states)
        shifted = torch.where(other.traffic == RECORDED, other.traffic, other.traffic + stored)
        if (self.route is None) != (other.route is None) and self.states is not None and other.states is not None:
            raise InputError("traffic pools with and without routes cannot be one; give route in both or in neither")
        return TrafficPool(
            torch.cat([self.scene_index, other.scene_index]),
            torch.cat([self.adversarial, other.adversarial]),
            torch.cat([self.traffic, shifted]),
            _joined(self.states, other.states),
            _joined(self.valid, other.valid),
            _joined(self.route, other.route),
        )

    def inject(self, env: DrivingEnv, places: Tensor, rows: Tensor) -> None:
        """Schedule the traffic of pool rows [b] for the coming reset of environments places [b]."""
        stored = self.traffic[rows]
        given = stored != RECORDED
        if given.any():
            at = stored[given]
            route = None if self.route is None else self.route[at]
            env.set_traffic(places[given], self.states[at], self.valid[at], route)

    def probabilities(self, priority: Tensor, share: float) -> Tensor:
        """Draw probability [R] of each row: adversarial rows make up `share`, rows of a kind go by the priority [S] of
        their scene. A kind without rows leaves everything to the other."""
        weight = priority.cpu().double()[self.scene_index].clamp(min=1e-12)
        mass = {True: share, False: 1 - share}
        result = torch.zeros(len(self), dtype=torch.float64)
        for kind, part in mass.items():
            rows = self.adversarial == kind
            if rows.all():
                part = 1.0
            if rows.any():
                result[rows] = part * weight[rows] / weight[rows].sum()
        return result


def _optional(value: Tensor | None) -> Tensor | None:
    return None if value is None else value.cpu()


def _joined(first: Tensor | None, second: Tensor | None) -> Tensor | None:
    if first is None or second is None:
        return second if first is None else first
    return torch.cat([first, second])
