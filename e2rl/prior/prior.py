"""The frozen prior: routes, encoding, sampling and decoding of the joint future of a
scene's vehicles."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from e2rl.prior import free_space, lane_relative
from e2rl.prior.bounds import BoundSettings, Obstacles, Rows, apply_cap, bounded
from e2rl.prior.denoiser import Denoiser, DenoiserSettings, Encoding
from e2rl.prior.driving import as_driven
from e2rl.prior.features import edge_features, leaders_ahead, node_features
from e2rl.prior.lane_relative import (
    ACCEL_SCALE,
    HORIZON,
    KNOTS,
    SIZE,
    LaneState,
    select,
)
from e2rl.prior.routes import (
    RouteChoice,
    RoutedScene,
    route_scene,
    sample_route,
    start_state,
)
from e2rl.prior.sde import SamplerSettings, fused_controlled_step, fused_step
from e2rl.run.fused import fused
from e2rl.scenes.recording import DT
from e2rl.scenes.route import project
from e2rl.sim.leaders import Leaders

BUDGET_SPENT = (
    0.999  # fraction of a transport budget from which on it counts as used up
)
EGO_LEVEL = 0.01  # noise level at which the network sees the ego's plan
STANDING_SPEED, HOLD_DISTANCE = (
    0.5,
    2.0,
)  # m/s, m: a vehicle slower than this with a 5-s plan shorter than this is held


@dataclass
class Context:
    """What stays the same over the denoising steps of one replan of B scenes.

    state [B, V]; followed: the `leaders_ahead`; encoding: the network's; ego_x [B,
    SIZE]: the ego's plan as x, None where it is unknown and the ego is sampled like
    every vehicle; active [B, V]: simulated vehicles that are neither parked nor the
    ego; all_on_lane: no vehicle is in free space (asked once, on the host).
    """

    routed: RoutedScene
    state: LaneState
    followed: Leaders
    encoding: Encoding
    ego_x: Tensor | None
    obstacles: Obstacles
    active: Tensor
    all_on_lane: bool


@dataclass
class Sample:
    """x0 [B, V, SIZE]; kl [B, V]: path KL that control added; log_ratio [B, V]: of the
    drawn path's densities, control over prior."""

    x0: Tensor
    kl: Tensor
    log_ratio: Tensor


@dataclass
class Plan:
    """Planned motion (fields [B, V, HORIZON]) and on_map [B, V, HORIZON]: False once a
    vehicle's route has ended."""

    motion: LaneState
    on_map: Tensor

    def states(self) -> Tensor:
        """[B, V, HORIZON, 4]."""
        return self.motion.states()

    def after(self, steps: int) -> LaneState:
        """The lane states [B, V] once `steps` have been executed."""
        return self.motion.map(lambda value: value[..., steps - 1])


# (x, level, step k, context, denoise) -> (x, x0 before and x0 after control); see
# e2rl/traffic/e2/control.py.
Control = Callable[
    [Tensor, Tensor, int, Context, Callable[[Tensor], Tensor]],
    tuple[Tensor, Tensor, Tensor],
]


class Prior(nn.Module):
    """The distribution p0 over joint futures, frozen once trained.

    Without a control, `sample` is the reverse SDE (the nominal prior); with one, the
    inner loop of Algorithm 1.
    """

    def __init__(
        self,
        denoiser: DenoiserSettings | None = None,
        sampler: SamplerSettings | None = None,
        bounds: BoundSettings | None = None,
    ):
        super().__init__()
        self.denoiser = Denoiser(denoiser)
        self.route_choice = RouteChoice()
        self.sampler = sampler or SamplerSettings()
        self.bounds = bounds or BoundSettings()
        self.schedule = self.denoiser.schedule

    @torch.no_grad()
    def choose_routes(self, scene: TensorDictBase, uniform: Tensor) -> Tensor:
        """A route candidate [B, V] for each vehicle, drawn by uniform [B, V]; the ego's
        is its mission."""
        chosen = sample_route(
            self.route_choice(scene), self.sampler.route_temperature, uniform=uniform
        )
        return torch.cat([scene["route_log"][:, :1], chosen[:, 1:]], 1)

    @torch.no_grad()
    def start(
        self, scene: TensorDictBase, chosen: Tensor
    ) -> tuple[RoutedScene, LaneState]:
        """RoutedScene and start states of scenes [B] whose vehicles follow candidates
        chosen [B, V]."""
        routed = route_scene(scene, chosen)
        return routed, start_state(scene, routed)

    @torch.no_grad()
    def encode(
        self,
        routed: RoutedScene,
        state: LaneState,
        agents: Tensor,
        present: Tensor,
        step: Tensor,
        ego_plan: Tensor | None,
        known: Context | None = None,
    ) -> Context:
        """The Context of a replan.

        agents [B, N, 4], present [B, N]: every agent now; step [B]: simulated steps;
        ego_plan [B, HORIZON, 4]: states of the ego ahead, None (open loop) where
        unknown; known: a context of the same moment, which gives the leaders of scenes
        in which everybody is at the same place of the same route.
        """
        here = present[:, : state.s.shape[1]]
        followed = _leaders_ahead(
            routed, state.s, agents=agents, present=present, known=known
        )
        nodes = node_features(routed, state, followed, step, step == 0)
        encoding = self.denoiser.encode(nodes, edge_features(routed, state), here)
        obstacles = Obstacles(agents, routed.size, present=present)
        active = here & routed.modelled
        active = torch.cat([torch.zeros_like(active[:, :1]), active[:, 1:]], 1)
        ego_x = None if ego_plan is None else plan_to_x(ego_plan, state, routed=routed)
        all_on_lane = bool((routed.has_lane | ~here).all())
        return Context(
            routed,
            state,
            followed=followed,
            encoding=encoding,
            ego_x=ego_x,
            obstacles=obstacles,
            active=active,
            all_on_lane=all_on_lane,
        )

    def denoise(self, x: Tensor, level: Tensor, context: Context) -> Tensor:
        """x0 [B, V, SIZE] of x at a scalar noise level; a known plan of the ego
        replaces its row, nearly noise-free."""
        if context.ego_x is None:
            return self.denoiser(x, level.expand(1, x.shape[1]), context.encoding)
        x = torch.cat([context.ego_x[:, None], x[:, 1:]], 1)
        levels = level.repeat(1, x.shape[1])
        levels[:, 0] = EGO_LEVEL
        x0 = self.denoiser(x, levels, context.encoding)
        return torch.cat([context.ego_x[:, None], x0[:, 1:]], 1)

    @torch.no_grad()
    def estimate(self, context: Context) -> Tensor:
        """x0 [B, V, SIZE] at the highest noise level without noise (one NFE): nearly
        the mean of the samples."""
        x = torch.zeros(*context.state.v.shape, SIZE, device=context.state.v.device)
        return self.denoise(x, self.schedule.levels(1, x.device)[0], context=context)

    def decode(
        self,
        x0: Tensor,
        context: Context,
        cap: Tensor | None = None,
        steps: slice = slice(None),
    ) -> LaneState:
        """Planned motion of x0, fields [B, V, HORIZON] or those `steps` of it; cap [B,
        V]: of the acceleration in the executed part."""
        x0, state = apply_cap(cap, x0, state=context.state)
        if steps == slice(None) and not context.all_on_lane:
            return free_space.decode_plans(
                x0, state, context.routed.points, context.routed.has_lane
            )
        if steps == slice(None):
            lane = lane_relative.decode_plans(x0, state, context.routed.points)
        else:
            lane = lane_relative.decode(
                x0, state, points=context.routed.points, steps=steps
            )
        if context.all_on_lane:
            return lane
        return select(
            context.routed.has_lane,
            lane,
            other=free_space.decode(x0, state).map(lambda value: value[..., steps]),
        )

    def sample(
        self,
        context: Context,
        noise: Tensor,
        control: Control | None = None,
        budget: Tensor | None = None,
    ) -> Sample:
        """One joint sample by the reverse SDE, from level `start` to 0.

        Args:
            context: of the replan.
            noise: [steps, B, V, SIZE], standard normal; the first slice starts the
                reverse SDE, the others drive it.
            control: moves the clean estimates; None: the nominal prior.
            budget: [B], path KL that control may add to a scene, all vehicles together
                (None: any). A step that would
                exceed it takes the fraction of its control that uses the budget up; no later step is controlled.
        """
        settings = self.sampler
        levels = self.sampler.levels(self.schedule, noise.device)
        noise = settings.temperature * noise
        x = noise[0]
        past = None
        last = levels[1]
        kl = log_ratio = torch.zeros(noise.shape[1:3], device=noise.device)
        any_budget = kl.new_full(kl.shape[:1], torch.inf) if budget is None else budget
        for k in range(settings.steps, 0, -1):
            index = settings.steps - k
            high = levels[index]
            low = levels[index + 1]
            if control is None:
                with torch.no_grad():
                    x0 = nominal = self.denoise(x, high, context=context)
            else:
                x, nominal, x0 = control(
                    x,
                    high,
                    k,
                    context,
                    partial(self.denoise, level=high, context=context),
                )
            if k > 1:  # the last step takes x0 itself
                before = past or (x0, nominal)
                walk = (last, high, low, noise[index + 1])
                if control is None:
                    x = fused_step(settings, SIZE)(x, x0, before[0], *walk)
                else:
                    step = fused_controlled_step(
                        settings, SIZE, limited=budget is not None
                    )
                    x, x0, kl, log_ratio = step(
                        x, x0, nominal, *before, *walk, kl, log_ratio, any_budget
                    )
                past = (x0, nominal)
                last = high
            elif (
                budget is not None and control is not None
            ):  # without noise there is no KL to count
                x0 = torch.where(
                    (kl.sum(-1) < BUDGET_SPENT * budget)[:, None, None], x0, nominal
                )
        return Sample(x0, kl, log_ratio=log_ratio)

    @torch.no_grad()
    def plan(self, x0: Tensor, context: Context) -> Plan:
        """The motion that is executed: decoded, `as_driven` and bounded; standing
        vehicles are held, routes end."""
        held = ~context.active
        routed = context.routed
        state = context.state
        held[:, 0] = False

        def decode(rows: Rows | None, cap: Tensor | None) -> LaneState:
            if rows is None:
                motion = as_driven(
                    self.decode(x0, context), state, on_lane=routed.has_lane
                )
                return _held(motion, state, always=held)
            some = {
                name: getattr(routed, name)[rows][:, None]
                for name in ("points", "has_lane")
            }
            now = state.map(lambda value: value[rows][:, None])
            part = replace(context, routed=replace(routed, **some), state=now)
            assert cap is not None
            motion = as_driven(
                self.decode(x0[rows][:, None], part, cap=cap[:, None]),
                now,
                on_lane=part.routed.has_lane,
            )
            return _held(motion, now, always=held[rows][:, None]).map(
                lambda value: value[:, 0]
            )

        motion = bounded(self.bounds, decode, state=state, obstacles=context.obstacles)
        ended = (
            routed.open[..., None]
            & (motion.s >= routed.length[..., None])
            & routed.has_lane[..., None]
        )
        return Plan(motion, ~(ended.cumsum(-1) > 0))


def _held(motion: LaneState, state: LaneState, always: Tensor) -> LaneState:
    """The motion with vehicles `always` [B, V], and standing ones whose plan is too
    short for a start, held in place."""
    short = (motion.s[..., -1] - state.s) < HOLD_DISTANCE
    held = state.map(lambda value: value[..., None].expand(*value.shape, HORIZON))
    zero = torch.zeros_like(held.v)
    return select(
        ((state.v.abs() < STANDING_SPEED) & short) | always,
        replace(held, v=zero, a=zero),
        other=motion,
    )


def _leaders_ahead(
    routed: RoutedScene,
    s: Tensor,
    agents: Tensor,
    present: Tensor,
    known: Context | None,
) -> Leaders:
    """`leaders_ahead`, of scenes in which nobody has moved those of a Context."""
    if known is None:
        return leaders_ahead(routed, s, agents=agents, present=present)
    moved = s != known.state.s
    if routed.points is not known.routed.points:
        moved = moved | (routed.points != known.routed.points).flatten(2).any(-1)
    rows = moved.any(1).nonzero()[:, 0]
    if not len(rows):
        return known.followed
    there = replace(routed, points=routed.points[rows], size=routed.size[rows])
    new = leaders_ahead(there, s[rows], agents=agents[rows], present=present[rows])
    return Leaders(
        *(
            old.index_copy(0, rows, now)
            for old, now in zip(known.followed, new, strict=True)
        )
    )


def plan_to_x(plan: Tensor, state: LaneState, routed: RoutedScene) -> Tensor:
    """The ego's planned states [B, HORIZON, 4] as x [B, SIZE]: on its mission route, or
    in free space where the ego has no lane."""
    ego = state.map(lambda value: value[:, 0])
    return mission_x(plan, ego, routed.points[:, 0], routed.has_lane[:, :1])


@fused("B 50 4", "B", "B P 2!", "B 1:bool")
def mission_x(plan: Tensor, ego: LaneState, points: Tensor, on_lane: Tensor) -> Tensor:
    """`plan_to_x` of an ego on a route [B, P, 2], or, where it is not on_lane [B, 1],
    in free space."""
    before = torch.cat([ego.v[:, None], plan[..., :-1, 3]], 1)
    hint = ego.s[:, None] + ((plan[..., 3] + before) / 2 * DT).cumsum(-1)
    s, d, _ = project(plan[..., :2], points, hint=hint)
    x = lane_relative.fit(LaneState.from_states(plan, s, d=d), None, state=ego)[0]
    lateral = free_space.fit(
        plan[..., 2], torch.ones_like(s), state=ego, knots=ACCEL_SCALE * x[..., :KNOTS]
    )
    return torch.where(on_lane, x, torch.cat([x[..., :KNOTS], lateral], -1))
