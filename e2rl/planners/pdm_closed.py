"""PDM-Closed (Dauner et al., "Parting with Misconceptions about Learning-based Vehicle Motion Planning", CoRL 2023).

Fifteen proposals follow the mission: IDM at five fractions of the speed limit, on three lateral offsets. Each is driven
by the simulator's own vehicle, and scored by nuPlan's closed-loop terms against others that keep their velocity. The
best is driven; where even that is going to collide within two seconds, a slow ego brakes as hard as it can.

Where the paper is silent, the numbers are those of its published code: IDM's exponent and its bounds, and the speed
above which there is no emergency brake.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.planners.candidates import drive
from e2rl.planners.ego import PLAN_STEPS, Ego
from e2rl.planners.path import MissionPath
from e2rl.planners.sampling import take
from e2rl.planners.scoring import nearest
from e2rl.run.settings import configured, setting
from e2rl.scenes.boxes import corners, overlap, to_frame
from e2rl.scenes.drivable_area import off_road
from e2rl.scenes.recording import DT
from e2rl.scenes.route import project
from e2rl.sim import dynamics
from e2rl.sim.dynamics import constant_velocity, wrap
from e2rl.sim.leaders import IDMParameters, idm_acceleration
from e2rl.sim.mission import limit_at
from e2rl.sim.world import World

FRACTIONS = (0.2, 0.4, 0.6, 0.8, 1.0)  # of the speed limit; of proposals that score alike the first is driven
OFFSETS = (0.0, 1.0, -1.0)  # m beside the mission
HORIZON = 40  # steps that are scored: 4 s
LOOKS = (0.0, 0.3, 0.6, 0.9)  # s ahead of each step at constant velocity; after the first is the time to collision
STOPPED = 0.1  # m/s: an ego that stands is not at fault
TOLERANCE = 0.3  # m that a corner may leave the drivable area by, or more than now
PROGRESS, TIME_TO_COLLISION, COMFORT = 5.0, 5.0, 2.0  # weights
LEAST_PROGRESS = 0.1  # m: where no proposal drives farther, all have all progress
ACCELERATIONS = (-4.05, 2.40)  # m/s^2, comfortable along the way; the others are bounds of the absolute value
LATERAL, JERK, YAW_RATE, YAW_ACCELERATION = 4.89, 8.37, 0.95, 1.93  # m/s^2, m/s^3, rad/s, rad/s^2
SOON = 2.0  # s before a collision of the best proposal from which on the ego brakes
EXPONENT = 10.0  # of IDM's free-road term
CHUNK = 32  # scenes planned for at a time: fits the processor's cache


class Others(NamedTuple):
    """M agents at constant velocity: states [B, M, T, 4] at T steps, size [B, M, 2], seen [B, M] bool."""

    states: Tensor
    size: Tensor
    seen: Tensor


@configured("ego/pdm_closed")
@dataclass(eq=False)
class PDMClosedEgo(Ego):
    """The best of fifteen IDM proposals by nuPlan's terms. Settings: conf/ego/pdm_closed.yaml."""

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
        rows = torch.arange(len(world.step), device=world.step.device)
        return torch.cat([self._plan(take(world, part)) for part in rows.split(CHUNK)])

    def _plan(self, world: World) -> Tensor:
        proposals = self.proposals(world)
        scores, collides = score(world, proposals, self._others(world, range(1, HORIZON + 1)))
        best = scores.argmax(1)
        row = torch.arange(len(best), device=best.device)
        brake = torch.tensor([-self.emergency_braking, 0.0], device=best.device).expand(len(best), PLAN_STEPS, 2)
        stop = dynamics.rollout(world.states[:, 0], brake)
        emergency = (collides[row, best] <= SOON) & (world.states[:, 0, 3] <= self.emergency_speed)
        return torch.where(emergency[:, None, None], stop, proposals[row, best])

    def proposals(self, world: World) -> Tensor:
        """States [B, P, PLAN_STEPS, 4] of the proposals: of each offset, all fractions."""
        path, start = MissionPath(world), world.states[:, 0]
        offset = start.new_tensor(OFFSETS).repeat_interleave(len(FRACTIONS))
        speed = self.speeds(world, path, offset, start.new_tensor(FRACTIONS).repeat(len(OFFSETS)))
        shift = offset[:, None].expand(len(start), -1, 1)
        return drive(start, path, speed, shift, torch.full_like(shift, self.shift_time)).states

    def speeds(self, world: World, path: MissionPath, offset: Tensor, fraction: Tensor) -> Tensor:
        """Speeds [B, P, PLAN_STEPS + 1] m/s by IDM behind leaders on the offsets [P] m, and before red lights, at
        fractions [P] of the speed limit."""
        driver = IDMParameters(self.headway, self.standstill_gap, self.acceleration, self.braking, EXPONENT)
        others, half = self._others(world, range(PLAN_STEPS)), world.scene["size"][:, 0] / 2
        onto = project(others.states[..., :2].flatten(1, 2), path.route)
        s, d, heading = (x.unflatten(1, others.states.shape[1:3]) for x in onto)
        turn = others.states[..., 2] - heading
        along, side = (_extent(others.size, turn, axis) for axis in (0, 1))
        leads = (d[:, None] - offset[:, None, None]).abs() < (side + half[:, 1, None, None])[:, None]
        leads &= others.seen[:, None, :, None]  # [B, P, M, T]
        rear, leading = (s - along)[:, None], (others.states[..., 3] * turn.cos())[:, None].clamp(min=0)
        light = (path.s + path.stop_distance(self.braking) + self.standstill_gap)[:, None]
        way = path.s[:, None].expand(-1, len(offset))
        now = world.states[:, :1, 3].expand_as(way)
        found = [now]
        for t in range(PLAN_STEPS):
            limit = limit_at(path.mission, way)
            wanted = fraction * torch.where(limit > 0, limit, self.desired_speed)
            front = way + half[:, :1]
            ahead = leads[..., t] & (s[:, None, :, t] > way[..., None])
            gap, nearest = (rear[..., t] - front[..., None]).masked_fill(~ahead, torch.inf).min(-1)
            pace = leading[..., t].expand(ahead.shape).gather(-1, nearest[..., None])[..., 0]
            pace, gap = torch.where(light - way < gap, 0.0, pace), torch.minimum(gap, (light - way).clamp(min=0.01))
            asked = idm_acceleration(now, wanted, gap, pace, driver, improved=False)
            after = (now + DT * asked.clamp(-self.braking, self.acceleration)).clamp(0, dynamics.MAX_SPEED)
            way, now = way + (now + after) / 2 * DT, after
            found.append(now)
        return torch.stack(found, -1)

    def _others(self, world: World, steps: range) -> Others:
        """The agents that come nearest, at these steps."""
        agents, seen = nearest(world, self.agents)
        row = torch.arange(len(agents), device=agents.device)[:, None]
        times = DT * torch.tensor(steps, device=agents.device)
        return Others(constant_velocity(world.states[row, agents], times), world.scene["size"][row, agents], seen)


def _extent(size: Tensor, turn: Tensor, axis: int) -> Tensor:
    """Half of what boxes [B, M, 2] turned by turn [B, M, T] rad take along (axis 0) or across (1) a direction."""
    own, other = size[..., axis, None] / 2, size[..., 1 - axis, None] / 2
    return own * turn.cos().abs() + other * turn.sin().abs()


def score(world: World, proposals: Tensor, others: Others) -> tuple[Tensor, Tensor]:
    """nuPlan's closed-loop score, in [0, 1], of proposals [B, P, PLAN_STEPS, 4] over the HORIZON, others at its steps
    1..., and the time [s] of their first collision at fault, inf: none; each [B, P].

    Collision and drivable area multiply the weighted mean of progress, relative to the proposal that gets farthest of
    those that neither excludes, time to collision and comfort. Proposals follow the mission, and so never drive against
    its direction, which nuPlan scores too.
    """
    size, scored = world.scene["size"][:, 0], proposals[:, :, :HORIZON]
    looks = scored.new_tensor(LOOKS)
    later, ahead = (constant_velocity(states, looks).flatten(-3, -2) for states in (scored, others.states))
    fault = at_fault(later, size, others._replace(states=ahead)).unflatten(-1, (HORIZON, len(LOOKS)))
    hit, clear = fault[..., 0], ~fault[..., 1:].any((-2, -1))
    times = DT * torch.arange(1, HORIZON + 1, device=hit.device)
    collides = torch.where(hit, times, torch.inf).amin(-1)
    allowed = ~hit.any(-1) & on_road(scored, size, world)
    driven, smooth = progress(world, scored, allowed), comfortable(world, scored)
    weighted = PROGRESS * driven + TIME_TO_COLLISION * clear + COMFORT * smooth
    return allowed * weighted / (PROGRESS + TIME_TO_COLLISION + COMFORT), collides


def progress(world: World, scored: Tensor, allowed: Tensor) -> Tensor:
    """Metres along the mission of scored [B, P, T, 4], as a fraction [B, P] of the farthest of those allowed [B, P]."""
    path = MissionPath(world)
    driven = torch.cat([world.states[:, None, :1, :2].expand_as(scored[:, :, :1, :2]), scored[..., :2]], 2)
    length = driven.diff(dim=2).norm(dim=-1).sum(-1)
    s = project(scored[:, :, -1, :2], path.route, path.s[:, None] + length)[0]
    distance = (s - path.s[:, None]).clamp(min=0)
    farthest = (distance * allowed).amax(1, keepdim=True)
    relative = (distance / farthest.clamp(min=LEAST_PROGRESS)).clamp(max=1)
    return torch.where(farthest > LEAST_PROGRESS, relative, 1.0)


def at_fault(states: Tensor, size: Tensor, others: Others) -> Tensor:
    """Bool [B, P, T]: an ego that moves, states [B, P, T, 4] of size [B, 2], touches an agent that is not behind it."""
    own, box = states[:, :, None], size[:, None, None, None]
    touch = overlap(own, box, others.states[:, None], others.size[:, None, :, None])
    place = to_frame(others.states[:, None, ..., :2], own)[..., 0]
    fault = touch & (place > -box[..., 0] / 2) & (own[..., 3] > STOPPED)
    return (fault & others.seen[:, None, :, None]).any(2)


def on_road(states: Tensor, size: Tensor, world: World) -> Tensor:
    """Bool [B, P]: no corner leaves the drivable area by more than TOLERANCE, or by more than now."""
    field, origin = world.scene["field"], world.scene["field_origin"]
    box = size[:, None, None]
    beyond = off_road(corners(states, box).flatten(1, 3), field, origin).view(*states.shape[:3], 4)
    now = off_road(corners(world.states[:, 0], size), field, origin).amax(-1).clamp(min=0)
    return beyond.amax((-2, -1)) <= now[:, None] + TOLERANCE


def comfortable(world: World, scored: Tensor) -> Tensor:
    """Bool [B, P]: scored [B, P, T, 4] keep nuPlan's bounds of comfort."""
    now = world.states[:, None, None, 0].expand_as(scored[:, :, :1])
    speed, heading = torch.cat([now, scored], 2)[..., 2:].flip(-1).unbind(-1)
    accel, rate = speed.diff(dim=-1) / DT, wrap(heading.diff(dim=-1)) / DT
    accel, rate = (value.unfold(-1, 5, 1).mean(-1) for value in (accel, rate))  # as nuPlan smooths what it scores
    lateral = rate * speed[..., 3:-2]
    fine = (accel >= ACCELERATIONS[0]) & (accel <= ACCELERATIONS[1]) & (lateral.abs() <= LATERAL)
    fine = fine.all(-1) & (rate.abs() <= YAW_RATE).all(-1)
    changes = (accel.diff(dim=-1).abs() <= JERK * DT) & (rate.diff(dim=-1).abs() <= YAW_ACCELERATION * DT)
    return fine & changes.all(-1)
