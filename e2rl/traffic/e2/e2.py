"""e2, the adversarial synthesizer: Algorithm 1's inner part for batches of scenes
(docs/method.md, sections 5 to 9).

When a coalition is due: reference rollout, topology, feasibility, skeleton. At every
replan: encode once, anchor, draw kernels, sample under sparse control, choose among the
samples. With eta = 0 nothing is controlled, and the traffic is the prior's, bit for
bit.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from e2rl.prior.lane_relative import HORIZON, SIZE
from e2rl.prior.prior import Context
from e2rl.run.settings import configured
from e2rl.sim.world import World
from e2rl.traffic.decisions import ANY, eligible
from e2rl.traffic.e2.anchoring import Anchor
from e2rl.traffic.e2.coalition import Coalitions, E2State
from e2rl.traffic.e2.control import Pull, SparseControl
from e2rl.traffic.e2.foresight import time_before
from e2rl.traffic.e2.kernels import (
    DRAWN,
    KernelAttack,
    Kernels,
    KernelSettings,
    best_try,
    choice_nats,
    propose_kernels,
    sideways,
    tries,
)
from e2rl.traffic.grouping import noise_of, of_scenes, take_rows
from e2rl.traffic.nominal import React, Replan
from e2rl.traffic.potentials import PotentialContext, PotentialSettings
from e2rl.traffic.responsibility import YieldingSettings, duty_of
from e2rl.traffic.traffic import TrafficPlan

LITERAL = 500  # number of the draw of the literal blend's noise


@configured("synthesizer/e2")
@dataclass(eq=False, repr=False)
class E2(Coalitions):
    """The guided reverse SDE with a sparse coalition, on a frozen prior. Settings:
    conf/synthesizer/e2.yaml."""

    kernels: KernelSettings
    yielding: YieldingSettings
    potentials: PotentialSettings

    @property
    def tuned(self) -> Mapping[str, tuple]:  # type: ignore[override]
        """e2 has no gain: eta multiplies the limits of its interceptions. Where V_adv
        acts, its clip is the gain."""
        lateral = {"interception.lateral": (0.5, 4.0, "log")}
        clip = {"control.adversarial_clip": (0.05, 4.0, "log")}
        if self.skeleton.pursuit:
            return clip | {"potentials.distance": (1.0, 40.0, "log")}
        if self.control.adversarial_clip > 0:
            return clip | lateral
        return lateral | {"interception.push": (0.5, 3.0, "log")}

    def replan(
        self, state: E2State, world: World, ego_plan: Tensor, react: React | None = None
    ) -> tuple[E2State, TrafficPlan]:
        """Returns states and plans of the coming HORIZON steps."""
        state, plan = super().replan(state, world, ego_plan, react)
        costs = {"path_kl": state.path_kl, "anchor_jump": state.anchor_jump}
        target = torch.where(state.drawn & ~state.coalition, 0, state.target)
        return state, replace(
            plan, adversary=state.coalition | state.drawn, target=target, **costs
        )

    def replan_group(self, now: Replan) -> tuple[E2State, Tensor, Context]:
        """Returns state, guided joint sample x0 [G, V, SIZE] and context of a group."""
        state = now.state
        ego_plan = now.ego_plan
        if not bool((state.eta > 0).any()) or self.control.transport_budget == 0:
            return super().replan_group(now)
        world = replace(now.world, route=state.routed.route)
        state, anchor = self._reselected(state, world, ego_plan=ego_plan)
        state, anchor = self._afforded(state, world, anchor=anchor)
        context = self.encode(state, world, ego_plan=ego_plan, known=now.before)
        anchored = anchor.feasible & state.coalition
        acts = (
            anchored if self.control.anchoring != "off" else anchored & state.off_lane
        )
        state = replace(state, committed=acts, knots=anchor.knots)
        if self.kernels.samples == 1 or not bool(self._affords(state).any()):
            control = self._control(state, world, ego_plan=ego_plan, anchor=anchor)
            sample = self.prior.sample(context, now.noise, control, self._budget(state))
            x0 = sample.x0
            kl = sample.kl
            jump = control.jump
            state = replace(state, drawn=state.drawn & False)
        else:
            attack, kernels = self._kernels(
                state, world, ego_plan=ego_plan, context=context, acts=acts
            )
            state, x0, kl, jump = self._best(
                state,
                attack,
                kernels=kernels,
                anchor=anchor,
                context=context,
                noise=now.noise,
            )
        members = state.coalition | state.drawn
        decided = state.now
        given = (self.responsibility, self.yielding, world, members)
        context.obstacles.duty = duty_of(
            *given, state.eta, decided.patience, decided.owes >= 0.5
        )
        return (
            replace(
                state, path_kl=state.path_kl + kl, anchor_jump=state.anchor_jump + jump
            ),
            x0,
            context,
        )

    def _afforded(
        self, state: E2State, world: World, anchor: Anchor
    ) -> tuple[E2State, Anchor]:
        """States with the interceptions under way and their nats booked; those beyond
        the budget are off."""
        off_lane = anchor.off_lane & state.coalition & (state.eta > 0)[:, None]
        cost = sideways(
            anchor, world, lane=state.lane, route=state.routed.route, off_lane=off_lane
        )
        budget = self._budget(state)
        if budget is not None:
            held = (cost.sum(-1) <= budget)[:, None]
            anchor = replace(anchor, feasible=anchor.feasible & (held | ~off_lane))
            off_lane = off_lane & held
            cost = cost * held
        state = replace(state, path_kl=state.path_kl + cost)
        return self._onto(
            state,
            world,
            route=state.routed.route,
            off_lane=off_lane,
            paths=anchor.off_lane_path,
        ), anchor

    def _kernels(
        self,
        state: E2State,
        world: World,
        ego_plan: Tensor,
        context: Context,
        acts: Tensor,
    ) -> tuple[KernelAttack, Kernels]:
        """The best kernels for vehicles that do not act [B, V] already, and what they
        are valued by."""
        mean = self.prior.estimate(context)
        plan = self.prior.decode(mean, context).states()
        more = state.coalition.sum(1) < state.near  # of the scene's template
        free = (
            context.active
            & ~acts
            & (state.coalition | more[:, None])
            & (state.eta > 0)[:, None]
        )
        free &= (
            eligible(world, state.now.whom, lawful=False)
            | (state.now.whom == ANY)[:, None]
        )
        attack = KernelAttack.of(
            world,
            free,
            ego_plan=ego_plan,
            plan=plan,
            since=state.since,
            settled=state.settled,
        )
        gain = self.kernels.gain * state.eta
        count = self.kernels.samples - 1
        return attack, propose_kernels(
            attack,
            state.lane,
            points=state.routed.points,
            mean=mean,
            gain=gain,
            count=count,
        )

    def _best(
        self,
        state: E2State,
        attack: KernelAttack,
        kernels: Kernels,
        anchor: Anchor,
        context: Context,
        noise: Tensor,
    ) -> tuple[E2State, Tensor, Tensor, Tensor]:
        """State, x0, path KL and jump of the joint sample of highest value in each
        scene: a plain one, or one of those drawn to kernels, which has gain times its
        worth more and its path KL less.

        All of a scene have the same noise. What the choice costs is booked in row 0
        (`choice_nats`). It favours noise that leads where the kernel does, so drawn
        vehicles pay log q/p of their path where that is more than its KL.
        """
        count = self.kernels.samples - 1
        rows = ((kernels.vehicle >= 0).any(1) & self._affords(state)).nonzero()[:, 0]
        many, goal, drawn = tries(kernels, rows)
        copies = take_rows(state, many)
        context = of_scenes(context, many)
        pull = Pull(goal, drawn, strength=self.kernels.pull * copies.eta)
        given = (
            take_rows(attack.world, many),
            attack.ego_plan[many],
            take_rows(anchor, many),
        )
        control = self._control(copies, *given, pull)
        choice = choice_nats(rows, len(state.eta), count=count)
        budget = self._budget(copies)
        sample = self.prior.sample(
            context,
            noise[:, many],
            control,
            None if budget is None else budget - choice,
        )
        kl = torch.where(drawn, torch.maximum(sample.kl, sample.log_ratio), sample.kl)
        kl = torch.cat([choice[:, None], kl[:, 1:]], 1)
        worth, prevented = self._worth(attack, context, x0=sample.x0, many=many)
        value = self.kernels.gain * copies.eta * worth.amax(-1) - kl.sum(-1)
        if budget is not None:
            value = value.masked_fill(drawn.any(1) & (kl.sum(-1) > budget), -torch.inf)
        pick = best_try(value, rows, batch=len(state.eta))
        settled = state.settled | (drawn & (worth > 0) & prevented)[pick]
        since = time_before(attack.world, attack.ego_plan, since=state.since)
        state = replace(state, drawn=drawn[pick], settled=settled, since=since)
        return state, sample.x0[pick], kl[pick], control.jump[pick]

    def _affords(self, state: E2State) -> Tensor:
        """Bool [B]: there are nats left to draw a sample to a kernel."""
        budget = self._budget(state)
        least = math.log((self.kernels.samples - 1) / DRAWN)
        return state.eta > 0 if budget is None else (state.eta > 0) & (budget > least)

    def _worth(
        self, attack: KernelAttack, context: Context, x0: Tensor, many: Tensor
    ) -> tuple[Tensor, Tensor]:
        """What `foresee` makes of samples x0 [C, V, SIZE] of scenes many [C]: worth and
        prevented [C, V]."""
        zero = torch.zeros_like(x0[..., 0])
        copy, pair = (attack.row == many[:, None]).nonzero(as_tuple=True)
        at = copy, attack.vehicle[pair]
        seen = attack.foresight(
            self.prior.decode(x0, context).states()[at][:, None], pair
        )
        return zero.index_put(at, seen.worth[:, 0]), zero.bool().index_put(
            at, seen.prevented[:, 0]
        )

    def _control(
        self,
        state: E2State,
        world: World,
        ego_plan: Tensor,
        anchor: Anchor,
        kernel: Pull | None = None,
    ) -> SparseControl:
        vehicles = state.routed.route.shape[1]
        routed = state.routed
        now = world.states[:, :vehicles], state.lane.a, world.valid[:, :vehicles]
        seen = PotentialContext(
            world.scene,
            *now,
            routed.points,
            routed.has_lane,
            ego_plan[:, :HORIZON],
            state.target,
        )
        literal = noise_of(
            state.seed, LITERAL + state.replans, shape=(*state.target.shape[1:], SIZE)
        )
        given = (
            self.prior,
            self.control,
            self.potentials,
            seen,
            state.coalition,
            state.eta,
        )
        return SparseControl(*given, anchor, self.anchor.strength, literal, kernel)
