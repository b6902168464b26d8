"""What all baseline traffic shares: the synthesizer's interface (begin, replan) without a prior, noise or control."""

from abc import ABC, abstractmethod
from dataclasses import replace

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.ego.base import Ego
from e2rl.prior.lane_relative import HORIZON, locate
from e2rl.prior.prior import Plan
from e2rl.prior.routed import route_scene
from e2rl.sim.world import World
from e2rl.synthesizer.episode import Episode

ARRIVAL = 20.0  # m, arc length near which a route passes its vehicle's start


class Baseline(ABC):
    """Deterministic background traffic: one rollout of a scene stands for all seeds."""

    deterministic = True
    predicts = True  # False: it looks the future up, so there is no open-loop error to report

    def routes(self, scene: TensorDictBase) -> Tensor:
        """Route candidates [B, V] that the vehicles are said to follow: the recorded ones, else the first."""
        return scene["route_log"].clamp(min=0)

    @torch.no_grad()
    def begin(self, scene: TensorDictBase, seed: Tensor, eta: Tensor) -> Episode:
        """Episodes of scenes [B]; seed and eta are kept and change nothing."""
        routed = route_scene(scene, self.routes(scene))
        vehicles = routed.route.shape[1]
        state = locate(
            scene["start"][:, :vehicles],
            scene["start_accel"][:, :vehicles],
            scene["start_yaw_rate"][:, :vehicles],
            routed.points,
            torch.full_like(routed.length, ARRIVAL),
        )
        return Episode.start(seed, eta, routed, state)

    @torch.no_grad()
    def replan(self, episode: Episode, world: World, ego_plan: Tensor, ego: Ego | None = None) -> tuple[Episode, Plan]:
        """The episodes and the plan of the coming HORIZON steps; neither the ego nor its plan is asked."""
        return replace(episode, replans=episode.replans + 1), self.plan(episode, world)

    @abstractmethod
    def plan(self, episode: Episode, world: World) -> Plan:
        """Motion (fields [B, V, HORIZON]) and presence of the coming steps."""


def steps_ahead(world: World) -> Tensor:
    """The coming simulated steps [B, HORIZON] int64."""
    return world.step[:, None] + torch.arange(1, HORIZON + 1, device=world.step.device)
