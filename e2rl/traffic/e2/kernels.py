"""Importance kernels: plans in the prior's own coordinates that the attack may be drawn
to.

A kernel shifts one vehicle's plan away from the prior's mean: another acceleration,
another place across the lane. Each costs about delta^T C^-1 delta / 2 nats (pull.py)
and is worth what `foresee` makes of it. Those worth the most, less what they cost,
become joint samples, of which the best is driven (choice.py).
"""

from dataclasses import dataclass, replace
from functools import cache
from itertools import product

import torch
from torch import Tensor

from e2rl.prior import lane_relative
from e2rl.prior.lane_relative import (
    BEND_SCALE,
    HORIZON,
    KNOTS,
    OFFSET_SCALE,
    SIZE,
    LaneState,
)
from e2rl.run.config import configured, setting
from e2rl.scenes.drivable_area import off_road
from e2rl.scenes.lane_graph import against_lanes, packed
from e2rl.scenes.recording import DT
from e2rl.sim.world import World
from e2rl.traffic.e2.foresight import Foresight, foresee
from e2rl.traffic.e2.pull import nats
from e2rl.traffic.motion import smallest

# The displacements of a kernel: m/s^2 from the prior's mean, the fraction of it at the
# first knots (drivers do not jump), and m to either side after the lateral horizon.
ACCELERATIONS = (0.0, -0.6, 0.6, -1.2, 1.2, -2.0, 2.0, -3.0)
ONSET = (0.4, 0.8)
OFFSETS = (0.8, 1.6, 2.5, 3.5, 4.5)
# Of the way across that half of the kernels have come at half of the lateral horizon.
EARLY = 0.5

# Who has kernels: the nearest NEAREST vehicles within REACH m of the ego and PATH_REACH
# m of its path that move at 1 m/s somewhere in their expected plan.
REACH = 60.0
PATH_REACH = 10.0
NEAREST = 10
MOVING = 1.0

MAX_LATERAL = 4.0  # m/s^2
APART = 6.0  # nats between two kernels of a vehicle that are drawn
BUMP = 2.2  # m between centres, nearer than which a plan touches somebody else
SHOULDER = 0.3  # m inside the drivable area that a plan may always come to its border
CHECKED = 12  # plans of a vehicle that are checked for driving against the lanes
STRIDE = 5  # steps between the states of a plan that are looked at


@configured("synthesizer/e2", "kernels")
@dataclass(frozen=True)
class KernelSettings:
    """Settings of the kernels; conf/synthesizer/e2.yaml explains each."""

    samples: int = setting(low=1)
    gain: float = setting(low=0)
    pull: float = setting(low=0)


@dataclass(frozen=True)
class Kernels:
    """Goals x [B, N, SIZE] of N kernels, best first, and the vehicle [B, N] that each
    moves, -1 for none; of so many vehicles."""

    goal: Tensor
    vehicle: Tensor
    vehicles: int


@cache
def displacements(device: torch.device) -> Tensor:
    """The kernels' displacements [O, SIZE] of x; the first is none."""
    sides = product(OFFSETS, (1, -1), (0.0, EARLY))
    across = [(0.0, 0.0), *((sign * offset, early) for offset, sign, early in sides)]
    moves = torch.tensor(
        [(accel, *side) for side in across for accel in ACCELERATIONS], device=device
    )
    accel, offset, early = moves.split(1, dim=1)
    ramp = torch.tensor(ONSET, device=device)
    ramp = torch.nn.functional.pad(ramp, (0, KNOTS - len(ramp)), value=1.0)
    bend = offset * early / (2 * BEND_SCALE)
    return torch.cat([accel * ramp, bend, offset / OFFSET_SCALE], 1)


@dataclass(frozen=True)
class KernelAttack:
    """G vehicles whose plans are valued.

    row, vehicle [G] int64: their scenes and rows; world: the B scenes now; ego_plan
    [B, H, 4]: the ego's expected states; plan [B, V, H, 4]: everybody's; since, settled
    [G]: see `foresee`.
    """

    row: Tensor
    vehicle: Tensor
    world: World
    ego_plan: Tensor
    plan: Tensor
    since: Tensor
    settled: Tensor

    @classmethod
    def of(
        cls,
        world: World,
        free: Tensor,
        *,
        ego_plan: Tensor,
        plan: Tensor,
        since: Tensor,
        settled: Tensor,
    ) -> "KernelAttack":
        """Returns the attack of the nearest vehicles that are free to have kernels.

        Args:
            world: B scenes.
            free: [B, V] bool.
            ego_plan: [B, H, 4], the ego's expected states.
            plan: [B, V, H, 4], everybody's.
            since: [B, V] s, see `foresee`.
            settled: [B, V] bool, see `foresee`.
        """
        position = world.states[:, : free.shape[1], :2]
        gap = (position - world.states[:, :1, :2]).norm(dim=-1)
        ego_path = ego_plan[:, None, STRIDE - 1 :: STRIDE, :2]
        points = plan[..., STRIDE - 1 :: STRIDE, :2]
        to_path = torch.cdist(points, ego_path.expand(*points.shape[:2], -1, -1))
        near = (gap < REACH) & (to_path.flatten(2).amin(-1) < PATH_REACH)
        moving = plan[..., 3].amax(-1) > MOVING
        chosen = smallest(free & near & moving, gap, count=NEAREST)
        row, vehicle = chosen.nonzero(as_tuple=True)
        return cls(
            row=row,
            vehicle=vehicle,
            world=world,
            ego_plan=ego_plan,
            plan=plan,
            since=since[row, vehicle],
            settled=settled[row, vehicle],
        )

    def foresight(self, tracks: Tensor, index: Tensor | None = None) -> Foresight:
        """The Foresight of plans [G, O, H, 4]; index [C]: of the vehicles whose they
        are, None: one of each."""
        attack = self if index is None else self._some(index)
        size = attack.world.scene["size"]
        states = attack.world.states
        start = states[attack.row, attack.vehicle, None, None]
        path = torch.cat([states[:, :1], attack.ego_plan[:, :HORIZON]], 1)
        return foresee(
            path[attack.row],
            size[attack.row, 0],
            tracks=torch.cat([start.expand(*tracks.shape[:2], 1, 4), tracks], 2),
            sizes=size[attack.row, attack.vehicle],
            since=attack.since,
            settled=attack.settled,
        )

    def _some(self, index: Tensor) -> "KernelAttack":
        """The attack of vehicles index [C] of the G."""
        return replace(
            self,
            row=self.row[index],
            vehicle=self.vehicle[index],
            since=self.since[index],
            settled=self.settled[index],
        )

    def impossible(self, tracks: Tensor, lateral: Tensor, time: Tensor) -> Tensor:
        """Bool [G, O]: plans that leave the road, turn too sharply, or touch others
        before they meet the ego.

        Args:
            tracks: [G, O, H, 4].
            lateral: [G, O], largest lateral acceleration in m/s^2.
            time: [G, O] s until the ego is met, inf for never.
        """
        points = tracks[..., STRIDE - 1 :: STRIDE, :2]
        return (
            self._off_road(points)
            | (lateral > MAX_LATERAL)
            | self._bumps(points, time=time)
        )

    def _off_road(self, points: Tensor) -> Tensor:
        """Bool [G, O]: points [G, O, T, 2] are farther off the road than now."""
        field = self.world.scene["field"]
        origin = self.world.scene["field_origin"]
        present = self.world.states[self.row, self.vehicle, None, :2]
        allowed = off_road(present, field, origin, self.row).clamp(min=-SHOULDER)
        beyond = off_road(points.flatten(1, 2), field, origin, self.row)
        return beyond.view(points.shape[:-1]).amax(-1) > allowed

    def _bumps(self, points: Tensor, time: Tensor) -> Tensor:
        """Bool [G, O]: points [G, O, T, 2] touch others by `time` [G, O] s."""
        others = self.plan[self.row, :, STRIDE - 1 :: STRIDE, :2]
        gap = torch.cdist(points.transpose(1, 2), others.transpose(1, 2))  # [G,T,O,V]
        counts = self.world.valid[self.row, : gap.shape[-1]].clone()
        counts[:, 0] = False
        counts[torch.arange(len(self.row)), self.vehicle] = False
        nearest = gap.masked_fill(~counts[:, None, None], torch.inf).amin(-1)
        number = torch.arange(1, nearest.shape[1] + 1, device=gap.device)
        moment = STRIDE * DT * number[:, None]
        until = time[:, None].clamp(max=HORIZON * DT) + STRIDE * DT
        return ((nearest < BUMP) & (moment <= until)).any(1)

    def against(self, tracks: Tensor, time: Tensor, plans: Tensor) -> Tensor:
        """Bool [G, K]: plans [G, K] of tracks [G, O, H, 4] that meet the ego at `time`
        [G, O] s, or half a second before, against the lanes."""
        step = (time.clamp(max=HORIZON * DT) / DT).long().clamp(1, HORIZON)
        step = step.gather(1, plans) - 1
        step = torch.stack([(step - STRIDE).clamp(min=0), step], -1)
        shape = (*plans.shape, *tracks.shape[2:])
        tracks = tracks.gather(1, plans[..., None, None].expand(shape))
        pose = tracks.gather(2, step[..., None].expand(*step.shape, 4))
        wrong = self._wrong_way(pose.flatten(1, 2))
        return wrong.view(step.shape).any(-1)

    def _wrong_way(self, pose: Tensor) -> Tensor:
        """Bool [G, N]: every lane at pose [G, N, 4] runs against it. Each scene's map
        is read once for all of its vehicles."""
        scene, number = self.row.unique(return_inverse=True)
        of_scene = number == torch.arange(len(scene), device=number.device)[:, None]
        place, present = packed(of_scene)
        place = torch.where(present, place, place[:, :1])
        poses = pose[place].flatten(1, 2)
        by_scene = against_lanes(
            self.world.scene["lane_points"][scene],
            self.world.scene["lane_index"][scene],
            xy=poses[..., :2],
            heading=poses[..., 2, None],
        ).view(*place.shape, -1)
        wrong = torch.zeros(pose.shape[:2], dtype=torch.bool, device=pose.device)
        wrong[place[present]] = by_scene[present]
        return wrong


def propose_kernels(
    attack: KernelAttack,
    lane: LaneState,
    *,
    points: Tensor,
    mean: Tensor,
    gain: Tensor,
    count: int,
) -> Kernels:
    """Returns the kernels of highest value: gain times their worth, less what they
    cost. Those that gain nothing are none.

    Args:
        attack: the vehicles that may have kernels.
        lane: lane states [B, V].
        points: [B, V, P, 2], the routes that they are on.
        mean: [B, V, SIZE], the prior's clean estimate.
        gain: [B] nats.
        count: kernels of a scene.
    """
    batch, vehicles, _ = mean.shape
    if not len(attack.row):
        goal = mean.new_zeros(batch, count, SIZE)
        nobody = gain.new_full((batch, count), -1, dtype=torch.int64)
        return Kernels(goal, nobody, vehicles=vehicles)
    value = _values(attack, lane, points=points, mean=mean, gain=gain)
    table = displacements(mean.device)
    goals = []
    chosen = []
    row = torch.arange(batch, device=mean.device)
    for _ in range(count):
        best, pick = value.flatten(1).max(1)
        vehicle = pick // len(table)
        displacement = table[pick % len(table)]
        goals.append(mean[row, vehicle] + displacement)
        chosen.append(torch.where(best > 0, vehicle, -1))
        alike = nats(table - displacement[:, None]) < APART  # [B, O]
        same = torch.nn.functional.one_hot(vehicle, vehicles).bool()
        value = value.masked_fill(same[..., None] & alike[:, None], -torch.inf)
    return Kernels(torch.stack(goals, 1), torch.stack(chosen, 1), vehicles=vehicles)


def _values(
    attack: KernelAttack,
    lane: LaneState,
    *,
    points: Tensor,
    mean: Tensor,
    gain: Tensor,
) -> Tensor:
    """Value in nats [B, V, O] of the kernels of each vehicle, -inf of those that are
    impossible or against the lanes; arguments of `propose_kernels`."""
    table = displacements(mean.device)
    place = (attack.row, attack.vehicle)
    x = mean[place][:, None] + table
    start = lane.map(lambda value: value[place][:, None].expand(x.shape[:2]))
    motion = lane_relative.decode_options(x, start, points[place])
    tracks = motion.states()
    foresight = attack.foresight(tracks)
    lateral = (motion.v**2 * motion.kappa.abs()).amax(-1)
    value = gain[attack.row, None] * foresight.worth - nats(table)
    impossible = attack.impossible(tracks, lateral, time=foresight.time)
    value = value.masked_fill(impossible, -torch.inf)
    # Only the best of a vehicle are checked against the lanes: that is slow.
    best, options = value.topk(min(CHECKED, value.shape[-1]), -1)
    against = attack.against(tracks, foresight.time, plans=options)
    lawful = best.masked_fill(against, -torch.inf)
    value = torch.full_like(value, -torch.inf).scatter(1, options, lawful)
    of_scenes = mean.new_full((*mean.shape[:2], len(table)), -torch.inf)
    return of_scenes.index_put(place, value)
