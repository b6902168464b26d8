"""The frozen prior: routes, encoding, sampling and decoding of the joint future of a scene's vehicles."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import partial

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from e2rl.errors import InputError
from e2rl.prior import free_space, lane_relative
from e2rl.prior.bounds import BoundSettings, Surroundings, bounded, select, under
from e2rl.prior.denoiser import Denoiser, DenoiserSettings, Encoding
from e2rl.prior.features import edge_features, node_features
from e2rl.prior.lane_relative import HORIZON, LaneState, locate
from e2rl.prior.route_choice import RouteChoice, sample_route
from e2rl.prior.routed import RoutedScene, route_scene
from e2rl.prior.sde import SAMPLERS, NoiseSchedule, path_kl, reverse_step
from e2rl.scene.route import project

SPENT = 0.999  # share of a budget from which it counts as used up
CLEAN = 0.01  # noise level at which the ego's plan is shown to the network
STANDING, HOLD = 0.5, 2.0  # m/s, m: a standing vehicle whose 5-s plan is shorter than this is held


@dataclass(frozen=True)
class SamplerSettings:
    """sampler: ddim, dpm_solver_pp (DPM-Solver++ 2M) or euler_maruyama; churn of the first two (1 is the reverse SDE, 0
    deterministic); steps K; temperature of initial and injected noise; temperature of the route choice."""

    sampler: str = "ddim"
    steps: int = 8
    churn: float = 1.0
    temperature: float = 1.0
    route_temperature: float = 0.5

    def __post_init__(self):
        if self.sampler not in SAMPLERS:
            raise InputError(f"prior.sampler.sampler is {self.sampler!r}; choose one of {', '.join(SAMPLERS)}")
        if self.steps < 1 or not 0 <= self.churn <= 1:
            raise InputError(
                f"prior.sampler needs steps >= 1 and churn between 0 and 1; they are {self.steps} and {self.churn}"
            )
        for name in ("temperature", "route_temperature"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise InputError(f"prior.sampler.{name}={getattr(self, name)}: expected a number of at least 0")


@dataclass
class Context:
    """One replan of B scenes: routed, lane states [B, V], network encoding, the ego's plan as x [B, SIZE] (None where
    it is unknown and sampled like everybody else's), everybody around, who is active [B, V] (simulated now, not parked,
    not the ego), and whether every vehicle has a lane (asked once, on the host)."""

    routed: RoutedScene
    state: LaneState
    encoding: Encoding
    ego_x: Tensor | None
    around: Surroundings
    active: Tensor
    all_on_lane: bool


@dataclass
class Sample:
    """x0 [B, V, SIZE] and the discrete path KL [B, V] that control added."""

    x0: Tensor
    kl: Tensor


Control = Callable[[Tensor, Tensor, int, Context, Callable[[Tensor], Tensor]], tuple[Tensor, Tensor, Tensor]]


class Prior(nn.Module):
    """p0 over joint futures; frozen once trained.

    A control (Algorithm 1's inner loop) may be given to `sample`; without one the reverse SDE is the nominal prior.
    """

    def __init__(
        self,
        denoiser: DenoiserSettings | None = None,
        sampler: SamplerSettings | None = None,
        bounds: BoundSettings | None = None,
        free_space: bool = False,
    ):
        super().__init__()
        self.denoiser = Denoiser(denoiser or DenoiserSettings())
        self.route_choice = RouteChoice()
        self.sampler, self.bounds = sampler or SamplerSettings(), bounds or BoundSettings()
        self.free_space = free_space

    @property
    def schedule(self) -> NoiseSchedule:
        """The noise schedule (SDE) of the denoiser."""
        return self.denoiser.schedule

    @torch.no_grad()
    def choose_routes(self, scene: TensorDictBase, uniform: Tensor) -> Tensor:
        """A route candidate [B, V] for each vehicle, drawn by uniform [B, V]; the ego's is its mission."""
        chosen = sample_route(self.route_choice(scene), self.sampler.route_temperature, uniform)
        return torch.cat([scene["route_log"][:, :1], chosen[:, 1:]], 1)

    @torch.no_grad()
    def start(self, scene: TensorDictBase, chosen: Tensor) -> tuple[RoutedScene, LaneState]:
        """RoutedScene and start states of scenes [B] whose vehicles follow candidates chosen [B, V]."""
        routed = route_scene(scene, chosen, self.free_space)
        vehicles = chosen.shape[1]
        hint = torch.full(chosen.shape, 20.0, device=chosen.device)
        state = locate(
            scene["start"][:, :vehicles],
            scene["start_accel"][:, :vehicles],
            scene["start_yaw_rate"][:, :vehicles],
            routed.points,
            hint,
        )
        return routed, state

    @torch.no_grad()
    def encode(
        self,
        routed: RoutedScene,
        state: LaneState,
        agents: Tensor,
        present: Tensor,
        step: Tensor,
        ego_plan: Tensor | None,
        exempt: Tensor | None = None,
    ) -> Context:
        """Everything that stays the same over the denoising steps of a replan.

        agents [B, N, 4], present [B, N]: everybody now; step [B]: simulated steps; ego_plan [B, HORIZON, 4]: the ego's
        states ahead, None (open loop) where nobody knows them; exempt [B, V]: vehicles whose bounds ignore the ego.
        """
        vehicles = state.s.shape[1]
        here = present[:, :vehicles]
        encoding = self.denoiser.encode(
            node_features(routed, state, agents, present, step, step == 0), edge_features(routed, state), here
        )
        around = Surroundings(agents, routed.size, present, torch.zeros_like(here) if exempt is None else exempt)
        active = here & routed.modelled
        active = torch.cat([torch.zeros_like(active[:, :1]), active[:, 1:]], 1)
        ego_x = None if ego_plan is None else plan_to_x(ego_plan, state, routed)
        return Context(routed, state, encoding, ego_x, around, active, bool((routed.has_lane | ~here).all()))

    def denoise(self, x: Tensor, level: Tensor, context: Context) -> Tensor:
        """x0 [B, V, SIZE] of x at a scalar noise level; the ego's row is its plan, given clean, where that is known."""
        if context.ego_x is None:
            return self.denoiser(x, level.expand(1, x.shape[1]), context.encoding)
        x = torch.cat([context.ego_x[:, None], x[:, 1:]], 1)
        levels = level.repeat(1, x.shape[1])
        levels[:, 0] = CLEAN
        x0 = self.denoiser(x, levels, context.encoding)
        return torch.cat([context.ego_x[:, None], x0[:, 1:]], 1)

    def decode(self, x0: Tensor, context: Context, cap: Tensor | None = None, steps: slice = slice(None)) -> LaneState:
        """Planned motion, fields [B, V, HORIZON] (or those `steps` of it), of x0; cap [B, V]: of the acceleration in
        the executed part."""
        x0, state = under(cap, x0, context.state, self.bounds.onset)
        lane = lane_relative.decode(x0, state, context.routed.points, steps)
        if context.all_on_lane:
            return lane
        on_lane = context.routed.has_lane[..., None]
        free = free_space.decode(x0, state).map(lambda value: value[..., steps])
        return LaneState(
            *(torch.where(on_lane, getattr(lane, f.name), getattr(free, f.name)) for f in fields(LaneState))
        )

    def sample(
        self, context: Context, noise: Tensor, control: Control | None = None, budget: Tensor | None = None
    ) -> Sample:
        """One joint sample by the reverse SDE from level `start` to 0, with the steps of `sde.reverse_step`.

        noise [steps, B, V, SIZE]: standard normal, the first slice starts the reverse SDE, the others drive it.
        control(x, level, k, context, denoise) -> (x, x0 before, x0 after control); see e2rl/synthesizer/control.py.
        budget [B]: path KL that control may add to a scene, all vehicles together (None: any). A step that would
        exceed it moves by the share of its control that uses it up; none of the later ones is controlled.
        """
        settings = self.sampler
        levels = self.schedule.levels(settings.steps, noise.device)
        noise = settings.temperature * noise
        x, kl, past, nominal_past = noise[0], torch.zeros(noise.shape[1:3], device=noise.device), None, None
        for k in range(settings.steps, 0, -1):
            high, low = levels[settings.steps - k], levels[settings.steps - k + 1]
            if control is None:
                with torch.no_grad():
                    x0 = nominal = self.denoise(x, high, context)
            else:
                x, nominal, x0 = control(x, high, k, context, lambda y, t=high: self.denoise(y, t, context))
            if k > 1:  # the last step takes x0 itself
                step = partial(
                    reverse_step,
                    settings.sampler,
                    self.schedule,
                    x,
                    high=high,
                    low=low,
                    noise=noise[settings.steps - k + 1],
                    churn=settings.churn,
                )
                x, variance = step(x0=x0, past=past)
                if control is not None:  # against what the prior would do from the same visited states
                    plain = step(x0=nominal, past=nominal_past)[0]
                    added = path_kl(x - plain, variance * settings.temperature**2)
                    if budget is not None:
                        share = within(budget, kl, added)[:, None, None]
                        x, x0 = plain + share * (x - plain), nominal + share * (x0 - nominal)
                        added = share[..., 0] ** 2 * added
                    kl = kl + added
                past, nominal_past = (x0, high), (nominal, high)
            elif budget is not None and control is not None:  # without noise there is no KL to count
                x0 = torch.where((kl.sum(-1) < SPENT * budget)[:, None, None], x0, nominal)
        return Sample(x0, kl)

    @torch.no_grad()
    def plan(self, x0: Tensor, context: Context) -> "Plan":
        """The motion that is executed: decoded, bounded where it must be, standing vehicles held, routes ended."""
        routed = context.routed
        motion = bounded(
            self.bounds, lambda cap: self._held(self.decode(x0, context, cap), context), context.state, context.around
        )
        gone = routed.open[..., None] & (motion.s >= routed.length[..., None]) & routed.has_lane[..., None]
        return Plan(motion, ~(gone.cumsum(-1) > 0))

    def _held(self, motion: LaneState, context: Context) -> LaneState:
        """Standing vehicles whose plan is too short to be a start, and the parked, stay where they are."""
        state = context.state
        stays = ~context.active
        stays[:, 0] = False
        short = (motion.s[..., -1] - state.s) < HOLD
        still = state.map(lambda value: value[..., None].expand(*value.shape, HORIZON))
        zero = torch.zeros_like(still.v)
        still = LaneState(**{**vars(still), "v": zero, "a": zero})
        return select(((state.v < STANDING) & short) | stays, still, motion)


@dataclass
class Plan:
    """Planned motion (fields [B, V, HORIZON]) and on_map [B, V, HORIZON]: False once a vehicle's route has ended."""

    motion: LaneState
    on_map: Tensor

    def states(self) -> Tensor:
        """[B, V, HORIZON, 4]."""
        return self.motion.states()

    def after(self, steps: int) -> LaneState:
        """The lane states [B, V] once `steps` have been executed."""
        return self.motion.map(lambda value: value[..., steps - 1])


def within(budget: Tensor, spent: Tensor, added: Tensor) -> Tensor:
    """Share [B] of a step's shift that keeps path KL within the budget [B]: spent, added [B, V]; KL grows with the
    square of the shift."""
    left = (budget - spent.sum(-1)).clamp(min=0)
    return (left / added.sum(-1).clamp(min=1e-12)).clamp(max=1.0).sqrt()


def plan_to_x(plan: Tensor, state: LaneState, routed: RoutedScene) -> Tensor:
    """The ego's planned states [B, HORIZON, 4] as x [B, SIZE] on its mission route, or in free space where that is how
    it is represented."""
    ego = state.map(lambda value: value[:, 0])
    before = torch.cat([ego.v[:, None], plan[..., :-1, 3]], 1)
    hint = ego.s[:, None] + ((plan[..., 3] + before) / 2 * 0.1).cumsum(-1)
    s, d, _ = project(plan[..., :2], routed.points[:, 0], hint)
    zero = torch.zeros_like(s)
    track = LaneState(s, d, zero, zero, plan[..., 3], zero, plan[..., 0], plan[..., 1], plan[..., 2], zero)
    known = torch.ones_like(s)
    x = lane_relative.fit(track, known, ego)[0]
    bend = free_space.fit(plan[..., 2], known, ego, lane_relative.ACCEL_SCALE * x[..., : lane_relative.KNOTS])
    free = torch.cat([x[..., : lane_relative.KNOTS], bend], -1)
    return torch.where(routed.has_lane[:, :1], x, free)
