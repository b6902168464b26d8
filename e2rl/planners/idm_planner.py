"""Intelligent driver model on the mission route (Treiber et al. 2000, eqs. 3 and 4)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.planners.ego import PLAN_STEPS, Ego
from e2rl.planners.path import MissionPath, look_up
from e2rl.run.config import configured, setting
from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import MAX_SPEED, bounded_speed
from e2rl.sim.leaders import IDMParameters, idm_acceleration, leaders
from e2rl.sim.world import World

REACTION = 0.5  # s ahead at which the speed caps are kept


@configured("ego/idm")
@dataclass(eq=False)
class IDMEgo(Ego):
    """Stays on its mission and follows the nearest of `leaders` or red lights ahead;
    never changes lanes."""

    desired_speed: float = setting(low=0.1)
    headway: float = setting(low=0)
    standstill_gap: float = setting(low=0)
    acceleration: float = setting(low=0.01)
    braking: float = setting(low=0.01)
    hardest_braking: float = setting(low=0)
    use_limits: bool = setting()
    replan_every: int = setting(low=1, high=PLAN_STEPS)

    def plan(self, world: World) -> Tensor:
        """The current IDM acceleration held for the whole plan, within the path's speed
        caps."""
        path = MissionPath(world)
        speed = world.states[:, 0, 3]
        leader = leaders(
            path.s[:, None],
            path.route[:, None],
            agents=world.states[:, :, None],
            size=world.scene["size"],
            present=world.valid,
            free_gap=torch.inf,
        )
        gap = leader.gap[:, 0, 0]
        leading = leader.speed[:, 0, 0].clamp(min=0)
        light = path.stop_distance(self.braking) + self.standstill_gap
        leading = torch.where(light < gap, 0.0, leading)
        desired = path.desired_speed(
            self.desired_speed,
            path.s,
            limits=self.use_limits,
        )
        accel = idm_acceleration(
            speed,
            desired,
            gap=torch.minimum(gap, light),
            leader_speed=leading,
            driver=IDMParameters(
                self.headway,
                self.standstill_gap,
                acceleration=self.acceleration,
                braking=self.braking,
            ),
            improved=True,
        )
        caps = path.speed_caps(
            self.desired_speed,
            braking=self.braking,
            limits=self.use_limits,
            lights=False,
        )
        allowed = look_up(caps, (REACTION * speed)[:, None])[:, 0]
        accel = torch.minimum(accel, (allowed - speed) / REACTION)
        accel = accel.clamp(-self.hardest_braking, self.acceleration)
        change = (accel * DT)[:, None].expand(-1, PLAN_STEPS)
        future = bounded_speed(
            speed[:, None],
            change,
            low=0.0,
            high=MAX_SPEED,
        )
        future = torch.minimum(future, torch.maximum(desired, speed)[:, None])
        return path.drive(torch.cat([speed[:, None], future], 1))
