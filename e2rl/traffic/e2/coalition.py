"""Whom the attack controls, and what they aim at: coalitions in scenes (docs/method.md,
sections 5 to 8)."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.prior.lane_relative import KNOTS
from e2rl.prior.routes import take_route
from e2rl.run.settings import setting, settings_of
from e2rl.scenes.recording import DT
from e2rl.sim.world import World
from e2rl.traffic.decisions import LEADER, RULE, Decisions, eligible
from e2rl.traffic.e2.anchoring import Anchor, AnchorSettings, propose
from e2rl.traffic.e2.control import ControlSettings
from e2rl.traffic.e2.feasibility import FeasibilitySettings, feasible_vehicles
from e2rl.traffic.e2.interception import InterceptionSettings, Wish
from e2rl.traffic.e2.reasoner import LanguageReasoner, ReasonerSettings
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
from e2rl.traffic.grouping import no_vehicles, noise_of, put_rows, take_rows
from e2rl.traffic.nominal import NominalTraffic, PriorState, onto
from e2rl.traffic.responsibility import RESPONSIBILITIES, leading, place_of
from e2rl.traffic.traffic import FULL

SUPPORT, SCATTER = (
    750,
    850,
)  # numbers of the draws of a random support, and of the noise on costs
MIN_TEMPERATURE, MAX_ROUTE_NATS = (
    0.05,
    50.0,
)  # of the prior's choice of routes, where a new route is booked
SUPPORTS = ("feasible", "topology", "random")


@dataclass
class E2State(PriorState):
    """B attacked scenes.

    eta [B]: intensity; decided [B, D]: the decisions; near, far [B] int64: the most
    near and far agents of a coalition; coalition [B, V]: C*; target [B, V] int64: whom
    each member acts on (0 the ego, -1 none); off_lane [B, V]: on an interception
    instead of its lane; committed [B, V]: with a proposal, knots [B, V, KNOTS]: its
    accelerations [m/s^2]; drawn [B, V]: by a kernel; since [B, V] s: see `foresee`;
    settled [B, V]: once drawn to what the competent driver prevents; path_kl,
    anchor_jump [B, V]: path KL of the control and energy of the literal blend since the
    start.
    """

    eta: Tensor = no_vehicles()
    decided: Tensor = no_vehicles()
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

    @property
    def now(self) -> Decisions:
        """The decisions."""
        return Decisions(*self.decided.unbind(-1))


@dataclass(eq=False, repr=False)
class Coalitions(NominalTraffic):
    """The nominal prior with a coalition of adversaries and their proposals; `E2`
    drives them.

    support: whom the coalition is chosen from: feasible (S = S_top and F), topology
    (S_top alone) or random (as many as there are near agents), the ablations of table
    2. The groups of settings may be given as mappings.
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
    control: ControlSettings

    adversarial = True
    follows_template = follows_decisions = True

    def __post_init__(self) -> None:
        super().__post_init__()
        for part in fields(self):
            given = getattr(self, part.name)
            if isinstance(given, Mapping):
                setattr(
                    self,
                    part.name,
                    settings_of(
                        cast(type, part.type), given, where=f"synthesizer.{part.name}"
                    ),
                )
        rules = self.reasoner.kind == "rules"
        self.feasible_vehicles = (
            feasible_vehicles if rules else LanguageReasoner(self.reasoner)
        )

    def reset(
        self,
        scenes: TensorDictBase,
        seed: Tensor,
        eta: Tensor,
        template: Tensor | None = None,
        decisions: Tensor | None = None,
    ) -> E2State:
        """Returns states of scenes [B] with routes drawn from the prior and no vehicle
        under control.

        Args:
            template: [B] causal templates that limit the coalitions (None: full for
                all).
            decisions: [B, D] (None: by rule).
        """
        nominal = super().reset(scenes, seed, eta)
        near, far = limits_of(
            torch.full_like(nominal.seed, FULL) if template is None else template,
            self.skeleton,
        )
        decided = (
            eta.new_tensor(RULE).expand(len(eta), -1)
            if decisions is None
            else decisions
        )
        none = torch.zeros_like(nominal.routed.parked)
        zero = torch.zeros_like(nominal.routed.length)
        nobody = {
            name: none
            for name in ("coalition", "off_lane", "committed", "drawn", "settled")
        }
        nobody |= {"target": none.long() - 1, "since": zero - 1}
        costs = {"path_kl": zero, "anchor_jump": zero}
        knots = zero[..., None].repeat(1, 1, KNOTS)
        begun: dict[str, Any] = {**vars(nominal), **nobody, **costs}
        return E2State(
            **begun,
            eta=eta * decided[:, 0],
            decided=decided,
            near=near,
            far=far,
            knots=knots,
        )

    def _budget(self, state: E2State) -> Tensor | None:
        """Nats [B] that control may still add; None: any."""
        limit = self.control.transport_budget
        return None if limit is None else (limit - state.path_kl.sum(-1)).clamp(min=0)

    def _reselected(
        self, state: E2State, world: World, ego_plan: Tensor
    ) -> tuple[E2State, Anchor]:
        """States and anchors, with a new coalition in scenes whose choice is due and in
        which no member of the present coalition can meet its target any more."""
        due = state.replans == 0
        if self.reselect > 0:
            due = due | (state.replans % self.reselect == 0)
        anchor = self._anchor(state, world, ego_plan=ego_plan)
        rows = (due & (state.eta > 0) & ~anchor.feasible.any(1)).nonzero().squeeze(-1)
        if not len(rows):
            return state, anchor
        there = take_rows(world, rows)
        chosen = self._select(take_rows(state, rows), there, ego_plan=ego_plan[rows])
        found = self._anchor(
            chosen, replace(there, route=chosen.routed.route), ego_plan=ego_plan[rows]
        )
        return put_rows(state, rows, new=chosen), put_rows(anchor, rows, new=found)

    def _anchor(self, state: E2State, world: World, ego_plan: Tensor) -> Anchor:
        """Proposals for the present coalition on its present routes; whom the ego
        follows keeps its last one."""
        depth = chain_depth(state.target)
        if self.responsibility == "full":
            depth = depth.masked_fill(
                leading(world, depth.shape[1]) & (state.now.whom != LEADER)[:, None], 0
            )
        skeleton = Skeleton(
            state.coalition, state.target, depth=depth, near=depth == 1, far=depth > 1
        )
        anchor = self._propose(
            skeleton, state, world=world, ego_plan=ego_plan, keep_route=True
        )
        return (
            self._held(anchor, state, world=world)
            if self.responsibility == "full"
            else anchor
        )

    def _held(self, anchor: Anchor, state: E2State, world: World) -> Anchor:
        """The anchor in which members that can no longer meet the ego go on with their
        last proposal while they are ahead of it: they have come into its path by then.
        """
        ahead = place_of(world, state.coalition.shape[1])[0][..., 0] > 0
        hold = state.coalition & ~anchor.feasible & state.committed & ahead
        later = torch.cat([state.knots[..., 1:], state.knots[..., -1:]], -1)
        return replace(
            anchor,
            feasible=anchor.feasible | hold,
            knots=torch.where(hold[..., None], later, anchor.knots),
            route=torch.where(hold, state.routed.route, anchor.route),
            off_lane=torch.where(hold, state.off_lane, anchor.off_lane),
            off_lane_path=torch.where(
                hold[..., None, None], state.routed.points, anchor.off_lane_path
            ),
        )

    def _propose(
        self,
        skeleton: Skeleton,
        state: E2State,
        world: World,
        ego_plan: Tensor,
        keep_route: bool = False,
    ) -> Anchor:
        settings = (self.anchor, self.interception)
        lawful = self.responsibility == "full"
        now = state.now
        wish = Wish(state.eta, now.moment, wrong_way=now.wrong_way)
        return propose(
            world.scene, world, skeleton, ego_plan, *settings, wish, keep_route, lawful
        )

    def _select(self, state: E2State, world: World, ego_plan: Tensor) -> E2State:
        """Topology on a reference rollout, feasibility, skeleton; the coalition takes
        the routes that meet targets."""
        scene = world.scene
        vehicles = state.routed.route.shape[1]
        context = self.encode(state, world, ego_plan=ego_plan)
        nominal = self.prior.plan(self.prior.estimate(context), context)
        reference = torch.cat(
            [ego_plan[:, None], nominal.states()[:, 1:]], 1
        ).transpose(1, 2)
        valid = world.valid[:, None, :vehicles] & nominal.on_map.transpose(1, 2)
        found = topological_candidates(
            reference, valid, size=scene["size"][:, :vehicles], settings=self.topology
        )
        feasible = self.feasible_vehicles(scene, world, self.feasibility).mask
        steps = round(STEP / DT)
        expected = reference[:, steps - 1 :: steps].transpose(1, 2)
        support, fallback = self._support(
            state, world, candidates=found.candidates, feasible=feasible
        )
        may = eligible(world, state.now.whom, lawful=self.responsibility == "full")
        support = support & may
        fallback = fallback & may
        anchor = self._propose(
            direct(support | fallback), state, world=world, ego_plan=ego_plan
        )  # its cost chooses the near agents
        cost = anchor.cost + state.now.scatter[:, None] * noise_of(
            state.seed, SCATTER + state.replans, shape=(vehicles,)
        )
        limits = state.near, state.far
        skeleton = build_skeleton(
            scene,
            world,
            support=support,
            feasible=fallback,
            settings=self.skeleton,
            expected=expected,
            cost=cost,
            limits=limits,
        )
        if bool(
            skeleton.far.any()
        ):  # otherwise everybody meets the ego, as just proposed
            anchor = self._propose(skeleton, state, world=world, ego_plan=ego_plan)
        # Infeasible configurations are pruned (Sec. IV-A3): members without a proposal,
        # and whoever acts through them.
        members = skeleton.coalition & (state.eta > 0)[:, None]
        acts = members & anchor.feasible
        if (
            self.skeleton.pursuit
        ):  # where nobody can meet its target yet, V_adv alone brings them nearer
            acts = torch.where(acts.any(1, keepdim=True), acts, members)
        change = self._route_nats(scene, anchor.route) * (
            acts & (anchor.route != state.routed.route)
        )
        budget = self._budget(state)
        if (
            budget is not None
        ):  # who cannot afford its new route stays on the old one, and out of the coalition
            held = (change.sum(-1) <= budget)[:, None] | (change == 0)
            acts = acts & held
            change = change * held
        for _ in range(self.skeleton.max_chain - 1):
            acts = acts & (
                (skeleton.target <= 0) | acts.gather(1, skeleton.target.clamp(min=0))
            )
        target = torch.where(acts, skeleton.target, -1)
        state = replace(
            state, coalition=acts, target=target, path_kl=state.path_kl + change * acts
        )
        if self.on_decision:
            moments = (DT * (found.steps + 1)).expand(len(reference), -1)
            chosen = (found.candidates, feasible, state.coalition, state.target)
            at = reference[:, found.steps]
            self.on_decision(
                Selection(
                    state.seed,
                    world.step,
                    at,
                    moments,
                    found.weights,
                    *chosen,
                    self.topology,
                )
            )
        route = torch.where(acts, anchor.route, state.routed.route)
        return self._onto(
            state, world, route=route, off_lane=acts & False, paths=anchor.off_lane_path
        )

    def _route_nats(self, scene: TensorDictBase, route: Tensor) -> Tensor:
        """-log p of candidates route [B, V] under the prior's own choice of routes."""
        temperature = max(self.prior.sampler.route_temperature, MIN_TEMPERATURE)
        with torch.no_grad():
            log_p = torch.log_softmax(self.prior.route_choice(scene) / temperature, -1)
        return -take_route(log_p, route.clamp(min=0)).clamp(min=-MAX_ROUTE_NATS)

    def _support(
        self, state: E2State, world: World, candidates: Tensor, feasible: Tensor
    ) -> tuple[Tensor, Tensor]:
        """S [B, V] and who may take its place where it is empty, by `support` (Sec.
        IV-A2)."""
        if self.support == "random":
            there = world.valid[:, : feasible.shape[1]] & ~state.routed.parked
            there = there & (torch.arange(feasible.shape[1], device=there.device) > 0)
            draw = noise_of(
                state.seed,
                SUPPORT + state.replans,
                shape=tuple(feasible.shape[1:]),
                uniform=True,
            )
            rank = draw.masked_fill(~there, torch.inf).argsort(-1).argsort(-1)
            chosen = there & (rank < state.near[:, None])
            return chosen, chosen
        return (
            (candidates, candidates)
            if self.support == "topology"
            else (candidates & feasible, feasible)
        )

    def _onto(
        self,
        state: E2State,
        world: World,
        route: Tensor,
        off_lane: Tensor,
        paths: Tensor,
    ) -> E2State:
        """States with vehicles moved to candidates route [B, V], or, off_lane [B, V],
        to paths [B, V, P, 2], with their poses on them; a vehicle that was off its lane
        and no longer is returns to its route."""
        changed = (route != state.routed.route) | off_lane | state.off_lane
        if not bool(changed.any()):
            return state
        return replace(
            onto(
                state, world, route=route, moved=changed, off_lane=off_lane, paths=paths
            ),
            off_lane=off_lane,
        )
