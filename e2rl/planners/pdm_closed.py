"""PDM-Closed (Dauner et al., "Parting with Misconceptions about Learning-based Vehicle
Motion Planning", CoRL 2023).

Fifteen proposals follow the mission: IDM at five fractions of the speed limit, on three
lateral offsets. Each is driven by the simulator's own vehicle, and scored by nuPlan's
closed-loop terms (pdm_score.py). The best is driven; where even that is going to
collide within two seconds, a slow ego brakes as hard as it can.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.planners.candidates import drive
from e2rl.planners.chunks import chunks
from e2rl.planners.ego import PLAN_STEPS, Ego
from e2rl.planners.path import MissionPath
from e2rl.planners.pdm_score import SCORED_STEPS, Others, score
from e2rl.planners.scoring import nearest
from e2rl.run.config import configured, setting
from e2rl.scenes.boxes import overlap
from e2rl.scenes.recording import DT, OTHER
from e2rl.scenes.route import project
from e2rl.sim import dynamics
from e2rl.sim.leaders import IDMParameters, idm_acceleration
from e2rl.sim.world import World

# Of the speed limit; of proposals that score alike the first is driven.
FRACTIONS = (0.2, 0.4, 0.6, 0.8, 1.0)
OFFSETS = (0.0, -1.0, 1.0)  # m beside the mission, left positive
SOON = 2.0  # s before a collision of the best proposal from which on the ego brakes
EXPONENT = 10.0  # of IDM's free-road term
CHUNK = 32  # scenes planned for at a time: fits the processor's cache


@configured("ego/pdm_closed")
@dataclass(eq=False)
class PDMClosedEgo(Ego):
    """The best of fifteen IDM proposals by nuPlan's terms. Settings:
    conf/ego/pdm_closed.yaml."""

    desired_speed: float = setting(low=0.1)
    headway: float = setting(low=0)
    standstill_gap: float = setting(low=0)
    acceleration: float = setting(low=0.01)
    braking: float = setting(low=0.01)
    emergency_braking: float = setting(low=0)
    emergency_speed: float = setting(low=0)
    shift_time: float = setting(low=0)
    agents: int = setting(low=1)
    replan_every: int = setting(low=1, high=PLAN_STEPS)

    def plan(self, world: World) -> Tensor:
        """The states [B, PLAN_STEPS, 4] of the best proposal, or of an emergency brake."""
        return torch.cat([self._plan(part) for part in chunks(world, CHUNK)])

    def _plan(self, world: World) -> Tensor:
        state = world.states[:, 0]
        proposals = self.proposals(world)
        others = others_of(world, self.agents, SCORED_STEPS + 1)
        scores, collides = score(world, proposals, others)
        best = scores.argmax(1)
        row = torch.arange(len(best), device=best.device)
        soon = collides[row, best] <= SOON
        emergency = soon & (state[:, 3] <= self.emergency_speed)
        brake = torch.tensor([-self.emergency_braking, 0.0], device=best.device)
        stop = dynamics.rollout(state, brake.expand(len(best), PLAN_STEPS, 2))
        return torch.where(emergency[:, None, None], stop, proposals[row, best])

    def proposals(self, world: World) -> Tensor:
        """States [B, P, PLAN_STEPS, 4] of the proposals: of each offset, all fractions."""
        path = MissionPath(world)
        start = world.states[:, 0]
        offset = start.new_tensor(OFFSETS).repeat_interleave(len(FRACTIONS))
        fraction = start.new_tensor(FRACTIONS).repeat(len(OFFSETS))
        shift = offset[:, None].expand(len(start), -1, 1)
        return drive(
            start,
            path,
            speed=self.speeds(
                world,
                path,
                offset=offset,
                fraction=fraction,
            ),
            shift=shift,
            time=torch.full_like(shift, self.shift_time),
        ).states

    def speeds(
        self,
        world: World,
        path: MissionPath,
        *,
        offset: Tensor,
        fraction: Tensor,
    ) -> Tensor:
        """Returns speeds [B, P, PLAN_STEPS + 1] m/s by IDM behind leaders and before
        red lights.

        Args:
            world: B scenes.
            path: of these.
            offset: [P] m beside the mission, where leaders are looked for.
            fraction: [P] of the speed limit where the ego is.
        """
        driver = IDMParameters(
            self.headway,
            self.standstill_gap,
            acceleration=self.acceleration,
            braking=self.braking,
            exponent=EXPONENT,
        )
        half = world.scene["size"][:, 0, :, None] / 2  # [B, 2, 1]
        others = others_of(world, self.agents, PLAN_STEPS)
        s, d, heading = (
            value.unflatten(1, others.states.shape[1:3])
            for value in project(others.states[..., :2].flatten(1, 2), path.route)
        )
        turn = others.states[..., 2] - heading
        side = _extent(others.size.flip(-1), turn) + half[:, 1, :, None]
        offsets = (d[:, None] - offset[:, None, None]).abs()
        in_path = (offsets < side[:, None]) & others.present[:, None, :, None]
        rear = (s - _extent(others.size, turn))[:, None]
        pace = (others.states[..., 3] * turn.cos())[:, None]  # [B, 1, M, T]
        limit = path.desired_speed(self.desired_speed, path.s)
        wanted = fraction * limit[:, None]
        stop = path.stop_distance(self.braking)
        light = (path.s + stop + self.standstill_gap)[:, None]
        place = path.s[:, None].expand(-1, len(offset))
        speed = world.states[:, :1, 3].expand_as(place)
        speeds = [speed]
        for t in range(PLAN_STEPS):
            front = place + half[:, 0]
            leads = in_path[..., t] & (s[:, None, :, t] > place[..., None])
            gaps = (rear[..., t] - front[..., None]).masked_fill(~leads, torch.inf)
            gap, leader = gaps.min(-1)
            leading = pace[..., t].expand(leads.shape).gather(-1, leader[..., None])
            before_light = light - place
            accel = idm_acceleration(
                speed,
                wanted,
                gap=torch.minimum(gap, before_light).clamp(min=self.standstill_gap),
                leader_speed=torch.where(before_light < gap, 0.0, leading[..., 0]),
                driver=driver,
                improved=False,
            ).clamp(-self.braking, self.acceleration)
            following = (speed + DT * accel).clamp(0, dynamics.MAX_SPEED)
            place = place + (speed + following) / 2 * DT
            speed = following
            speeds.append(speed)
        return torch.stack(speeds, -1)


def others_of(
    world: World,
    count: int,
    steps: int,
) -> Others:
    """The `count` agents that come nearest, at steps 0 up to `steps`."""
    agents, present = nearest(world, count)
    row = torch.arange(len(agents), device=agents.device)[:, None]
    size = world.scene["size"]
    objects = world.scene["agent_type"][row, agents] == OTHER
    states = world.states[row, agents]
    speed = states[..., 3:].masked_fill(objects[..., None], 0.0)
    states = torch.cat([states[..., :3], speed], -1)
    touches = overlap(
        world.states[:, :1],
        size[:, :1],
        second=states,
        second_size=size[row, agents],
    )
    times = DT * torch.arange(steps, device=agents.device)
    return Others(
        dynamics.constant_velocity(states, times),
        size[row, agents],
        present=present & ~touches,
        objects=objects,
    )


def _extent(size: Tensor, turn: Tensor) -> Tensor:
    """Half of what boxes [B, M, 2] turned by turn [B, M, T] rad take along a direction;
    of boxes flipped, across it."""
    along, across = (size[..., None, :] / 2).unbind(-1)
    return along * turn.cos().abs() + across * turn.sin().abs()
