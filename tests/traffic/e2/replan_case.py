"""One replan of equal scenes, ready to be sampled under control."""

import torch

from e2rl.prior.lane_relative import HORIZON, KNOTS, SIZE
from e2rl.prior.prior import Denoising
from e2rl.sim.world import World
from e2rl.traffic.potentials import PotentialContext
from tests.prior.small import small_prior
from tests.traffic.e2.traffic_scenes import ROWS, scenes

MEMBER = 1  # the coalition: the vehicle ahead of the ego
OTHERS = [row for row in range(ROWS) if row != MEMBER]
ACCEL = -2.0  # m/s^2 of its proposal


class Case:
    """`count` equal scenes: their context, coalition and noise."""

    def __init__(self, count: int = 4) -> None:
        self.prior = small_prior()
        self.scene = scenes(1).scenes[torch.zeros(count, dtype=torch.long)]
        route = self.scene["route_log"].clamp(min=0)
        routed, state = self.prior.start(self.scene, route)
        plan = self.scene["logged"][:, 1:2, 0].repeat(1, HORIZON, 1)
        plan[..., 0] += torch.arange(HORIZON)  # 10 m/s
        self.coalition = torch.zeros(count, ROWS, dtype=torch.bool)
        self.coalition[:, MEMBER] = True
        self.context = self.prior.encode(
            routed, state, World.at_start(self.scene), ego_plan=plan
        )
        self.conditions = PotentialContext(
            scene=self.scene,
            start=self.scene["start"][:, :ROWS],
            accel=state.a,
            valid=self.scene["valid"][:, :ROWS],
            route=routed.points,
            on_route=routed.has_lane,
            ego_plan=plan,
            target=torch.where(self.coalition, 0, -1),
        )
        self.knots = torch.full((count, ROWS, KNOTS), ACCEL)
        self.generator = torch.Generator().manual_seed(0)

    def noise(self, seed: int = 0) -> torch.Tensor:
        """Standard normal [count, ROWS, SIZE]."""
        generator = torch.Generator().manual_seed(seed)
        return torch.randn(len(self.scene), ROWS, SIZE, generator=generator)

    def denoising(self, x: torch.Tensor, level: torch.Tensor, k: int) -> Denoising:
        """A step of x at a noise level, with k steps left."""
        return Denoising(self.prior, x, level, k=k, context=self.context)

    def eta(self, value) -> torch.Tensor:
        """Intensities [count], of one number or of each."""
        return torch.full((len(self.scene),), 1.0) * torch.as_tensor(value)
