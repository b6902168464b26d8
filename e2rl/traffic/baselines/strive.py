"""STRIVE (Rempe et al. 2022): the latents of a scenario are optimised until the
planner, driven again at every iteration, is hit; scenarios that no ego could survive
are discarded.

The prior as a decoder of latents: deterministic DDIM from pure noise, differentiable,
in few steps.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from e2rl.prior.lane_relative import LaneState
from e2rl.prior.prior import Context, Prior, plan_to_x
from e2rl.prior.sde import DDIM
from e2rl.run.settings import configured, setting
from e2rl.scenes.boxes import overlap, to_frame
from e2rl.scenes.recording import DT
from e2rl.traffic.baselines.losses import (
    disk_overlap,
    ego_distance,
    off_road_term,
    pair_term,
)
from e2rl.traffic.baselines.open_loop import OpenLoop, OpenLoopState, Scenario
from e2rl.traffic.baselines.view import View, motion_of
from e2rl.traffic.grouping import of_scenes, take_rows
from e2rl.traffic.nominal import Replan
from e2rl.traffic.potentials import SAMPLED_STEPS, STRIDE


def decode_latent(prior: Prior, latent: Tensor, context: Context, steps: int) -> Tensor:
    """Returns x0 [B, V, SIZE] of latents [B, V, SIZE], the noise at the highest level,
    in `steps` evaluations of it."""
    levels = prior.schedule.levels(steps, latent.device)
    x = latent
    zero = torch.zeros_like(levels[0])
    for high, low in zip(levels[:-2], levels[1:-1], strict=True):
        x = DDIM(prior.schedule, churn=0.0).step(
            x, prior.denoise(x, high, context), high, low, zero
        )[0]
    return prior.denoise(x, levels[-2], context)


FROM = 2.0  # s of the plan before which nobody is attacked
COLLISION = 20.0  # weight of overlaps and of being off the road
PRIOR = 1.0, 0.005  # weight of a latent's energy: of bystanders, of the attacker
START = 0.5, 0.05  # the same, of the distance to the first latent
SOLUTION = (
    10.0,
    0.005,
)  # weights of collisions and of the latent's energy in the test for a solution
CLEARANCE = 1.0  # m, below which a gap costs in that test
NOBODY = 1e4  # m: distance of vehicles that cannot be the attacker
Objective = Callable[[Tensor], Tensor]  # latents -> loss [B]


@configured("synthesizer/strive")
@dataclass(eq=False, repr=False)
class Strive(OpenLoop):
    """Latents of all vehicles by Adam, for all scenes of a batch at once; the whole
    scenario is driven open loop."""

    step_size: float = setting(low=0)
    iterations: int = setting(low=1)
    steps: int = setting(low=2)
    solution: bool = setting()

    tuned = {"gain": (0.4, 40.0, "log"), "step_size": (0.02, 1.0, "log")}

    def __post_init__(self) -> None:
        super().__post_init__()
        self.queries_ego = self.knowledge == "plan"

    def scenario(self, now: Replan, context: Context, nominal: Tensor) -> Scenario:
        """The optimised scenario, in which all vehicles are held; the nominal sample
        where it has no solution."""
        first = now.noise[0, :, :, 0].contiguous()
        acts = self.strength(now.state) > 0
        x0, view = self.attacked(first, now, context=context)
        motion = motion_of(self.prior, x0, context=context, count=1)
        weight = softmin(view.with_ego(motion), view).sum(-1)  # of each vehicle
        attacker = torch.nn.functional.one_hot(
            weight.argmax(-1), weight.shape[1]
        ).bool()
        holds = acts & (weight.sum(-1) > 0)
        if self.solution:
            holds = holds & self.solvable(first, motion, view=view, context=context)
        held, adversary = (
            rows & holds[:, None] & context.active
            for rows in (torch.ones_like(attacker), attacker)
        )
        x = torch.where(holds[:, None, None], x0, nominal)
        return Scenario(
            x, held, adversary=adversary, path_kl=torch.zeros_like(now.state.path_kl)
        )

    def attacked(
        self, first: Tensor, now: Replan, context: Context
    ) -> tuple[Tensor, View]:
        """x0 [B, V, SIZE] of optimised latents that begin at `first`, and the View with
        the ego as it last drove."""
        view, told = (
            View.of(now.world, context, ego_plan=now.ego_plan),
            context,
        )  # with the ego as it has driven last

        def decoded(latent: Tensor) -> Tensor:
            nonlocal view, told
            x0 = decode_latent(self.prior, latent, context=told, steps=self.steps)
            if now.react is not None:
                ego = now.react(self.prior.decode(x0.detach(), context).states())
                view = replace(view, ego=ego[:, SAMPLED_STEPS])
                told = replace(
                    context, ego_x=plan_to_x(ego, context.state, routed=context.routed)
                )
            return x0

        def loss(latent: Tensor) -> Tensor:
            motion = motion_of(self.prior, decoded(latent), context=told, count=1)
            return self.loss(motion, latent, first=first, state=now.state, view=view)

        latent = self.optimised(first, loss)
        with torch.no_grad():
            x0 = decoded(latent)
        return x0, view

    def optimised(self, latent: Tensor, loss: Objective) -> Tensor:
        """Latents after `iterations` steps of Adam."""
        with torch.enable_grad():
            variable = latent.detach().clone().requires_grad_(True)
            adam = torch.optim.Adam([variable], lr=self.step_size)
            for _ in range(self.iterations):
                (variable.grad,) = torch.autograd.grad(loss(variable).sum(), variable)
                adam.step()
        return variable.detach()

    def loss(
        self,
        motion: LaneState,
        latent: Tensor,
        first: Tensor,
        state: OpenLoopState,
        view: View,
    ) -> Tensor:
        """STRIVE's objective [B] of a decoded motion [1, B, V, T], with weights between
        bystander and attacker."""
        states = view.with_ego(motion)
        distance = ego_distance(states)[0]
        delta = softmin(states, view)
        attack = (delta * distance.square()).flatten(1).sum(-1)
        fraction = delta.sum(-1)
        even = torch.full_like(states[0, 0, 0, :, 0], 1 / states.shape[-2])
        with_ego = torch.zeros_like(view.routed.conflict)
        with_ego[:, :, 0] = True
        bumps = [
            pair_term(
                states,
                view,
                cost=disk_overlap(0.0),
                reach=0.0,
                weights=even,
                left_out=rows,
            )[0]
            for rows in (with_ego, ~with_ego)
        ]
        calm = COLLISION * (
            bumps[0]
            + (1 - fraction) * bumps[1]
            + off_road_term(states, view, weights=even)[0]
        )
        energy = blend(PRIOR, fraction) * 0.5 * latent.square().sum(-1)
        energy = energy + blend(START, fraction) * (latent - first).square().sum(-1)
        return self.strength(state) * attack + ((calm + energy) * view.active).sum(-1)

    def solvable(
        self, first: Tensor, planned: LaneState, view: View, context: Context
    ) -> Tensor:
        """Bool [B]: the ego has a motion that touches nobody in the others' motion [1,
        B, V, T]: that which it drives already, or one that an optimisation of its own
        latent finds."""
        others = planned.states()[0]
        solved = ~touched(view.ego[:, None], others, view)
        if not solved.all():
            rows = (~solved).nonzero()[:, 0]
            given = (
                first[rows],
                others[rows],
                take_rows(view, rows),
                of_scenes(context, rows),
            )
            solved[rows] = self.evaded(*given)
        return solved

    def evaded(
        self, first: Tensor, others: Tensor, view: View, context: Context
    ) -> Tensor:
        """Bool [B]: the ego's own latent, optimised against the others' states [B, V,
        T, 4], finds a motion that touches nobody."""
        unknown = replace(context, ego_x=None)
        view = replace(view, active=torch.zeros_like(view.active))
        view.active[:, 0] = True

        def driven(ego: Tensor) -> Tensor:
            latent = torch.cat([ego[:, None], first[:, 1:]], 1)
            return motion_of(
                self.prior,
                decode_latent(self.prior, latent, context=unknown, steps=self.steps),
                context=unknown,
                count=1,
            ).states()

        def loss(ego: Tensor) -> Tensor:
            states = torch.cat([driven(ego)[:, :, :1], others[None, :, 1:]], 2)
            even = torch.full_like(states[0, 0, 0, :, 0], 1 / states.shape[-2])
            bump = pair_term(
                states,
                view,
                cost=disk_overlap(CLEARANCE),
                reach=CLEARANCE,
                weights=even,
            ) + off_road_term(states, view, weights=even)
            return SOLUTION[0] * bump[0, :, 0] + SOLUTION[1] * 0.5 * ego.square().sum(
                -1
            )

        with torch.no_grad():
            return ~touched(
                driven(self.optimised(first[:, 0], loss))[0, :, :1], others, view
            )


def touched(ego: Tensor, others: Tensor, view: View) -> Tensor:
    """Bool [B]: the ego's states [B, 1, T, 4] overlap some of the others' [B, V, T, 4],
    whose row 0 does not count."""
    touches = overlap(
        ego,
        view.size[:, :1, None],
        second=others[:, 1:],
        second_size=view.size[:, 1:, None],
    ).any(-1)
    return (touches & view.valid[:, 1:]).any(-1)


def blend(weights: tuple[float, float], fraction: Tensor) -> Tensor:
    """Between the weight of a bystander (fraction 0) and that of the attacker (fraction
    1)."""
    return weights[0] + (weights[1] - weights[0]) * fraction


def softmin(states: Tensor, view: View) -> Tensor:
    """Weights [B, V, T], without gradient, that find attacker and moment: softmax of
    minus the distance to the ego over all of a scene, from FROM s on. Vehicles that are
    behind the ego throughout take no part; 0 without any."""
    with torch.no_grad():
        distance = ego_distance(states)[0]
        ahead = (to_frame(states[0, ..., :2], states[0, :, :1]) > 0)[..., 0]
        late = (
            STRIDE
            * DT
            * torch.arange(1, distance.shape[-1] + 1, device=distance.device)
            >= FROM - DT / 2
        )
        counts = (ahead.any(-1) & view.active)[..., None] & late
        weight = torch.softmax(
            -distance.masked_fill(~counts, NOBODY).flatten(1), -1
        ).view_as(distance)
        return weight * counts
