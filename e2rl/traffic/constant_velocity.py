"""Constant velocity: everybody goes straight on from the causal start state, wherever that leads."""

import torch
from torch import Tensor

from e2rl.prior.lane_relative import LaneState
from e2rl.prior.prior import Plan
from e2rl.scene.recording import DT
from e2rl.sim.world import World
from e2rl.synthesizer.episode import Episode
from e2rl.traffic.traffic import Baseline, steps_ahead


class ConstantVelocity(Baseline):
    """Straight along the start heading at the start speed; parked vehicles stay parked, nobody ever leaves."""

    def plan(self, episode: Episode, world: World) -> Plan:
        """States at the coming steps, from the start frame on."""
        parked = episode.routed.parked
        start = world.scene["start"][:, : parked.shape[1]]
        start = torch.cat([start[..., :3], start[..., 3:].masked_fill(parked[..., None], 0.0)], -1)
        states = straight_on(start, steps_ahead(world))
        there = world.valid[:, : parked.shape[1], None].expand(states.shape[:-1])
        return Plan(LaneState.from_states(states), there)


def straight_on(start: Tensor, step: Tensor) -> Tensor:
    """States [B, V, H, 4] of vehicles start [B, V, 4] at steps [B or 1, H] after the start frame."""
    way = start[..., 3, None] * DT * step[:, None]
    direction = torch.stack([start[..., 2].cos(), start[..., 2].sin()], -1)[..., None, :]
    xy = start[..., None, :2] + way[..., None] * direction
    return torch.cat([xy, start[..., None, 2:].expand(*xy.shape[:-1], 2)], -1)
