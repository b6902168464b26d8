"""Select and propose: whom the attack controls, whom each acts on, and how it would get
there (Sec. IV-A; docs/reference).

topology -> feasibility -> skeleton -> proposals. A coalition is kept while one of its
members can still meet its target, and chosen anew where none can.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.prior.prior import Plan, Prior
from e2rl.prior.routes import take_route
from e2rl.scenes.recording import DT
from e2rl.sim.world import World
from e2rl.traffic.decisions import LEADER, eligible
from e2rl.traffic.e2.anchoring import Anchor, AnchorSettings, propose
from e2rl.traffic.e2.feasibility import Feasibility, FeasibilitySettings
from e2rl.traffic.e2.interception import InterceptionSettings, Wish
from e2rl.traffic.e2.skeleton import (
    STEP,
    Skeleton,
    SkeletonSettings,
    build_skeleton,
    chain_depth,
    direct,
)
from e2rl.traffic.e2.state import E2State
from e2rl.traffic.e2.topology import TopologySettings, topological_candidates
from e2rl.traffic.grouping import noise_of, put_rows, take_rows
from e2rl.traffic.nominal import onto
from e2rl.traffic.responsibility import leading, place_of

# Numbers of the draws of a random support, and of the noise on costs.
SUPPORT_DRAW = 750
SCATTER_DRAW = 850
# Of the prior's choice of routes, where the nats of a new route are booked.
MIN_TEMPERATURE = 0.05
MAX_ROUTE_NATS = 50.0
SUPPORTS = ("feasible", "topology", "random")
Reference = Callable[[E2State, World, Tensor], Plan]  # state, world, ego_plan


@dataclass
class Selector:
    """Chooses coalitions and makes their proposals.

    lawful: members owe the ego full duty; support: whom a coalition is chosen from:
    feasible (S = S_top and F), topology (S_top alone) or random (as many as there are
    near agents), the ablations of table 2; reselect: replans between two choices, 0:
    one choice; feasible_vehicles: the rules of feasibility.py or a language model;
    budget: nats a rollout, None: any.
    """

    prior: Prior
    lawful: bool
    support: str
    reselect: int
    topology: TopologySettings
    feasibility: FeasibilitySettings
    feasible_vehicles: Callable[
        [TensorDictBase, World, FeasibilitySettings], Feasibility
    ]
    skeleton: SkeletonSettings
    anchor: AnchorSettings
    interception: InterceptionSettings
    budget: float | None

    def select(
        self,
        state: E2State,
        world: World,
        ego_plan: Tensor,
        reference: Reference,
    ) -> tuple[E2State, Anchor]:
        """Returns states and proposals, with a new coalition in scenes whose choice is
        due and in which no member of the present one can meet its target any more.

        Args:
            state: of B scenes.
            world: the scenes now.
            ego_plan: [B, >= HORIZON, 4], the ego's expected states.
            reference: the prior's plan without control.
        """
        due = state.replans == 0
        if self.reselect > 0:
            due = due | (state.replans % self.reselect == 0)
        anchor = self._anchor(state, world, ego_plan)
        chosen_anew = due & state.attacked & ~anchor.feasible.any(1)
        rows = chosen_anew.nonzero()[:, 0]
        if not len(rows):
            return state, anchor
        world = take_rows(world, rows)
        ego_plan = ego_plan[rows]
        chosen = self._choose(take_rows(state, rows), world, ego_plan, reference)
        world = replace(world, route=chosen.routed.route)
        proposals = self._anchor(chosen, world, ego_plan)
        return put_rows(state, rows, chosen), put_rows(anchor, rows, proposals)

    def _anchor(self, state: E2State, world: World, ego_plan: Tensor) -> Anchor:
        """Proposals of the present coalition on its present routes."""
        depth = chain_depth(state.target)
        if self.lawful:  # whom the ego follows keeps its last proposal
            followed = leading(world, depth.shape[1])
            by_rule = (state.decisions.whom != LEADER)[:, None]
            depth = depth.masked_fill(followed & by_rule, 0)
        skeleton = Skeleton(
            state.coalition,
            state.target,
            depth=depth,
            near=depth == 1,
            far=depth > 1,
        )
        anchor = self._propose(skeleton, state, world, ego_plan, keep_route=True)
        return self._held(anchor, state, world) if self.lawful else anchor

    def _held(self, anchor: Anchor, state: E2State, world: World) -> Anchor:
        """The anchor in which members that can no longer meet the ego go on with their
        last proposal while they are ahead of it: they have come into its path by then.
        """
        ahead = place_of(world, state.coalition.shape[1])[0][..., 0] > 0
        held = state.coalition & ~anchor.feasible & state.committed & ahead
        later = torch.cat([state.knots[..., 1:], state.knots[..., -1:]], -1)
        present = state.routed
        return replace(
            anchor,
            feasible=anchor.feasible | held,
            knots=torch.where(held[..., None], later, anchor.knots),
            route=torch.where(held, present.route, anchor.route),
            off_lane=torch.where(held, state.off_lane, anchor.off_lane),
            off_lane_path=torch.where(
                held[..., None, None],
                present.points,
                anchor.off_lane_path,
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
        decisions = state.decisions
        return propose(
            world,
            skeleton,
            ego_plan=ego_plan,
            settings=self.anchor,
            interception=self.interception,
            wish=Wish(state.eta, decisions.moment, wrong_way=decisions.wrong_way),
            keep_route=keep_route,
            halt_at_red=self.lawful,
        )

    def _choose(
        self,
        state: E2State,
        world: World,
        ego_plan: Tensor,
        reference: Reference,
    ) -> E2State:
        """States with new coalitions by topology on a reference rollout, feasibility and
        skeleton; members take the routes that meet their targets."""
        scene = world.scene
        vehicles = state.routed.route.shape[1]
        nominal = reference(state, world, ego_plan)
        expected = torch.cat([ego_plan[:, None], nominal.states()[:, 1:]], 1)
        valid = world.valid[:, None, :vehicles] & nominal.on_map.transpose(1, 2)
        topology = topological_candidates(
            expected.transpose(1, 2),
            valid,
            size=scene["size"][:, :vehicles],
            settings=self.topology,
        )
        feasible = self.feasible_vehicles(scene, world, self.feasibility).mask
        support, fallback = self._support(
            state,
            world,
            candidates=topology.candidates,
            feasible=feasible,
        )
        may_act = eligible(world, state.decisions.whom, lawful=self.lawful)
        skeleton, anchor = self._skeleton(
            state,
            world,
            ego_plan,
            expected,
            support & may_act,
            fallback & may_act,
        )
        members, nats = self._members(state, scene, skeleton, anchor)
        state = replace(
            state,
            coalition=members,
            target=torch.where(members, skeleton.target, -1),
            path_kl=state.path_kl + nats * members,
        )
        route = torch.where(members, anchor.route, state.routed.route)
        nobody = torch.zeros_like(members)
        return on_paths(
            state,
            world,
            route=route,
            off_lane=nobody,
            paths=anchor.off_lane_path,
        )

    def _support(
        self,
        state: E2State,
        world: World,
        candidates: Tensor,
        feasible: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """S [B, V] and who may take its place where it is empty, by `support` (Sec.
        IV-A2)."""
        if self.support == "topology":
            return candidates, candidates
        if self.support == "feasible":
            return candidates & feasible, feasible
        vehicles = feasible.shape[1]
        present = world.valid[:, :vehicles] & ~state.routed.parked
        present = present & (torch.arange(vehicles, device=present.device) > 0)
        number = SUPPORT_DRAW + state.replans
        draw = noise_of(state.seed, number, shape=(vehicles,), uniform=True)
        rank = draw.masked_fill(~present, torch.inf).argsort(-1).argsort(-1)
        random = present & (rank < self.skeleton.near)
        return random, random

    def _skeleton(
        self,
        state: E2State,
        world: World,
        ego_plan: Tensor,
        expected: Tensor,
        support: Tensor,
        fallback: Tensor,
    ) -> tuple[Skeleton, Anchor]:
        """The skeleton of a support [B, V], and its proposals. What it costs each
        vehicle to meet the ego chooses the near agents."""
        vehicles = support.shape[1]
        anchor = self._propose(direct(support | fallback), state, world, ego_plan)
        number = SCATTER_DRAW + state.replans
        noise = noise_of(state.seed, number, shape=(vehicles,))
        steps = round(STEP / DT)
        skeleton = build_skeleton(
            world,
            support=support,
            feasible=fallback,
            settings=self.skeleton,
            expected=expected[:, :, steps - 1 :: steps],
            cost=anchor.cost + state.decisions.scatter[:, None] * noise,
        )
        # Without a far agent everybody meets the ego, as was just proposed.
        if bool(skeleton.far.any()):
            anchor = self._propose(skeleton, state, world, ego_plan)
        return skeleton, anchor

    def _members(
        self,
        state: E2State,
        scene: TensorDictBase,
        skeleton: Skeleton,
        anchor: Anchor,
    ) -> tuple[Tensor, Tensor]:
        """Who of C* takes part [B, V], and the nats [B, V] of their new routes.

        Infeasible configurations are pruned (Sec. IV-A3): members without a proposal,
        members that cannot afford their new route, and whoever acts through them.
        """
        candidates = skeleton.coalition & state.attacked[:, None]
        members = candidates & anchor.feasible
        if self.skeleton.pursuit:
            # Where nobody can meet its target yet, V_adv alone brings them nearer.
            members = torch.where(members.any(1, keepdim=True), members, candidates)
        changed = members & (anchor.route != state.routed.route)
        nats = self._route_nats(scene, anchor.route) * changed
        left = state.nats_left(self.budget)
        if left is not None:
            affordable = (nats.sum(-1) <= left)[:, None] | (nats == 0)
            members = members & affordable
            nats = nats * affordable
        target = skeleton.target
        for _ in range(self.skeleton.max_chain - 1):
            on_ego = target <= 0
            members = members & (on_ego | members.gather(1, target.clamp(min=0)))
        return members, nats

    def _route_nats(self, scene: TensorDictBase, route: Tensor) -> Tensor:
        """-log p of candidates route [B, V] under the prior's own choice of routes."""
        temperature = max(self.prior.sampler.route_temperature, MIN_TEMPERATURE)
        with torch.no_grad():
            log_p = torch.log_softmax(self.prior.route_choice(scene) / temperature, -1)
        return -take_route(log_p, route.clamp(min=0)).clamp(min=-MAX_ROUTE_NATS)


def on_paths(
    state: E2State,
    world: World,
    route: Tensor,
    off_lane: Tensor,
    paths: Tensor,
) -> E2State:
    """Returns states with vehicles on routes or interceptions, and with their poses
    there. A vehicle that was off its lane and no longer is returns to its route.

    Args:
        state: of B scenes.
        world: the scenes now.
        route: [B, V] int64, candidates.
        off_lane: [B, V] bool, who is on a path instead.
        paths: [B, V, P, 2] m.
    """
    moved = (route != state.routed.route) | off_lane | state.off_lane
    if not bool(moved.any()):
        return state
    state = onto(state, world, route=route, moved=moved, off_lane=off_lane, paths=paths)
    return replace(state, off_lane=off_lane)
