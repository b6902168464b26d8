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
from e2rl.run.config import configured, setting
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


class LogReplay(Traffic):
    """The smoothed recording; a vehicle is absent in gaps of its track and after its
    end."""

    def replan(
        self,
        state: State,
        world: World,
        ego_plan: Tensor,
    ) -> tuple[State, TrafficPlan]:
        """Recorded states and presence of the coming steps."""
        scene = world.scene
        row = torch.arange(len(world.step), device=world.step.device)
        return state, replayed(scene["logged"], scene["logged_valid"], row, world=world)


def replayed(
    states: Tensor, valid: Tensor, row: Tensor, *, world: World
) -> TrafficPlan:
    """Returns the coming steps of stored tracks; nobody is there after their end.

    Args:
        states: [D, T+1, N, 4], step 0 is the start.
        valid: [D, T+1, N] bool.
        row: [B] int64, the tracks of each scene.
        world: of B scenes.
    """
    vehicles = world.scene["route_log"].shape[1]
    step = steps_ahead(world)
    index = step.clamp(max=states.shape[1] - 1)
    recorded = valid[row[:, None], index, :vehicles]
    present = recorded & (step < states.shape[1])[..., None]
    motion = states[row[:, None], index, :vehicles].transpose(1, 2)
    return TrafficPlan(motion, present.transpose(1, 2))


class ConstantVelocity(Traffic):
    """Start heading and start speed are kept, in reverse too; parked vehicles stay
    parked, and no vehicle leaves."""

    def replan(
        self,
        state: State,
        world: World,
        ego_plan: Tensor,
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
        self.driver = IDMParameters(
            self.headway,
            self.standstill_gap,
            acceleration=self.acceleration,
            braking=self.braking,
            exponent=self.exponent,
        )

    @torch.no_grad()
    def reset(self, scenes: TensorDictBase, seed: Tensor, eta: Tensor) -> IDMState:
        """Start states on each vehicle's nearest route candidate; the ego's route is
        its mission."""
        route = torch.zeros_like(scenes["route_log"])
        route[:, 0] = scenes["route_log"][:, 0]
        routed = route_scene(scenes, route)
        return IDMState(routed, start_state(scenes, routed))

    @torch.no_grad()
    def replan(
        self,
        state: IDMState,
        world: World,
        ego_plan: Tensor,
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
            _driven(
                decode(x, lane, routed.points),
                lane,
                frozen=frozen,
            ),
            capped=capped,
            state=lane,
            obstacles=Obstacles(
                world.states,
                routed.size,
                present=world.valid,
            ),
        )
        plan = TrafficPlan(
            motion.states(),
            present[..., None] & on_map(routed, motion.s),
            route=routed.route,
        )
        return IDMState(
            routed, motion.map(lambda value: value[..., REPLAN_STEPS - 1])
        ), plan

    def _wanted(
        self,
        routed: RoutedScene,
        lane: LaneState,
        world: World,
    ) -> Tensor:
        """IDM acceleration [B, V] behind the leader or the light, whichever brakes
        harder."""
        vehicles = lane.v.shape[1]
        leader = leaders(
            lane.s,
            routed.points,
            agents=world.states[:, :, None],
            size=routed.size,
            present=world.valid,
            d=lane.d,
        )
        gap = leader.gap[..., 0]
        gap = torch.where(gap < FREE_GAP, gap, torch.inf)
        last = routed.limit.shape[-1] - 1
        index = (lane.s / SPACING).round().long().clamp(0, last)
        limit = routed.limit.gather(-1, index[..., None])[..., 0]
        start_speed = world.scene["start"][:, :vehicles, 3].clamp(min=self.speed)
        desired = torch.where(limit > 0, limit, start_speed)
        line = stop_line_distance(
            light_state_at(routed.light_state, routed.light, step=world.step),
            routed.light_s - lane.s[..., None],
            speed=lane.v,
            red_braking=2 * self.braking,
            yellow_braking=2 * self.braking,
        )
        half = routed.size[:, :vehicles, 0] / 2
        line = line - half - STOP_GAP + self.standstill_gap

        def behind(gap: Tensor, speed: Tensor) -> Tensor:
            return idm_acceleration(
                lane.v,
                desired,
                gap=gap.clamp(min=0.1),
                leader_speed=speed.clamp(min=0),
                driver=self.driver,
                improved=True,
            )

        following = behind(gap, leader.speed[..., 0])
        return torch.minimum(following, behind(line, torch.zeros_like(line)))


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
    others = lane.map(lambda value: value[:, 1:])
    located_others = locate(
        world.states[:, 1 : lane.v.shape[1]],
        others.a,
        yaw_rate=others.kappa * others.v,
        points=routed.points[:, 1:],
        hint=others.s,
    )
    others = replace(
        others,
        s=located_others.s,
        d=located_others.d,
        d1=located_others.d1,
    )
    return LaneState(
        **{
            name: torch.cat([getattr(ego, name), value], 1)
            for name, value in vars(others).items()
        }
    )


def _driven(
    motion: LaneState,
    lane: LaneState,
    frozen: Tensor,
) -> LaneState:
    """The motion [B, V, HORIZON] `as_driven`, with frozen [B, V] vehicles at
    standstill, once they do not reverse."""
    still = lane.map(lambda value: value[..., None].expand(*value.shape, HORIZON))
    zero = torch.zeros_like(still.v)
    motion = select(
        frozen,
        replace(still, v=zero, a=zero),
        other=motion,
    )
    on_lane = torch.ones_like(frozen)  # a vehicle without a lane keeps straight on
    return select(
        frozen & (lane.v >= 0),
        motion,
        other=as_driven(motion, lane, on_lane=on_lane),
    )
