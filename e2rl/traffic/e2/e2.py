"""e2, the adversarial synthesizer: Algorithm 1's inner part for batches of scenes (docs/method.md, sections 5 to 9).

When a coalition is due: reference rollout, topology, feasibility, skeleton. At every replan: encode once, anchor, draw
kernels, sample under sparse control, choose among the samples. With eta = 0 nothing is controlled, and the traffic is
the prior's, bit for bit.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.prior.lane_relative import HORIZON, KNOTS, SIZE, locate, select
from e2rl.prior.prior import Context
from e2rl.prior.routes import reroute, take_route
from e2rl.run.settings import configured, setting, settings_of
from e2rl.scenes.recording import DT
from e2rl.sim.world import World
from e2rl.traffic.e2.anchoring import Anchor, AnchorSettings, propose
from e2rl.traffic.e2.control import ControlSettings, Pull, SparseControl
from e2rl.traffic.e2.feasibility import FeasibilitySettings, feasible_vehicles
from e2rl.traffic.e2.foresight import time_before
from e2rl.traffic.e2.interception import InterceptionSettings
from e2rl.traffic.e2.kernels import (
    DRAWN,
    Attack,
    Kernels,
    KernelSettings,
    best_try,
    choice_nats,
    propose_kernels,
    sideways,
    tries,
)
from e2rl.traffic.e2.potentials import PotentialContext, PotentialSettings
from e2rl.traffic.e2.reasoner import LanguageReasoner, ReasonerSettings
from e2rl.traffic.e2.responsibility import RESPONSIBILITIES, YieldingSettings, duty_of, leading, place_of
from e2rl.traffic.e2.skeleton import (
    STEP,
    Selection,
    Skeleton,
    SkeletonSettings,
    build_skeleton,
    chain_depth,
    direct,
    limits_of,
)
from e2rl.traffic.e2.topology import TopologySettings, topological_candidates
from e2rl.traffic.grouping import no_vehicles, noise_of, of_scenes, put_rows, take_rows
from e2rl.traffic.nominal import NominalTraffic, PriorState, React, Replan
from e2rl.traffic.traffic import FULL, TrafficPlan

LITERAL, SUPPORT = 500, 750  # numbers of draws: the literal blend's noise, a random support's
MIN_TEMPERATURE, MAX_ROUTE_NATS = 0.05, 50.0  # of the prior's choice of routes, where a new route is booked
SUPPORTS = ("feasible", "topology", "random")


@dataclass
class E2State(PriorState):
    """B attacked scenes.

    eta [B]; near, far [B] int64: the most near and far agents of a coalition; coalition [B, V]: C*; target [B, V]
    int64: whom each member acts on (0 the ego, -1 none); off_lane [B, V]: on an interception instead of its lane;
    committed [B, V]: with a proposal, knots [B, V, KNOTS]: its accelerations [m/s^2]; drawn [B, V]: by a kernel; since
    [B, V] s: see `foresee`; settled [B, V]: once drawn to what the competent driver prevents; path_kl, anchor_jump [B,
    V]: path KL of the control and energy of the literal blend since the start.
    """

    eta: Tensor = no_vehicles()
    near: Tensor = no_vehicles()
    far: Tensor = no_vehicles()
    coalition: Tensor
    target: Tensor
    off_lane: Tensor
    committed: Tensor
    knots: Tensor
    drawn: Tensor
    since: Tensor
    settled: Tensor
    path_kl: Tensor
    anchor_jump: Tensor


@configured("synthesizer/e2")
@dataclass(eq=False, repr=False)
class E2(NominalTraffic):
    """The guided reverse SDE with a sparse coalition, on a frozen prior. Settings: conf/synthesizer/e2.yaml.

    support: whom the coalition is chosen from: feasible (S = S_top and F), topology (S_top alone) or random (as many as
    there are near agents), the ablations of table 2. The groups of settings may be given as mappings.
    """

    responsibility: str = setting(choices=RESPONSIBILITIES)
    support: str = setting(choices=SUPPORTS)
    reselect: int = setting(low=0)
    topology: TopologySettings
    feasibility: FeasibilitySettings
    reasoner: ReasonerSettings
    skeleton: SkeletonSettings
    anchor: AnchorSettings
    interception: InterceptionSettings
    kernels: KernelSettings
    yielding: YieldingSettings
    potentials: PotentialSettings
    control: ControlSettings

    adversarial = True
    follows_template = True

    def __post_init__(self) -> None:
        super().__post_init__()
        for part in fields(self):
            given = getattr(self, part.name)
            if isinstance(given, Mapping):
                setattr(self, part.name, settings_of(cast(type, part.type), given, f"synthesizer.{part.name}"))
        rules = self.reasoner.kind == "rules"
        self.feasible_vehicles = feasible_vehicles if rules else LanguageReasoner(self.reasoner)

    @property
    def tuned(self) -> Mapping[str, tuple]:  # type: ignore[override]
        """e2 has no gain: eta multiplies the limits of its interceptions. Where V_adv acts, its clip is the gain."""
        lateral, clip = {"interception.lateral": (0.5, 4.0, "log")}, {"control.adversarial_clip": (0.05, 4.0, "log")}
        if self.skeleton.pursuit:
            return clip | {"potentials.distance": (1.0, 40.0, "log")}
        if self.control.adversarial_clip > 0:
            return clip | lateral
        return lateral | {"interception.push": (0.5, 3.0, "log")}

    def reset(self, scenes: TensorDictBase, seed: Tensor, eta: Tensor, template: Tensor | None = None) -> E2State:
        """Returns states of scenes [B] with routes drawn from the prior and nobody under control; template [B]: causal
        templates that limit the coalitions, None: full for all."""
        near, far = limits_of(torch.full_like(seed, FULL) if template is None else template, self.skeleton)
        nominal = super().reset(scenes, seed, eta)
        none, zero = torch.zeros_like(nominal.routed.parked), torch.zeros_like(nominal.routed.length)
        nobody = {name: none for name in ("coalition", "off_lane", "committed", "drawn", "settled")}
        nobody |= {"target": none.long() - 1, "since": zero - 1}
        costs = {"path_kl": zero, "anchor_jump": zero}
        knots = zero[..., None].repeat(1, 1, KNOTS)
        begun: dict[str, Any] = {**vars(nominal), **nobody, **costs}
        return E2State(**begun, eta=eta, near=near, far=far, knots=knots)

    def replan(
        self, state: E2State, world: World, ego_plan: Tensor, react: React | None = None
    ) -> tuple[E2State, TrafficPlan]:
        """Returns states and plans of the coming HORIZON steps."""
        state, plan = super().replan(state, world, ego_plan, react)
        costs = {"path_kl": state.path_kl, "anchor_jump": state.anchor_jump}
        target = torch.where(state.drawn & ~state.coalition, 0, state.target)
        return state, replace(plan, adversary=state.coalition | state.drawn, target=target, **costs)

    def replan_group(self, now: Replan) -> tuple[E2State, Tensor, Context]:
        """Returns state, guided joint sample x0 [G, V, SIZE] and context of a group."""
        state, ego_plan = now.state, now.ego_plan
        if not bool((state.eta > 0).any()) or self.control.transport_budget == 0:
            return super().replan_group(now)
        world = replace(now.world, route=state.routed.route)
        state, anchor = self._reselected(state, world, ego_plan)
        state, anchor = self._afforded(state, world, anchor)
        context = self.encode(state, world, ego_plan)
        anchored = anchor.feasible & state.coalition
        acts = anchored if self.control.anchoring != "off" else anchored & state.off_lane
        state = replace(state, committed=acts, knots=anchor.knots)
        if self.kernels.samples == 1:
            control = self._control(state, world, ego_plan, anchor)
            sample = self.prior.sample(context, now.noise, control, self._budget(state))
            x0, kl, jump = sample.x0, sample.kl, control.jump
        else:
            attack, kernels = self._kernels(state, world, ego_plan, context, acts)
            state, x0, kl, jump = self._best(state, attack, kernels, anchor, context, now.noise)
        members = state.coalition | state.drawn
        context.obstacles.duty = duty_of(self.responsibility, self.yielding, world, members, state.eta)
        return replace(state, path_kl=state.path_kl + kl, anchor_jump=state.anchor_jump + jump), x0, context

    def _budget(self, state: E2State) -> Tensor | None:
        """Nats [B] that control may still add; None: any."""
        limit = self.control.transport_budget
        return None if limit is None else (limit - state.path_kl.sum(-1)).clamp(min=0)

    def _afforded(self, state: E2State, world: World, anchor: Anchor) -> tuple[E2State, Anchor]:
        """States with the interceptions under way and their nats booked; those beyond the budget are off."""
        off_lane = anchor.off_lane & state.coalition & (state.eta > 0)[:, None]
        lane = take_route(world.scene["route_points"], state.routed.route.clamp(min=0))
        cost = sideways(anchor, world, state.lane, lane) * off_lane
        budget = self._budget(state)
        if budget is not None:
            held = (cost.sum(-1) <= budget)[:, None]
            anchor = replace(anchor, feasible=anchor.feasible & (held | ~off_lane))
            off_lane, cost = off_lane & held, cost * held
        state = replace(state, path_kl=state.path_kl + cost)
        return self._onto(state, world, state.routed.route, off_lane, anchor.off_lane_path), anchor

    def _kernels(
        self, state: E2State, world: World, ego_plan: Tensor, context: Context, acts: Tensor
    ) -> tuple[Attack, Kernels]:
        """The best kernels for vehicles that do not act [B, V] already, and what they are valued by."""
        mean = self.prior.estimate(context)
        plan = self.prior.decode(mean, context).states()
        more = state.coalition.sum(1) < state.near  # of the scene's template
        free = context.active & ~acts & (state.coalition | more[:, None]) & (state.eta > 0)[:, None]
        attack = Attack.of(world, free, ego_plan, plan, state.since, state.settled)
        gain, count = self.kernels.gain * state.eta, self.kernels.samples - 1
        return attack, propose_kernels(attack, state.lane, state.routed.points, mean, gain, count)

    def _best(
        self, state: E2State, attack: Attack, kernels: Kernels, anchor: Anchor, context: Context, noise: Tensor
    ) -> tuple[E2State, Tensor, Tensor, Tensor]:
        """State, x0, path KL and jump of the joint sample of highest value in each scene: a plain one, or one of those
        drawn to kernels, which has gain times its worth more and its path KL less.

        All of a scene have the same noise. What the choice costs is booked in row 0 (`choice_nats`). It favours noise
        that leads where the kernel does, so drawn vehicles pay log q/p of their path where that is more than its KL.
        """
        count = self.kernels.samples - 1
        rows = ((kernels.vehicle >= 0).any(1) & self._affords(state)).nonzero()[:, 0]
        many, goal, drawn = tries(kernels, rows)
        copies, context = take_rows(state, many), of_scenes(context, many)
        pull = Pull(goal, drawn, self.kernels.pull * copies.eta)
        given = take_rows(attack.world, many), attack.ego_plan[many], take_rows(anchor, many)
        control = self._control(copies, *given, pull)
        choice = choice_nats(rows, len(state.eta), count)
        budget = self._budget(copies)
        sample = self.prior.sample(context, noise[:, many], control, None if budget is None else budget - choice)
        kl = torch.where(drawn, torch.maximum(sample.kl, sample.log_ratio), sample.kl)
        kl = torch.cat([choice[:, None], kl[:, 1:]], 1)
        worth, prevented = self._worth(attack, context, sample.x0, many)
        value = self.kernels.gain * copies.eta * worth.amax(-1) - kl.sum(-1)
        if budget is not None:
            value = value.masked_fill(drawn.any(1) & (kl.sum(-1) > budget), -torch.inf)
        pick = best_try(value, rows, len(state.eta))
        settled = state.settled | (drawn & (worth > 0) & prevented)[pick]
        since = time_before(attack.world, attack.ego_plan, state.since)
        state = replace(state, drawn=drawn[pick], settled=settled, since=since)
        return state, sample.x0[pick], kl[pick], control.jump[pick]

    def _affords(self, state: E2State) -> Tensor:
        """Bool [B]: there are nats left to draw a sample to a kernel."""
        budget = self._budget(state)
        least = math.log((self.kernels.samples - 1) / DRAWN)
        return state.eta > 0 if budget is None else (state.eta > 0) & (budget > least)

    def _worth(self, attack: Attack, context: Context, x0: Tensor, many: Tensor) -> tuple[Tensor, Tensor]:
        """What `foresee` makes of samples x0 [C, V, SIZE] of scenes many [C]: worth and prevented [C, V]."""
        zero = torch.zeros_like(x0[..., 0])
        copy, pair = (attack.row == many[:, None]).nonzero(as_tuple=True)
        at = copy, attack.vehicle[pair]
        seen = attack.foresight(self.prior.decode(x0, context).states()[at][:, None], pair)
        return zero.index_put(at, seen.worth[:, 0]), zero.bool().index_put(at, seen.prevented[:, 0])

    def _reselected(self, state: E2State, world: World, ego_plan: Tensor) -> tuple[E2State, Anchor]:
        """States and anchors, with a new coalition in scenes whose choice is due and in which no member of the present
        coalition can meet its target any more."""
        due = state.replans == 0
        if self.reselect > 0:
            due = due | (state.replans % self.reselect == 0)
        anchor = self._anchor(state, world, ego_plan)
        rows = (due & (state.eta > 0) & ~anchor.feasible.any(1)).nonzero().squeeze(-1)
        if not len(rows):
            return state, anchor
        there = take_rows(world, rows)
        chosen = self._select(take_rows(state, rows), there, ego_plan[rows])
        found = self._anchor(chosen, replace(there, route=chosen.routed.route), ego_plan[rows])
        return put_rows(state, rows, chosen), put_rows(anchor, rows, found)

    def _anchor(self, state: E2State, world: World, ego_plan: Tensor) -> Anchor:
        """Proposals for the present coalition on its present routes; whom the ego follows keeps its last one."""
        depth = chain_depth(state.target)
        if self.responsibility == "full":
            depth = depth.masked_fill(leading(world, depth.shape[1]), 0)
        skeleton = Skeleton(state.coalition, state.target, depth, depth == 1, depth > 1)
        anchor = self._propose(skeleton, state, world, ego_plan, keep_route=True)
        return self._held(anchor, state, world) if self.responsibility == "full" else anchor

    def _held(self, anchor: Anchor, state: E2State, world: World) -> Anchor:
        """The anchor in which members that can no longer meet the ego go on with their last proposal while they are
        ahead of it: they have come into its path by then."""
        ahead = place_of(world, state.coalition.shape[1])[0][..., 0] > 0
        hold = state.coalition & ~anchor.feasible & state.committed & ahead
        later = torch.cat([state.knots[..., 1:], state.knots[..., -1:]], -1)
        return replace(
            anchor,
            feasible=anchor.feasible | hold,
            knots=torch.where(hold[..., None], later, anchor.knots),
            route=torch.where(hold, state.routed.route, anchor.route),
            off_lane=torch.where(hold, state.off_lane, anchor.off_lane),
            off_lane_path=torch.where(hold[..., None, None], state.routed.points, anchor.off_lane_path),
        )

    def _propose(
        self, skeleton: Skeleton, state: E2State, world: World, ego_plan: Tensor, keep_route: bool = False
    ) -> Anchor:
        settings, lawful = (self.anchor, self.interception), self.responsibility == "full"
        return propose(world.scene, world, skeleton, ego_plan, *settings, state.eta, keep_route, lawful)

    def _select(self, state: E2State, world: World, ego_plan: Tensor) -> E2State:
        """Topology on a reference rollout, feasibility, skeleton; the coalition takes the routes that meet targets."""
        scene, vehicles = world.scene, state.routed.route.shape[1]
        context = self.encode(state, world, ego_plan)
        nominal = self.prior.plan(self.prior.estimate(context), context)
        reference = torch.cat([ego_plan[:, None], nominal.states()[:, 1:]], 1).transpose(1, 2)
        valid = world.valid[:, None, :vehicles] & nominal.on_map.transpose(1, 2)
        found = topological_candidates(reference, valid, scene["size"][:, :vehicles], self.topology)
        feasible = self.feasible_vehicles(scene, world, self.feasibility).mask
        steps = round(STEP / DT)
        expected = reference[:, steps - 1 :: steps].transpose(1, 2)
        support, fallback = self._support(state, world, found.candidates, feasible)
        if self.responsibility == "full":  # planners know how to follow: leaders that brake hard find next to nothing
            support, fallback = (chosen & ~leading(world, vehicles) for chosen in (support, fallback))
        anchor = self._propose(direct(support | fallback), state, world, ego_plan)  # its cost chooses the near agents
        limits = state.near, state.far
        skeleton = build_skeleton(scene, world, support, fallback, self.skeleton, expected, anchor.cost, limits)
        if bool(skeleton.far.any()):  # otherwise everybody meets the ego, as just proposed
            anchor = self._propose(skeleton, state, world, ego_plan)
        # Infeasible configurations are pruned (Sec. IV-A3): members without a proposal, and whoever acts through them.
        members = skeleton.coalition & (state.eta > 0)[:, None]
        acts = members & anchor.feasible
        if self.skeleton.pursuit:  # where nobody can meet its target yet, V_adv alone brings them nearer
            acts = torch.where(acts.any(1, keepdim=True), acts, members)
        change = self._route_nats(scene, anchor.route) * (acts & (anchor.route != state.routed.route))
        budget = self._budget(state)
        if budget is not None:  # who cannot afford its new route stays on the old one, and out of the coalition
            held = (change.sum(-1) <= budget)[:, None] | (change == 0)
            acts, change = acts & held, change * held
        for _ in range(self.skeleton.max_chain - 1):
            acts = acts & ((skeleton.target <= 0) | acts.gather(1, skeleton.target.clamp(min=0)))
        target = torch.where(acts, skeleton.target, -1)
        state = replace(state, coalition=acts, target=target, path_kl=state.path_kl + change * acts)
        if self.on_decision:
            moments = (DT * (found.steps + 1)).expand(len(reference), -1)
            chosen = (found.candidates, feasible, state.coalition, state.target)
            at = reference[:, found.steps]
            self.on_decision(Selection(state.seed, world.step, at, moments, found.weights, *chosen, self.topology))
        route = torch.where(acts, anchor.route, state.routed.route)
        return self._onto(state, world, route, acts & False, anchor.off_lane_path)

    def _route_nats(self, scene: TensorDictBase, route: Tensor) -> Tensor:
        """-log p of candidates route [B, V] under the prior's own choice of routes."""
        temperature = max(self.prior.sampler.route_temperature, MIN_TEMPERATURE)
        with torch.no_grad():
            log_p = torch.log_softmax(self.prior.route_choice(scene) / temperature, -1)
        return -take_route(log_p, route.clamp(min=0)).clamp(min=-MAX_ROUTE_NATS)

    def _support(self, state: E2State, world: World, candidates: Tensor, feasible: Tensor) -> tuple[Tensor, Tensor]:
        """S [B, V] and who may take its place where it is empty, by `support` (Sec. IV-A2)."""
        if self.support == "random":
            there = world.valid[:, : feasible.shape[1]] & ~state.routed.parked
            there = there & (torch.arange(feasible.shape[1], device=there.device) > 0)
            draw = noise_of(state.seed, SUPPORT + state.replans, tuple(feasible.shape[1:]), uniform=True)
            rank = draw.masked_fill(~there, torch.inf).argsort(-1).argsort(-1)
            chosen = there & (rank < state.near[:, None])
            return chosen, chosen
        return (candidates, candidates) if self.support == "topology" else (candidates & feasible, feasible)

    def _onto(self, state: E2State, world: World, route: Tensor, off_lane: Tensor, paths: Tensor) -> E2State:
        """States with vehicles moved to candidates route [B, V], or, off_lane [B, V], to paths [B, V, P, 2], with their
        poses on them; a vehicle that was off its lane and no longer is returns to its route."""
        changed = (route != state.routed.route) | off_lane | state.off_lane
        if not bool(changed.any()):
            return state
        routed = reroute(state.routed, world.scene, route, changed, off_lane, paths)
        old = state.lane
        moved = locate(world.states[:, : route.shape[1]], old.a, old.kappa * old.v, routed.points)
        return replace(state, routed=routed, lane=select(changed, moved, old), off_lane=off_lane)

    def _control(
        self, state: E2State, world: World, ego_plan: Tensor, anchor: Anchor, kernel: Pull | None = None
    ) -> SparseControl:
        vehicles, routed = state.routed.route.shape[1], state.routed
        now = world.states[:, :vehicles], state.lane.a, world.valid[:, :vehicles]
        seen = PotentialContext(world.scene, *now, routed.points, routed.has_lane, ego_plan[:, :HORIZON], state.target)
        literal = noise_of(state.seed, LITERAL + state.replans, (*state.target.shape[1:], SIZE))
        given = self.prior, self.control, self.potentials, seen, state.coalition, state.eta
        return SparseControl(*given, anchor, self.anchor.strength, literal, kernel)
