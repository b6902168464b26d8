"""PDM-Closed (Dauner et al., "Parting with Misconceptions about Learning-based Vehicle
Motion Planning", CoRL 2023).

Fifteen proposals follow the mission: IDM at five fractions of the speed limit, on three
lateral offsets. Each is driven by the simulator's own vehicle, and scored by nuPlan's
closed-loop terms against others that keep their velocity. The best is driven; where
even that is going to collide within two seconds, a slow ego brakes as hard as it can.

Where the paper is silent, numbers and rules are those of its published code;
docs/planners.md lists what differs.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from scipy.signal import savgol_filter
from torch import Tensor

from e2rl.planners.candidates import drive
from e2rl.planners.ego import PLAN_STEPS, Ego
from e2rl.planners.path import MissionPath
from e2rl.planners.sampling import SCENE_KEYS, take
from e2rl.planners.scoring import nearest
from e2rl.run.settings import configured, setting
from e2rl.scenes.boxes import corners, overlap, to_frame
from e2rl.scenes.drivable_area import off_road
from e2rl.scenes.recording import DT, OTHER
from e2rl.scenes.route import project
from e2rl.sim import dynamics
from e2rl.sim.dynamics import constant_velocity, wrap
from e2rl.sim.leaders import IDMParameters, idm_acceleration
from e2rl.sim.mission import limit_at
from e2rl.sim.world import World

FRACTIONS = (
    0.2,
    0.4,
    0.6,
    0.8,
    1.0,
)  # of the speed limit; of proposals that score alike the first is driven
OFFSETS = (0.0, -1.0, 1.0)  # m beside the mission, left positive
SCORED_STEPS = 40  # steps that are scored: 4 s
LOOKS = (
    0.0,
    0.3,
    0.6,
    0.9,
)  # s ahead of each state at constant velocity: the time to collision
STANDS, NO_LOOK = (
    0.05,
    0.005,
)  # m/s: up to which one stands at a collision; below which the ego has no time to one
REAR_AXLE = (
    1.461 / 5.176
)  # of the length: nuPlan's vehicle, from its centre back to the rear axle
AHEAD, BEHIND = (
    math.radians(30),
    math.radians(150),
)  # angle at the rear axle between the heading and another's centre
LANE_WIDTH = 3.5  # m: an ego that reaches beyond counts as in several lanes
OBJECT_HIT = 0.5  # what hitting an object at fault leaves of a score
PROGRESS, TIME_TO_COLLISION, COMFORT = 5.0, 5.0, 2.0  # weights
LEAST_PROGRESS = 0.1  # m: where no proposal drives farther, all have all progress
ACCELERATIONS = (
    -4.05,
    2.40,
)  # m/s^2, comfortable along the way; the others are bounds of the absolute value
LONGITUDINAL_JERK, JERK, YAW_RATE, YAW_ACCELERATION = (
    4.13,
    8.37,
    0.95,
    1.93,
)  # m/s^3, m/s^3, rad/s, rad/s^2
SOON = 2.0  # s before a collision of the best proposal from which on the ego brakes
EXPONENT = 10.0  # of IDM's free-road term
KEYS = (*SCENE_KEYS, "agent_type")  # of the scene
CHUNK = 32  # scenes planned for at a time: fits the processor's cache


class Others(NamedTuple):
    """M agents at constant velocity, those left out that touch the ego already."""

    states: Tensor  # [B, M, T, 4] at T steps
    size: Tensor  # [B, M, 2] m
    seen: Tensor  # [B, M] bool: the row holds an agent
    objects: Tensor  # [B, M] bool: neither a vehicle nor a person; it stands


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
        rows = torch.arange(len(world.step), device=world.step.device)
        return torch.cat(
            [self._plan(take(world, part, keys=KEYS)) for part in rows.split(CHUNK)]
        )

    def _plan(self, world: World) -> Tensor:
        proposals = self.proposals(world)
        scores, collides = score(
            world, proposals, others=self._others(world, range(SCORED_STEPS + 1))
        )
        best = scores.argmax(1)
        row = torch.arange(len(best), device=best.device)
        brake = torch.tensor([-self.emergency_braking, 0.0], device=best.device).expand(
            len(best), PLAN_STEPS, 2
        )
        stop = dynamics.rollout(world.states[:, 0], brake)
        emergency = (collides[row, best] <= SOON) & (
            world.states[:, 0, 3] <= self.emergency_speed
        )
        return torch.where(emergency[:, None, None], stop, proposals[row, best])

    def proposals(self, world: World) -> Tensor:
        """States [B, P, PLAN_STEPS, 4] of the proposals: of each offset, all fractions."""
        path = MissionPath(world)
        start = world.states[:, 0]
        offset = start.new_tensor(OFFSETS).repeat_interleave(len(FRACTIONS))
        speed = self.speeds(
            world,
            path,
            offset=offset,
            fraction=start.new_tensor(FRACTIONS).repeat(len(OFFSETS)),
        )
        shift = offset[:, None].expand(len(start), -1, 1)
        return drive(
            start, path, speed, shift, torch.full_like(shift, self.shift_time)
        ).states

    def speeds(
        self, world: World, path: MissionPath, offset: Tensor, fraction: Tensor
    ) -> Tensor:
        """Speeds [B, P, PLAN_STEPS + 1] m/s by IDM behind leaders on the offsets [P] m,
        and before red lights, at fractions [P] of the speed limit where the ego is."""
        driver = IDMParameters(
            self.headway,
            self.standstill_gap,
            acceleration=self.acceleration,
            braking=self.braking,
            exponent=EXPONENT,
        )
        others = self._others(world, range(PLAN_STEPS))
        half = world.scene["size"][:, 0] / 2
        onto = project(others.states[..., :2].flatten(1, 2), path.route)
        s, d, heading = (x.unflatten(1, others.states.shape[1:3]) for x in onto)
        turn = others.states[..., 2] - heading
        along, side = (_extent(others.size, turn, axis=axis) for axis in (0, 1))
        leads = (d[:, None] - offset[:, None, None]).abs() < (
            side + half[:, 1, None, None]
        )[:, None]
        leads &= others.seen[:, None, :, None]  # [B, P, M, T]
        rear = (s - along)[:, None]
        leading = (others.states[..., 3] * turn.cos())[:, None]
        limit = limit_at(path.mission, path.s)[:, None]
        wanted = fraction * torch.where(limit > 0, limit, self.desired_speed)
        light = (path.s + path.stop_distance(self.braking) + self.standstill_gap)[
            :, None
        ]
        way = path.s[:, None].expand(-1, len(offset))
        now = world.states[:, :1, 3].expand_as(way)
        found = [now]
        for t in range(PLAN_STEPS):
            front = way + half[:, :1]
            ahead = leads[..., t] & (s[:, None, :, t] > way[..., None])
            gap, nearest = (
                (rear[..., t] - front[..., None]).masked_fill(~ahead, torch.inf).min(-1)
            )
            pace = (
                leading[..., t]
                .expand(ahead.shape)
                .gather(-1, nearest[..., None])[..., 0]
            )
            pace = torch.where(light - way < gap, 0.0, pace)
            gap = torch.minimum(gap, light - way).clamp(min=self.standstill_gap)
            asked = idm_acceleration(
                now, wanted, gap=gap, leader_speed=pace, driver=driver, improved=False
            )
            after = (now + DT * asked.clamp(-self.braking, self.acceleration)).clamp(
                0, dynamics.MAX_SPEED
            )
            way = way + (now + after) / 2 * DT
            now = after
            found.append(now)
        return torch.stack(found, -1)

    def _others(self, world: World, steps: range) -> Others:
        """The agents that come nearest, at these steps."""
        agents, seen = nearest(world, self.agents)
        row = torch.arange(len(agents), device=agents.device)[:, None]
        objects = world.scene["agent_type"][row, agents] == OTHER
        states = world.states[row, agents]
        size = world.scene["size"][row, agents]
        states = torch.cat(
            [states[..., :3], states[..., 3:].masked_fill(objects[..., None], 0.0)], -1
        )
        touches = overlap(
            world.states[:, :1],
            world.scene["size"][:, :1],
            second=states,
            second_size=size,
        )
        times = DT * torch.tensor(steps, device=agents.device)
        return Others(
            constant_velocity(states, times),
            size,
            seen=seen & ~touches,
            objects=objects,
        )


def _extent(size: Tensor, turn: Tensor, axis: int) -> Tensor:
    """Half of what boxes [B, M, 2] turned by turn [B, M, T] rad take along (axis 0) or
    across (1) a direction."""
    own = size[..., axis, None] / 2
    other = size[..., 1 - axis, None] / 2
    return own * turn.cos().abs() + other * turn.sin().abs()


def score(world: World, proposals: Tensor, others: Others) -> tuple[Tensor, Tensor]:
    """nuPlan's closed-loop score, in [0, 1], of proposals over the SCORED_STEPS, and
    the time of their first collision at fault.

    Collision and drivable area multiply the weighted mean of progress, relative to the
    proposal that gets farthest by what these two leave of it, time to collision and
    comfort. Proposals follow the mission, and so never drive against its direction,
    which nuPlan scores too.

    Args:
        proposals: [B, P, PLAN_STEPS, 4].
        others: at steps 0 to SCORED_STEPS.

    Returns:
        Scores [B, P]; seconds [B, P], inf without a collision.
    """
    size = world.scene["size"][:, 0]
    now = world.states[:, None, None, 0].expand_as(proposals[:, :, :1])
    scored = torch.cat([now, proposals[:, :, :SCORED_STEPS]], 2)
    contacts = contacts_of(scored, size, others=others)
    loose = in_several_lanes(world, scored, size=size)
    fault = at_fault(scored, size, others=others, touch=contacts[..., 0], loose=loose)
    hit = fault & ~others.objects[:, None, :, None]
    factor = torch.where(
        hit.any((2, 3)), 0.0, torch.where(fault.any((2, 3)), OBJECT_HIT, 1.0)
    )
    factor = factor * on_road(scored, size, world=world)
    times = DT * torch.arange(SCORED_STEPS + 1, device=fault.device)
    collides = torch.where(fault.any(2), times, torch.inf).amin(-1)
    clear = ~runs_into(scored, size, others=others, touch=contacts, loose=loose)
    driven = progress(world, scored, factor=factor)
    smooth = comfortable(world, scored)
    weighted = PROGRESS * driven + TIME_TO_COLLISION * clear + COMFORT * smooth
    return factor * weighted / (PROGRESS + TIME_TO_COLLISION + COMFORT), collides


def progress(world: World, scored: Tensor, factor: Tensor) -> Tensor:
    """Metres along the mission of scored [B, P, T, 4], times factor [B, P], as a
    fraction [B, P] of the most."""
    path = MissionPath(world)
    length = scored[..., :2].diff(dim=2).norm(dim=-1).sum(-1)
    s = project(scored[:, :, -1, :2], path.route, hint=path.s[:, None] + length)[0]
    distance = (s - path.s[:, None]).clamp(min=0) * factor
    farthest = distance.amax(1, keepdim=True)
    relative = distance / farthest.clamp(min=LEAST_PROGRESS)
    return torch.where(farthest > LEAST_PROGRESS, relative, (factor > 0).to(relative))


def contacts_of(states: Tensor, size: Tensor, others: Others) -> Tensor:
    """Bool [B, P, M, T, L]: the ego at states [B, P, T, 4] of size [B, 2] and an agent
    touch, LOOKS s after step T."""
    looks = states.new_tensor(LOOKS)
    own, theirs = (constant_velocity(track, looks) for track in (states, others.states))
    touch = overlap(
        own[:, :, None],
        size[:, None, None, None, None],
        second=theirs[:, None],
        second_size=others.size[:, None, :, None, None],
    )
    return touch & others.seen[:, None, :, None, None]


def first(events: Tensor) -> tuple[Tensor, ...]:
    """Indices of the first true value along the last dim of events [..., T]."""
    return (events & (events.cumsum(-1) == 1)).nonzero(as_tuple=True)


def angle_at_axle(states: Tensor, size: Tensor, centre: Tensor) -> Tensor:
    """Angle [Q] in [0, pi] at the rear axle of states [Q, 4] of size [Q, 2], from their
    heading to centres [Q, 2]."""
    ahead, beside = to_frame(centre, states).unbind(-1)
    return torch.atan2(beside, ahead + REAR_AXLE * size[:, 0]).abs()


def at_fault(
    states: Tensor, size: Tensor, others: Others, touch: Tensor, loose: Tensor
) -> Tensor:
    """Collisions at the ego's fault, at the step at which it first touches an agent.

    The ego is at fault if it moves and the other stands, if its front meets the other,
    or if the other, not behind it, meets it beside while it is in several lanes. Whom
    it touches without fault it does not look at again.

    Args:
        states: [B, P, T, 4] of the ego.
        size: [B, 2] of the ego.
        touch: [B, P, M, T] bool.
        loose: [B, P, T] bool: the ego is in several lanes.

    Returns:
        Bool [B, P, M, T].
    """
    scene, proposal, agent, step = first(touch)
    own = states[scene, proposal, step]
    box = size[scene]
    other = others.states[scene, agent, step]
    other_size = others.size[scene, agent]
    direction = torch.stack([own[:, 2].cos(), own[:, 2].sin()], -1)
    bumper = torch.cat([own[:, :2] + box[:, :1] / 2 * direction, own[:, 2:]], -1)
    front = overlap(
        bumper, box * box.new_tensor([0.0, 1.0]), second=other, second_size=other_size
    )
    behind = angle_at_axle(own, box, centre=other[:, :2]) > BEHIND
    moves = own[:, 3] > STANDS
    stands = other[:, 3].abs() <= STANDS
    fault = torch.zeros_like(touch)
    fault[scene, proposal, agent, step] = moves & (
        stands | ~behind & (front | loose[scene, proposal, step])
    )
    return fault


def runs_into(
    states: Tensor, size: Tensor, others: Others, touch: Tensor, loose: Tensor
) -> Tensor:
    """Bool [B, P]: at constant velocities the ego would touch an agent within a second
    that is ahead of it, or, while it is in several lanes, not behind it. What it would
    first touch elsewhere does not count later.

    touch [B, P, M, T, L] of states [B, P, T, 4], loose [B, P, T].
    """
    moves = states[..., 3].abs() >= NO_LOOK
    events = (touch & moves[:, :, None, :, None]).flatten(3)
    scene, proposal, agent, event = first(events)
    step = event // len(LOOKS)
    seconds = states.new_tensor(LOOKS)[event % len(LOOKS)]
    centre = constant_velocity(others.states[scene, agent, step], seconds[:, None])[
        :, 0, :2
    ]
    angle = angle_at_axle(states[scene, proposal, step], size[scene], centre=centre)
    counts = (angle < AHEAD) | loose[scene, proposal, step] & (angle <= BEHIND)
    result = torch.zeros_like(states[..., 0, 0], dtype=torch.bool)
    result[scene[counts], proposal[counts]] = True
    return result


def in_several_lanes(world: World, states: Tensor, size: Tensor) -> Tensor:
    """Bool [B, P, T]: states [B, P, T, 4] reach beyond a lane of LANE_WIDTH about the
    mission: egos know no other."""
    path = MissionPath(world)
    centres = states[..., :2]
    driven = torch.nn.functional.pad(
        centres.diff(dim=2).norm(dim=-1).cumsum(-1), (1, 0)
    )
    near = (path.s[:, None, None] + driven).flatten(1, 2)
    beside = project(centres.flatten(1, 2), path.route, hint=near)[1].view(driven.shape)
    return beside.abs() + size[:, None, None, 1] / 2 > LANE_WIDTH / 2


def on_road(states: Tensor, size: Tensor, world: World) -> Tensor:
    """Bool [B, P]: no corner of states [B, P, T, 4] leaves the drivable area."""
    field = world.scene["field"]
    origin = world.scene["field_origin"]
    beyond = off_road(
        corners(states, size[:, None, None]).flatten(1, 3), field, origin=origin
    ).view(*states.shape[:3], 4)
    return beyond.amax((-2, -1)) <= 0


def comfortable(world: World, scored: Tensor) -> Tensor:
    """Bool [B, P]: scored [B, P, SCORED_STEPS + 1, 4] keep nuPlan's bounds of comfort,
    by the published filters.

    The accelerations are a step's changes of speed, the first one the ego's last; like
    nuPlan's vehicle it has none to the side.
    """
    speed = scored[..., 3]
    heading = scored[..., 2]
    accel = torch.cat(
        [world.accel[:, None, :1].expand_as(speed[..., :1]), speed.diff(dim=-1) / DT],
        -1,
    )
    turned = torch.nn.functional.pad(wrap(heading.diff(dim=-1)).cumsum(-1), (1, 0))
    whole = SCORED_STEPS + 1

    def filtered(
        values: Tensor, window: int, order: int, derivative: int = 0
    ) -> Tensor:
        return (
            values @ savitzky_golay(window, order, derivative=derivative).to(values).mT
        )

    longitudinal = filtered(accel, whole, order=2)
    smooth, total = (filtered(values, 8, order=2) for values in (accel, accel.abs()))
    inside = (longitudinal > ACCELERATIONS[0]) & (longitudinal < ACCELERATIONS[1])
    inside &= filtered(smooth, whole, order=2, derivative=1).abs() < LONGITUDINAL_JERK
    inside &= filtered(total, whole, order=2, derivative=1).abs() < JERK
    inside &= filtered(turned, 5, order=2, derivative=1).abs() < YAW_RATE
    inside &= filtered(turned, 5, order=3, derivative=2).abs() < YAW_ACCELERATION
    return inside.all(-1)


@cache
def savitzky_golay(window: int, order: int, derivative: int) -> Tensor:
    """The filter of SCORED_STEPS + 1 values at steps of DT as a matrix [SCORED_STEPS +
    1, SCORED_STEPS + 1]."""
    unit = np.eye(SCORED_STEPS + 1)
    return torch.from_numpy(
        savgol_filter(unit, window, order, deriv=derivative, delta=DT, axis=0)
    )
