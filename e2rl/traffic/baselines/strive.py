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
from e2rl.prior.prior import Context, plan_to_x
from e2rl.prior.sde import DDIM
from e2rl.run.config import configured, setting
from e2rl.scenes.boxes import overlap, to_frame
from e2rl.scenes.recording import DT
from e2rl.traffic.baselines.losses import (
    ego_distance,
    even,
    off_road_term,
    overlap_term,
)
from e2rl.traffic.baselines.open_loop import OpenLoop, Scenario
from e2rl.traffic.baselines.view import View, motion_of
from e2rl.traffic.grouping import of_scenes, take_rows
from e2rl.traffic.nominal import Replan
from e2rl.traffic.potentials import SAMPLED_STEPS, STRIDE

FROM = 2.0  # s of the plan before which nobody is attacked
COLLISION = 20.0  # weight of overlaps and of being off the road
PRIOR = (1.0, 0.005)  # weight of a latent's energy: of bystanders, of the attacker
START = (0.5, 0.05)  # the same, of the distance to the first latent
SOLUTION_COLLISION = 10.0  # weight of collisions in the test for a solution
SOLUTION_PRIOR = 0.005  # weight of the latent's energy there
CLEARANCE = 1.0  # m, below which a gap costs there
NOBODY = 1e4  # m: distance of vehicles that cannot be the attacker


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

    def scenario(
        self,
        replan: Replan,
        context: Context,
        nominal: Tensor,
    ) -> Scenario:
        """The optimised scenario, in which all vehicles are held; the nominal sample
        where it has no solution."""
        first = replan.noise[0, :, :, 0].contiguous()
        x0, view = self.attacked(first, replan, context)
        motion = self.motion(x0, context)
        weight = softmin(view.with_ego(motion), view).sum(-1)  # of each vehicle
        holds = (view.strength > 0) & (weight.sum(-1) > 0)
        if self.solution:
            holds = holds & self.solvable(
                first,
                motion,
                view=view,
                context=context,
            )
        held = holds[:, None] & context.active
        vehicle = torch.arange(weight.shape[1], device=weight.device)
        return Scenario(
            torch.where(holds[:, None, None], x0, nominal),
            held,
            adversary=held & (vehicle == weight.argmax(-1)[:, None]),
            path_kl=torch.zeros_like(replan.state.path_kl),
        )

    def decode(self, latent: Tensor, context: Context) -> Tensor:
        """Returns x0 [B, V, SIZE] of latents [B, V, SIZE], the noise at the highest
        level, in `steps` evaluations of the prior."""
        prior = self.prior
        levels = prior.schedule.levels(self.steps, latent.device)
        ddim = DDIM(prior.schedule, churn=0.0)
        zero = torch.zeros_like(levels[0])
        x = latent
        for high, low in zip(levels[:-2], levels[1:-1], strict=True):
            x0 = prior.denoise(x, high, context)
            x = ddim.step(x, x0, high, low, zero)[0]
        return prior.denoise(x, levels[-2], context)

    def motion(self, x0: Tensor, context: Context) -> LaneState:
        """Planned motion of x0 [B, V, SIZE], fields [1, B, V, T]."""
        return motion_of(
            self.prior,
            x0,
            context=context,
            batch=len(x0),
        )

    def attacked(
        self,
        first: Tensor,
        replan: Replan,
        context: Context,
    ) -> tuple[Tensor, View]:
        """x0 [B, V, SIZE] of optimised latents that begin at `first`, and the View with
        the ego as it last drove."""
        view = View.of(replan, context, self.strength(replan.state))
        informed = context  # of how the ego has driven last

        def decoded(latent: Tensor) -> Tensor:
            nonlocal view, informed
            x0 = self.decode(latent, informed)
            if replan.react is not None:
                plan = self.prior.decode(x0.detach(), context).states()
                ego = replan.react(plan)
                view = replace(view, ego=ego[:, SAMPLED_STEPS])
                ego_x = plan_to_x(ego, context.state, routed=context.routed)
                informed = replace(context, ego_x=ego_x)
            return x0

        def loss(latent: Tensor) -> Tensor:
            motion = self.motion(decoded(latent), informed)
            return self.loss(
                motion,
                latent,
                first=first,
                view=view,
            )

        latent = self.optimised(first, loss)
        with torch.no_grad():
            x0 = decoded(latent)
        return x0, view

    def optimised(self, latent: Tensor, loss: Callable[[Tensor], Tensor]) -> Tensor:
        """Latents after `iterations` steps of Adam on a loss [B] of them."""
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
        *,
        first: Tensor,
        view: View,
    ) -> Tensor:
        """Returns STRIVE's objective [B], with weights between bystander and attacker.

        Args:
            motion: decoded, fields [1, B, V, T].
            latent: [B, V, SIZE], of the motion.
            first: [B, V, SIZE], the latent that the optimisation began with.
            view: of the scenes.
        """
        states = view.with_ego(motion)
        weight = softmin(states, view)
        attack = (weight * ego_distance(states)[0].square()).flatten(1).sum(-1)
        fraction = weight.sum(-1)  # of the attack, by vehicle
        with_ego = torch.zeros_like(view.routed.conflict)
        with_ego[:, :, 0] = True

        def bump(left_out: Tensor) -> Tensor:
            return overlap_term(
                states,
                view,
                margin=0.0,
                weights=even(states),
                left_out=left_out,
            )[0]

        bumps = bump(with_ego) + (1 - fraction) * bump(~with_ego)
        off_road = off_road_term(
            states,
            view,
            weights=even(states),
        )[0]
        calm = COLLISION * (bumps + off_road)
        energy = blend(PRIOR, fraction) * 0.5 * latent.square().sum(-1)
        moved = blend(START, fraction) * (latent - first).square().sum(-1)
        calm = calm + (energy + moved)
        return view.strength * attack + (calm * view.active).sum(-1)

    def solvable(
        self,
        first: Tensor,
        planned: LaneState,
        *,
        view: View,
        context: Context,
    ) -> Tensor:
        """Returns bool [B]: the ego has a motion that touches nobody: that which it
        drives already, or one that an optimisation of its own latent finds.

        Args:
            first: latents [B, V, SIZE], of which the ego's begins the optimisation.
            planned: motion of the others, fields [1, B, V, T].
            view: of the scenes.
            context: of the scenes.
        """
        others = planned.states()[0]
        solved = ~touched(view.ego[:, None], others, view)
        if not solved.all():
            rows = (~solved).nonzero()[:, 0]
            solved[rows] = self.evaded(
                first[rows],
                others[rows],
                view=take_rows(view, rows),
                context=of_scenes(context, rows),
            )
        return solved

    def evaded(
        self,
        first: Tensor,
        others: Tensor,
        *,
        view: View,
        context: Context,
    ) -> Tensor:
        """Returns bool [B]: the ego's own latent, optimised, finds a motion that
        touches nobody.

        Args:
            first: latents [B, V, SIZE].
            others: states [B, V, T, 4], whose row 0 does not count.
            view: of the scenes.
            context: of the scenes.
        """
        free = replace(context, ego_x=None)
        active = torch.zeros_like(view.active)
        active[:, 0] = True
        view = replace(view, active=active)

        def driven(ego: Tensor) -> Tensor:
            latent = torch.cat([ego[:, None], first[:, 1:]], 1)
            return self.motion(self.decode(latent, free), free).states()[:, :, :1]

        def loss(ego: Tensor) -> Tensor:
            states = torch.cat([driven(ego), others[None, :, 1:]], 2)
            weights = even(states)
            bump = overlap_term(
                states,
                view,
                margin=CLEARANCE,
                weights=weights,
            )
            bump = bump + off_road_term(states, view, weights=weights)
            energy = SOLUTION_PRIOR * 0.5 * ego.square().sum(-1)
            return SOLUTION_COLLISION * bump[0, :, 0] + energy

        with torch.no_grad():
            ego = driven(self.optimised(first[:, 0], loss))[0]
            return ~touched(ego, others, view)


def touched(
    ego: Tensor,
    others: Tensor,
    view: View,
) -> Tensor:
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


@torch.no_grad()
def softmin(states: Tensor, view: View) -> Tensor:
    """Weights [B, V, T], without gradient, that find attacker and moment: softmax of
    minus the distance to the ego over all of a scene, from FROM s on. Vehicles that are
    behind the ego throughout take no part; 0 without any."""
    distance = ego_distance(states)[0]
    ahead = to_frame(states[0, ..., :2], states[0, :, :1])[..., 0] > 0
    moment = torch.arange(1, distance.shape[-1] + 1, device=distance.device)
    late = STRIDE * DT * moment >= FROM - DT / 2
    counts = (ahead.any(-1) & view.active)[..., None] & late
    nearness = -distance.masked_fill(~counts, NOBODY)
    weight = torch.softmax(nearness.flatten(1), -1)
    return weight.view_as(distance) * counts
