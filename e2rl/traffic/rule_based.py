"""Traffic without a prior's samples: log replay, constant velocity, and lane-following
by IDM.

IDM: every vehicle returns to the centreline of the route candidate nearest to it and
accelerates by the Intelligent Driver Model (Treiber et al. 2000) behind the nearest
agent or red light ahead, within the bounds of the prior.
"""

from dataclasses import dataclass, replace

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.planners.path import STOP_GAP
from e2rl.prior.bounds import Obstacles, Rows, apply_cap, bounded
from e2rl.prior.driving import as_driven
from e2rl.prior.lane_relative import (
    ACCEL_SCALE,
    HORIZON,
    KNOTS,
    SIZE,
    LaneState,
    decode,
    locate,
    select,
)
from e2rl.prior.prior import STANDING_SPEED, Prior
from e2rl.prior.routes import RoutedScene, on_map, route_scene, start_state
from e2rl.run.settings import configured, setting
from e2rl.scenes.route import SPACING
from e2rl.sim.leaders import FREE_GAP, IDMParameters, idm_acceleration, leaders
from e2rl.sim.mission import light_state_at, stop_line_distance
from e2rl.sim.world import World
from e2rl.traffic.traffic import (
    REPLAN_STEPS,
    State,
    Traffic,
    TrafficPlan,
    keep_velocity,
    steps_ahead,
)

PLACE = ("s", "d", "d1")  # of a lane state: where a vehicle is on its route


class LogReplay(Traffic):
    """The smoothed recording; a vehicle is absent in gaps of its track and after its
    end."""

    def replan(
        self, state: State, world: World, ego_plan: Tensor
    ) -> tuple[State, TrafficPlan]:
        """Recorded states and presence of the coming steps."""
        logged = world.scene["logged"]
        valid = world.scene["logged_valid"]
        vehicles = world.scene["route_log"].shape[1]
        step = steps_ahead(world)
        row = torch.arange(len(step), device=step.device)[:, None]
        at = step.clamp(max=logged.shape[1] - 1)
        known = valid[row, at, :vehicles] & (step < logged.shape[1])[..., None]
        return state, TrafficPlan(
            logged[row, at, :vehicles].transpose(1, 2), known.transpose(1, 2)
        )


class ConstantVelocity(Traffic):
    """Start heading and start speed are kept, in reverse too; parked vehicles stay
    parked, and no vehicle leaves."""

    def replan(
        self, state: State, world: World, ego_plan: Tensor
    ) -> tuple[State, TrafficPlan]:
        """States at the coming steps, from the start frame on."""
        scene = world.scene
        vehicles = world.scene["route_log"].shape[1]
        start = scene["start"][:, :vehicles].clone()
        start[..., 3] = start[..., 3].masked_fill(scene["parked"][:, :vehicles], 0.0)
        states = keep_velocity(start, steps_ahead(world)[:, None])
        return state, TrafficPlan(
            states, world.valid[:, :vehicles, None].expand(states.shape[:-1])
        )


@dataclass
class IDMState:
    """routed: the vehicles' routes; lane [B, V]: lane states at the end of the executed
    plans."""

    routed: RoutedScene
    lane: LaneState


@configured("synthesizer/idm")
@dataclass(eq=False, repr=False)
class IDM(Traffic):
    """Car-following on the nearest route candidate, within the prior's bounds. Vehicles
    that stand or reverse at the start come to a halt and stay."""

    prior: Prior
    headway: float = setting()
    standstill_gap: float = setting()
    acceleration: float = setting()
    braking: float = setting()
    exponent: float = setting()
    speed: float = setting()

    def __post_init__(self) -> None:
        self.bounds = self.prior.bounds
        settings = (
            self.headway,
            self.standstill_gap,
            self.acceleration,
            self.braking,
            self.exponent,
        )
        self.driver = IDMParameters(*settings)

    @torch.no_grad()
    def reset(self, scenes: TensorDictBase, seed: Tensor, eta: Tensor) -> IDMState:
        """Start states on each vehicle's nearest route candidate; the ego's route is
        its mission."""
        mission = scenes["route_log"][:, :1]
        routed = route_scene(
            scenes,
            torch.cat([mission, torch.zeros_like(scenes["route_log"][:, 1:])], 1),
        )
        return IDMState(routed, start_state(scenes, routed))

    @torch.no_grad()
    def replan(
        self, state: IDMState, world: World, ego_plan: Tensor
    ) -> tuple[IDMState, TrafficPlan]:
        """One acceleration for the whole plan, under the bounds of the executed part."""
        routed = state.routed
        vehicles = routed.route.shape[1]
        present = world.valid[:, :vehicles]
        lane = located(state.lane, world, routed=routed)
        wanted = self._wanted(routed, lane, world=world).clamp(min=self.bounds.floor)
        x = (wanted / ACCEL_SCALE)[..., None].expand(*lane.v.shape, KNOTS)
        x = torch.cat([x, x.new_zeros(*lane.v.shape, SIZE - KNOTS)], -1)
        frozen = (
            routed.parked
            | (world.scene["start"][:, :vehicles, 3] < STANDING_SPEED)
            | ~present
        )

        def capped(rows: Rows, cap: Tensor) -> LaneState:
            begin = lane.map(lambda value: value[rows])
            slowed, braked = apply_cap(cap, x[rows], begin)
            motion = decode(slowed, braked, routed.points[rows])
            return _driven(motion, begin, frozen=frozen[rows])

        motion = bounded(
            self.bounds,
            _driven(decode(x, lane, routed.points), lane, frozen=frozen),
            capped=capped,
            state=lane,
            obstacles=Obstacles(world.states, routed.size, present=world.valid),
        )
        plan = TrafficPlan(
            motion.states(),
            present[..., None] & on_map(routed, motion.s),
            route=routed.route,
        )
        return IDMState(
            routed, motion.map(lambda value: value[..., REPLAN_STEPS - 1])
        ), plan

    def _wanted(self, routed: RoutedScene, lane: LaneState, world: World) -> Tensor:
        """IDM acceleration [B, V] behind the leader or the light, whichever brakes
        harder."""
        vehicles = lane.v.shape[1]
        length = routed.size[:, :vehicles, 0]
        now = world.states[:, :, None]
        gap, speed, _ = leaders(
            lane.s,
            routed.points,
            agents=now,
            size=routed.size,
            present=world.valid,
            d=lane.d,
        )
        gap = gap[..., 0]
        speed = speed[..., 0]
        gap = torch.where(gap < FREE_GAP, gap, torch.inf)
        at = (lane.s / SPACING).round().long().clamp(0, routed.limit.shape[-1] - 1)
        limit = routed.limit.gather(-1, at[..., None])[..., 0]
        desired = torch.where(
            limit > 0,
            limit,
            world.scene["start"][:, :vehicles, 3].clamp(min=self.speed),
        )
        light = light_state_at(routed.light_state, routed.light, step=world.step)
        brake = 2 * self.braking
        line = stop_line_distance(
            light,
            routed.light_s - lane.s[..., None],
            speed=lane.v,
            red_braking=brake,
            yellow_braking=brake,
        )
        line = line - length / 2 - STOP_GAP + self.standstill_gap
        behind = idm_acceleration(
            lane.v,
            desired,
            gap=gap.clamp(min=0.1),
            leader_speed=speed.clamp(min=0),
            driver=self.driver,
            improved=True,
        )
        halting = idm_acceleration(
            lane.v,
            desired,
            gap=line.clamp(min=0.1),
            leader_speed=torch.zeros_like(line),
            driver=self.driver,
            improved=True,
        )
        return torch.minimum(behind, halting)


def located(lane: LaneState, world: World, routed: RoutedScene) -> LaneState:
    """The lane states where the vehicles are in the world; the ego as it is simulated,
    without a curvature."""
    accel = world.accel[:, :1]
    ego = locate(
        world.states[:, :1],
        accel,
        yaw_rate=torch.zeros_like(accel),
        points=routed.points[:, :1],
    )
    others = world.states[:, 1 : lane.v.shape[1]]
    there = locate(
        others,
        lane.a[:, 1:],
        yaw_rate=(lane.kappa * lane.v)[:, 1:],
        points=routed.points[:, 1:],
        hint=lane.s[:, 1:],
    )
    rest = {name: value[:, 1:] for name, value in vars(lane).items()} | {
        name: getattr(there, name) for name in PLACE
    }
    return LaneState(
        **{
            name: torch.cat([getattr(ego, name), value], 1)
            for name, value in rest.items()
        }
    )


def _driven(motion: LaneState, lane: LaneState, frozen: Tensor) -> LaneState:
    """The motion [B, V, HORIZON] `as_driven`, with frozen [B, V] vehicles at
    standstill, once they do not reverse."""
    still = lane.map(lambda value: value[..., None].expand(*value.shape, HORIZON))
    zero = torch.zeros_like(still.v)
    motion = select(frozen, replace(still, v=zero, a=zero), other=motion)
    on_lane = torch.ones_like(frozen)  # who has none keeps straight on
    return select(
        frozen & (lane.v >= 0), motion, other=as_driven(motion, lane, on_lane=on_lane)
    )
