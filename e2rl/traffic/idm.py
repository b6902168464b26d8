"""IDM lane-following under the prior's own acceleration bounds, standing cars frozen: the traffic a prior must beat.

Every vehicle keeps the route candidate nearest to it, returns to its middle, and accelerates by the Intelligent Driver
Model (Treiber et al. 2000) behind the nearest agent or red light ahead. Bounds, decoder and the end of a vehicle at the
map's border are those of the prior (e2rl/prior/bounds.py, lane_relative.py).
"""

from dataclasses import dataclass, replace

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.ego.idm import LINE_GAP
from e2rl.prior.bounds import BoundSettings, Obstacles, apply_cap, bounded
from e2rl.prior.lane_relative import ACCEL_SCALE, HORIZON, KNOTS, SIZE, LaneState, decode, locate
from e2rl.prior.prior import STANDING_SPEED, Plan
from e2rl.prior.routed import RoutedScene
from e2rl.scene.recording import LIGHT_RED, LIGHT_YELLOW
from e2rl.scene.route import SPACING
from e2rl.sim.car_following import IDMParameters, idm_acceleration
from e2rl.sim.leaders import FREE_GAP, leaders
from e2rl.sim.world import World
from e2rl.synthesizer.episode import Episode
from e2rl.traffic.traffic import Baseline


@dataclass(frozen=True)
class IDMSettings:
    """Time gap [s], gap at standstill [m], maximum acceleration and comfortable braking [m/s^2], exponent; speed [m/s]
    wanted where no limit is known and the vehicle is slower."""

    headway: float = 1.5
    standstill_gap: float = 2.0
    acceleration: float = 1.0
    braking: float = 2.0
    exponent: float = 4.0
    speed: float = 10.0


class IDM(Baseline):
    """Car-following on the nearest route candidate; vehicles that stand at the start stand for good."""

    def __init__(self, bounds: BoundSettings, settings: IDMSettings | None = None):
        """bounds: those of the prior it is compared with."""
        self.bounds, self.settings = bounds, settings or IDMSettings()

    def routes(self, scene: TensorDictBase) -> Tensor:
        """The nearest candidate [B, V] of everybody; the ego's is its mission."""
        nearest = torch.zeros_like(scene["route_log"])
        return torch.cat([scene["route_log"][:, :1], nearest[:, 1:]], 1)

    def plan(self, episode: Episode, world: World) -> Plan:
        """One acceleration for the whole plan, under the bounds of the executed part."""
        routed = episode.routed
        vehicles = routed.route.shape[1]
        present = world.valid[:, :vehicles]
        state = _with_ego(episode.state, world, routed)
        wanted = self._wanted(routed, state, world).clamp(min=self.bounds.floor)
        x = (wanted / ACCEL_SCALE)[..., None].expand(*state.v.shape, KNOTS)
        x = torch.cat([x, x.new_zeros(*state.v.shape, SIZE - KNOTS)], -1)
        frozen = routed.parked | (world.scene["start"][:, :vehicles, 3] < STANDING_SPEED) | ~present
        obstacles = Obstacles(world.states, routed.size, world.valid, torch.zeros_like(present))
        motion = bounded(
            self.bounds,
            lambda cap: _held(decode(*apply_cap(cap, x, state, self.bounds.onset), routed.points), state, frozen),
            state,
            obstacles,
        )
        gone = routed.open[..., None] & (motion.s >= routed.length[..., None]) & routed.has_lane[..., None]
        return Plan(motion, present[..., None] & ~(gone.cumsum(-1) > 0))

    def _wanted(self, routed: RoutedScene, state: LaneState, world: World) -> Tensor:
        """IDM acceleration [B, V] behind the leader or the light, whichever brakes harder."""
        own, vehicles = self.settings, state.v.shape[1]
        length = routed.size[:, :vehicles, 0]
        gap, speed, _ = leaders(state.s, routed.points, world.states, routed.size, world.valid, state.d)
        gap = torch.where(gap < FREE_GAP, gap, torch.inf)
        at = (state.s / SPACING).round().long().clamp(0, routed.limit.shape[-1] - 1)
        limit = routed.limit.gather(-1, at[..., None])[..., 0]
        desired = torch.where(limit > 0, limit, world.scene["start"][:, :vehicles, 3].clamp(min=own.speed))
        line = _red_light(routed, state, world.step, 2 * own.braking) - length / 2 - LINE_GAP + own.standstill_gap
        driver = IDMParameters(own.headway, own.standstill_gap, own.acceleration, own.braking, own.exponent)
        follow = idm_acceleration(state.v, desired, gap.clamp(min=0.1), speed.clamp(min=0), driver, improved=True)
        halt = idm_acceleration(state.v, desired, line.clamp(min=0.1), torch.zeros_like(line), driver, improved=True)
        return torch.minimum(follow, halt)


def _red_light(routed: RoutedScene, state: LaneState, step: Tensor, brake: float) -> Tensor:
    """Metres [B, V] to the next stop line of a red or yellow light at which `brake` m/s^2 still halts; inf for none."""
    if not routed.light_state.shape[-1]:
        return torch.full_like(state.s, torch.inf)
    row = torch.arange(len(step), device=step.device)
    now = routed.light_state[row, step.clamp(max=routed.light_state.shape[1] - 1)]
    ahead = routed.light_s - state.s[..., None]
    colour = now[:, None].expand(-1, ahead.shape[1], -1).gather(-1, routed.light.clamp(min=0))
    stops = (routed.light >= 0) & ((colour == LIGHT_RED) | (colour == LIGHT_YELLOW)) & (ahead > 0)
    stops = stops & (state.v[..., None] ** 2 < 2 * brake * ahead)
    return ahead.masked_fill(~stops, torch.inf).amin(-1)


def _with_ego(state: LaneState, world: World, routed: RoutedScene) -> LaneState:
    """The lane states with the ego where it really is."""
    ego = slice(0, 1)
    accel = world.accel[:, ego]
    now = locate(world.states[:, ego], accel, torch.zeros_like(accel), routed.points[:, ego])
    return LaneState(**{name: torch.cat([getattr(now, name), value[:, 1:]], 1) for name, value in vars(state).items()})


def _held(motion: LaneState, state: LaneState, frozen: Tensor) -> LaneState:
    """The motion [B, V, HORIZON] with frozen [B, V] vehicles standing where they are."""
    still = state.map(lambda value: value[..., None].expand(*value.shape, HORIZON))
    zero = torch.zeros_like(still.v)
    still = replace(still, v=zero, a=zero)
    return LaneState(
        **{name: torch.where(frozen[..., None], getattr(still, name), value) for name, value in vars(motion).items()}
    )
