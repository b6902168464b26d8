"""The frozen prior: routes, encoding, sampling and decoding of the joint future of a
scene's vehicles."""

from collections.abc import Callable
from dataclasses import dataclass, replace

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
    on_map,
    route_scene,
    sample_route,
    start_state,
)
from e2rl.prior.sde import Account, Estimates, Interval, SamplerSettings, fused_step
from e2rl.run.fused import fused
from e2rl.scenes.recording import DT
from e2rl.scenes.route import project
from e2rl.sim.leaders import Leaders
from e2rl.sim.world import World

# Fraction of a transport budget from which on it counts as used up.
BUDGET_SPENT = 0.999
EGO_LEVEL = 0.01  # noise level at which the network sees the ego's plan
# A vehicle slower than this (m/s) with a 5-s plan shorter than this (m) is held.
STANDING_SPEED = 0.5
HOLD_DISTANCE = 2.0


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


@dataclass(frozen=True)
class Denoising:
    """A step of the reverse process, as a control sees it: x [B, V, SIZE] at a noise
    level [], with k steps left, this one included."""

    prior: "Prior"
    x: Tensor
    level: Tensor
    k: int
    context: Context

    def clean(self, x: Tensor) -> Tensor:
        """The prior's clean estimate [B, V, SIZE] of x at this level."""
        return self.prior.denoise(x, self.level, self.context)


Controlled = tuple[Tensor, Tensor, Tensor]  # x, x0 before and x0 after control
Control = Callable[[Denoising], Controlled]  # e2rl/traffic/e2/control.py has one


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
        logits = self.route_choice(scene)
        chosen = sample_route(logits, self.sampler.route_temperature, uniform=uniform)
        return torch.cat([scene["route_log"][:, :1], chosen[:, 1:]], 1)

    @torch.no_grad()
    def start(
        self,
        scene: TensorDictBase,
        chosen: Tensor,
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
        world: World,
        *,
        ego_plan: Tensor | None = None,
        known: Context | None = None,
    ) -> Context:
        """The Context of a replan.

        Args:
            routed: the scenes with their routes.
            state: fields [B, V], the vehicles on these.
            world: everybody now.
            ego_plan: [B, HORIZON, 4] states of the ego ahead; None: unknown (open
                loop).
            known: a context of the same moment, which gives the leaders of scenes in
                which everybody is at the same place of the same route.
        """
        agents = world.states
        present = world.valid
        here = present[:, : state.s.shape[1]]
        if known is None:
            followed = leaders_ahead(
                routed,
                state.s,
                agents=agents,
                present=present,
            )
        else:
            followed = _leaders_anew(
                known,
                routed,
                s=state.s,
                world=world,
            )
        begins = world.step == 0
        nodes = node_features(routed, state, followed, world.step, begins)
        active = here & routed.modelled
        active[:, 0] = False
        return Context(
            routed=routed,
            state=state,
            followed=followed,
            encoding=self.denoiser.encode(nodes, edge_features(routed, state), here),
            ego_x=None if ego_plan is None else plan_to_x(ego_plan, state, routed),
            obstacles=Obstacles(agents, routed.size, present),
            active=active,
            all_on_lane=bool((routed.has_lane | ~here).all()),
        )

    def denoise(
        self,
        x: Tensor,
        level: Tensor,
        context: Context,
    ) -> Tensor:
        """x0 [B, V, SIZE] of x at a scalar noise level; a known plan of the ego
        replaces its row, nearly noise-free."""
        levels = level.repeat(1, x.shape[1])
        if context.ego_x is None:
            return self.denoiser(x, levels, context.encoding)
        ego = context.ego_x[:, None]
        levels[:, 0] = EGO_LEVEL
        x0 = self.denoiser(torch.cat([ego, x[:, 1:]], 1), levels, context.encoding)
        return torch.cat([ego, x0[:, 1:]], 1)

    @torch.no_grad()
    def estimate(self, context: Context) -> Tensor:
        """x0 [B, V, SIZE] at the highest noise level without noise (one NFE): nearly
        the mean of the samples."""
        x = torch.zeros(*context.state.v.shape, SIZE, device=context.state.v.device)
        return self.denoise(x, self.schedule.levels(1, x.device)[0], context)

    def decode(
        self,
        x0: Tensor,
        context: Context,
        *,
        cap: Tensor | None = None,
        steps: slice = slice(None),
    ) -> LaneState:
        """Planned motion, fields [B, V, HORIZON] or those `steps` of them.

        Args:
            x0: [B, V, SIZE].
            context: of the replan.
            cap: [B, V] m/s^2, of the acceleration in the executed part.
            steps: of the motion, all by default.
        """
        state = context.state
        points = context.routed.points
        has_lane = context.routed.has_lane
        if cap is not None:
            x0, state = apply_cap(cap, x0, state)
        whole = steps == slice(None)
        if whole and not context.all_on_lane:
            return free_space.decode_plans(x0, state, points, has_lane)
        if whole:
            return lane_relative.decode_plans(x0, state, points)
        lane = lane_relative.decode(x0, state, points, steps=steps)
        if context.all_on_lane:
            return lane
        free = free_space.decode(x0, state).map(lambda value: value[..., steps])
        return select(has_lane, lane, free)

    def sample(
        self,
        context: Context,
        noise: Tensor,
        control: Control | None = None,
        budget: Tensor | None = None,
    ) -> Sample:
        """One joint sample by the reverse SDE (eq. 1), from level `start` to 0.

        Args:
            context: of the replan.
            noise: [steps, B, V, SIZE], standard normal; the first slice starts the
                reverse SDE, the others drive it.
            control: moves the clean estimates; None: the nominal prior.
            budget: [B], path KL that control may add to a scene, all vehicles together
                (None: any). A step that would exceed it takes the fraction of its
                control that uses the budget up; no later step is controlled.
        """
        settings = self.sampler
        levels = settings.levels(self.schedule, noise.device)
        noise = settings.temperature * noise
        step = fused_step(settings, SIZE, limited=budget is not None)
        control = uncontrolled if control is None else control
        x = noise[0]
        before = levels[1]
        kl = log_ratio = torch.zeros(noise.shape[1:3], device=noise.device)
        allowed = kl.new_full(kl.shape[:1], torch.inf) if budget is None else budget
        past = None
        for index in range(settings.steps - 1):
            high = levels[index]
            k = settings.steps - index
            x, nominal, x0 = control(Denoising(self, x, high, k=k, context=context))
            clean = Estimates(x0, nominal)
            interval = Interval(before, high, levels[index + 1], noise[index + 1])
            account = Account(kl, log_ratio, allowed)
            x, x0, kl, log_ratio = step(x, clean, past or clean, interval, account)
            past = Estimates(x0, nominal)
            before = high
        # The last step takes x0 itself: without noise there is no KL to count.
        last = Denoising(self, x, levels[-2], k=1, context=context)
        _, nominal, x0 = control(last)
        if budget is not None:
            within = kl.sum(-1) < BUDGET_SPENT * budget
            x0 = torch.where(within[:, None, None], x0, nominal)
        return Sample(x0, kl, log_ratio)

    @torch.no_grad()
    def plan(self, x0: Tensor, context: Context) -> Plan:
        """The motion that is executed: decoded, `as_driven` and bounded; standing
        vehicles are held, routes end."""
        held = ~context.active
        held[:, 0] = False

        def capped(rows: Rows, cap: Tensor) -> LaneState:
            def alone(value: Tensor) -> Tensor:
                return value[rows][:, None]

            points = alone(context.routed.points)
            has_lane = alone(context.routed.has_lane)
            part = replace(
                context,
                routed=replace(
                    context.routed,
                    points=points,
                    has_lane=has_lane,
                ),
                state=context.state.map(alone),
            )
            motion = self._driven(
                alone(x0),
                part,
                held=alone(held),
                cap=cap[:, None],
            )
            return motion.map(lambda value: value[:, 0])

        motion = bounded(
            self.bounds,
            self._driven(x0, context, held=held),
            capped=capped,
            state=context.state,
            obstacles=context.obstacles,
        )
        return Plan(motion, on_map(context.routed, motion.s))

    def _driven(
        self,
        x0: Tensor,
        context: Context,
        *,
        held: Tensor,
        cap: Tensor | None = None,
    ) -> LaneState:
        """The motion of x0 `as_driven`, with vehicles `held` [B, V], and standing ones
        whose plan is too short for a start, held in place."""
        state = context.state
        motion = self.decode(x0, context, cap=cap)
        motion = as_driven(motion, state, on_lane=context.routed.has_lane)
        short = (motion.s[..., -1] - state.s) < HOLD_DISTANCE
        still = state.map(lambda value: value[..., None].expand(*value.shape, HORIZON))
        zero = torch.zeros_like(still.v)
        return select(
            ((state.v.abs() < STANDING_SPEED) & short) | held,
            replace(
                still,
                v=zero,
                a=zero,
            ),
            motion,
        )


@torch.no_grad()
def uncontrolled(step: Denoising) -> Controlled:
    """The Control of the nominal prior: none."""
    x0 = step.clean(step.x)
    return step.x, x0, x0


def _leaders_anew(
    known: Context,
    routed: RoutedScene,
    *,
    s: Tensor,
    world: World,
) -> Leaders:
    """`leaders_ahead`; of scenes in which nobody has moved, those of a known Context."""
    moved = s != known.state.s
    if routed.points is not known.routed.points:
        moved = moved | (routed.points != known.routed.points).flatten(2).any(-1)
    rows = moved.any(1).nonzero()[:, 0]
    if not len(rows):
        return known.followed
    part = replace(
        routed,
        points=routed.points[rows],
        size=routed.size[rows],
    )
    anew = leaders_ahead(
        part,
        s[rows],
        agents=world.states[rows],
        present=world.valid[rows],
    )
    pairs = zip(known.followed, anew, strict=True)
    return Leaders(*(old.index_copy(0, rows, new) for old, new in pairs))


def plan_to_x(plan: Tensor, state: LaneState, routed: RoutedScene) -> Tensor:
    """The ego's planned states [B, HORIZON, 4] as x [B, SIZE]: on its mission route, or
    in free space where the ego has no lane."""
    ego = state.map(lambda value: value[:, 0])
    return mission_x(plan, ego, routed.points[:, 0], routed.has_lane[:, :1])


@fused("B 50 4", "B", "B P 2!", "B 1:bool")
def mission_x(
    plan: Tensor,
    ego: LaneState,
    points: Tensor,
    on_lane: Tensor,
) -> Tensor:
    """`plan_to_x` of an ego on a route, or in free space.

    Args:
        plan: [B, HORIZON, 4] states.
        ego: fields [B], where the plan begins.
        points: [B, P, 2] m, its route.
        on_lane: [B, 1] bool, whether it has one.
    """
    v = plan[..., 3]
    before = torch.cat([ego.v[:, None], v[..., :-1]], 1)
    hint = ego.s[:, None] + ((v + before) / 2 * DT).cumsum(-1)
    s, d, _ = project(plan[..., :2], points, hint=hint)
    x, _ = lane_relative.fit(LaneState.from_states(plan, s, d), None, ego)
    knots = x[..., :KNOTS]
    lateral = free_space.fit(
        plan[..., 2],
        torch.ones_like(s),
        state=ego,
        knots=ACCEL_SCALE * knots,
    )
    return torch.where(on_lane, x, torch.cat([knots, lateral], -1))
