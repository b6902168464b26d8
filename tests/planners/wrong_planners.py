"""Planners with a mistake each, and what they are without it."""

import time

import torch

from e2rl.planners.ego import Ego
from e2rl.planners.path import MissionPath
from e2rl.scenes.boxes import to_frame


class Steady(Ego):
    """Keeps its speed along its mission."""

    def __init__(self, replan_every=5):
        super().__init__(replan_every)
        self.count = 0
        self.worlds = []

    def plan(self, world):
        speed = world.states[:, 0, 3:] * self.factor(world)
        return MissionPath(world).drive(speed.expand(-1, 51))

    def factor(self, world):
        return 1.0


class Short(Steady):
    def plan(self, world):
        return super().plan(world)[:, :40]


class NotANumber(Steady):
    def plan(self, world):
        plan = super().plan(world)
        if int(world.step[0]) >= 5:
            plan[:, 7] = torch.nan
        return plan


class OfTheEgo(Steady):
    def plan(self, world):
        plan = super().plan(world)
        state = world.states[:, :1]
        points = to_frame(plan[..., :2], state)
        return torch.cat([points, plan[..., 2:3] - state[..., 2:3], plan[..., 3:]], -1)


class OfTheWorld(Steady):
    def plan(self, world):
        return super().plan(world) + torch.tensor([3e5, 4e6, 0, 0])


class Degrees(Steady):
    def plan(self, world):
        plan = super().plan(world)
        return torch.cat([plan[..., :2], plan[..., 2:3].rad2deg(), plan[..., 3:]], -1)


class Mirrored(Steady):
    def plan(self, world):
        return super().plan(world) * torch.tensor([1.0, -1.0, -1.0, 1.0])


class Random(Steady):
    def factor(self, world):
        return 1 + 0.05 * torch.randn(len(world.step), 1)


class Remembers(Steady):
    def factor(self, world):
        self.count += 1
        return 0.98**self.count


class Mutates(Steady):
    def plan(self, world):
        plan = super().plan(world)
        world.scene["size"] += 0.5
        world.states[:, 1:, 3] *= 1.1
        return plan


class Leaks(Steady):
    def plan(self, world):
        self.worlds.append(torch.ones(500_000))
        return super().plan(world)


class Slow(Steady):
    def __init__(self):
        super().__init__(replan_every=1)

    def plan(self, world):
        time.sleep(0.31)
        return super().plan(world)


class Raises(Steady):
    def plan(self, world):
        if int(world.step[0]) == 15:
            raise ZeroDivisionError("no lane ahead")
        return super().plan(world)


class Hangs(Steady):
    def plan(self, world):
        while int(world.step[0]) == 15:
            try:
                time.sleep(3600)
            except Exception:
                continue
        return super().plan(world)


class Mixes(Steady):
    def factor(self, world):
        speed = world.states[:, 0, 3]
        return (speed.mean() / speed.max()).expand(len(speed), 1)


class Stands(Steady):
    def plan(self, world):
        standing = world.states[:, :1] * torch.tensor([1.0, 1.0, 1.0, 0.0])
        return standing.expand(-1, 50, -1)


class DegreesPerSecond(Ego):
    def act(self, world, observation, plan):
        return torch.tensor([0.0, 20.0]).expand(len(plan), 2)
