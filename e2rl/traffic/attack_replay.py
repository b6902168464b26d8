"""Attacks that drive as they did, whoever the ego is."""

from dataclasses import dataclass, replace

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.sim.world import World
from e2rl.traffic.rule_based import replayed
from e2rl.traffic.traffic import State, Traffic, TrafficPlan


@dataclass(frozen=True)
class AttackTracks:
    """What A attacks drove.

    Args:
        states: [A, T+1, N, 4], step 0 is the start.
        valid: [A, T+1, N] bool, who was there.
        adversaries: [A, N] bool, who was under adversarial control at any time.
        routes: [A, N] int64, route candidates followed, -1 none.
        nats: [A, 2], path KL of the control of adversaries, and of others.
    """

    states: Tensor
    valid: Tensor
    adversaries: Tensor
    routes: Tensor
    nats: Tensor


class AttackReplay(Traffic):
    """The traffic of attacks, open loop. The noise seed of a rollout is the number of
    its attack."""

    def __init__(self, tracks: AttackTracks) -> None:
        self.tracks = tracks

    def reset(self, scenes: TensorDictBase, seed: Tensor, eta: Tensor) -> Tensor:
        """Returns the numbers of the attacks [B]."""
        return seed

    def replan(
        self,
        state: State,
        world: World,
        ego_plan: Tensor,
    ) -> tuple[State, TrafficPlan]:
        """The coming steps of the attacks, with their adversaries, routes and nats."""
        tracks = self.tracks
        vehicles = world.scene["route_log"].shape[1]
        plan = replayed(tracks.states, tracks.valid, state, world=world)
        acts = tracks.adversaries[state, :vehicles]
        counts = torch.stack([acts.sum(1), (~acts).sum(1)], 1).clamp(min=1)
        shares = tracks.nats[state] / counts  # of each: the file has sums alone
        path_kl = torch.where(acts, shares[:, :1], shares[:, 1:])
        routes = tracks.routes[state, :vehicles]
        return state, replace(plan, adversary=acts, path_kl=path_kl, route=routes)
