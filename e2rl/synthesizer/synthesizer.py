"""One synthesizer for training and evaluation: Algorithm 1's inner part, scene by scene in batches, without TorchRL.

At a scene's start: routes, reference rollout, topology, feasibility, skeleton. At every replan: encode once, anchor,
sample under sparse control. With eta = 0 nothing is controlled, and the traffic is the prior's, bit for bit.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.ego.base import Ego
from e2rl.errors import InputError
from e2rl.prior.lane_relative import HORIZON, SIZE, LaneState, locate
from e2rl.prior.prior import Context, Plan, Prior
from e2rl.prior.routed import reroute
from e2rl.scene.recording import DT
from e2rl.sim.dynamics import wrap
from e2rl.sim.world import World
from e2rl.synthesizer.anchoring import Anchor, AnchorSettings, propose
from e2rl.synthesizer.control import ControlSettings, SparseControl
from e2rl.synthesizer.episode import Episode, noise_of, put_rows, take_rows
from e2rl.synthesizer.feasibility import FeasibilitySettings
from e2rl.synthesizer.grouping import clone, crop_episode, crop_world, gather_plans, group_scenes, write_episode
from e2rl.synthesizer.interception import InterceptionSettings
from e2rl.synthesizer.lookahead import Lookahead
from e2rl.synthesizer.potentials import (
    SAMPLED_STEPS,
    PotentialContext,
    PotentialSettings,
    adversarial_potential,
    feasibility_potential,
)
from e2rl.synthesizer.reasoner import ReasonerSettings, build_reasoner
from e2rl.synthesizer.selection import Selection
from e2rl.synthesizer.skeleton import Skeleton, SkeletonSettings, build_skeleton, chain_depth, direct
from e2rl.synthesizer.topology import TopologySettings, topological_candidates

LOOK = 5  # steps of the ego's plan over which its present yaw rate is taken
PER_SAMPLE, LITERAL, SUPPORT = 1000, 500, 750  # numbers of draws: a joint sample's, the literal blend's, a support's
SUPPORTS = ("feasible", "topology", "random")


@dataclass(frozen=True)
class SynthesizerSettings:
    """Settings of all parts (conf/synthesizer/e2.yaml).

    support: whom the coalition is chosen from: feasible (S = S_top and F), topology (S_top alone) or random (as many
    as there are near agents, whoever they are), the ablations of table 2; reselect: replans after which a coalition
    that can no longer meet its targets is chosen anew, 0: never; samples: joint samples a replan, of which each scene
    keeps the one with the least selection * V_feas + eta * V_adv.
    """

    topology: TopologySettings = TopologySettings()
    feasibility: FeasibilitySettings = FeasibilitySettings()
    reasoner: ReasonerSettings = ReasonerSettings()
    skeleton: SkeletonSettings = SkeletonSettings()
    anchor: AnchorSettings = AnchorSettings()
    interception: InterceptionSettings = InterceptionSettings()
    potentials: PotentialSettings = PotentialSettings()
    control: ControlSettings = ControlSettings()
    support: str = "feasible"
    reselect: int = 2
    samples: int = 1
    selection: float = 1.0

    def __post_init__(self):
        if self.support not in SUPPORTS:
            raise InputError(f"synthesizer.support is {self.support!r}; choose one of {', '.join(SUPPORTS)}")


def _cheaper(one: tuple[Tensor, ...], two: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """Per scene, the tuple whose last entry [B] is smaller; the first of equals."""
    less = two[-1] < one[-1]
    return tuple(torch.where(less.view(-1, *[1] * (a.ndim - 1)), b, a) for a, b in zip(one, two, strict=True))


class Synthesizer:
    """Frozen prior and settings; `begin` and `replan` drive an Episode."""

    def __init__(self, prior: Prior, settings: SynthesizerSettings | None = None):
        self.prior = prior.requires_grad_(False).eval()
        self.settings = settings or SynthesizerSettings()
        self.statistics: dict[str, float] = {}
        self.on_selection: Callable[[Selection], None] | None = None  # told of every choice of coalitions
        self.feasible_vehicles = build_reasoner(self.settings.reasoner, self.statistics)

    def begin(self, scene: TensorDictBase, seed: Tensor, eta: Tensor) -> Episode:
        """Episodes of scenes [B] with routes drawn from the prior; seed [B] int64, eta [B]."""
        uniform = noise_of(seed, torch.zeros_like(seed), tuple(scene["route_valid"].shape[1:2]), uniform=True)
        routed, state = self.prior.start(scene, self.prior.choose_routes(scene, uniform))
        return Episode.start(seed, eta, routed, state)

    def replan(self, episode: Episode, world: World, ego_plan: Tensor, ego: Ego | None = None) -> tuple[Episode, Plan]:
        """The episodes and the plan of the coming HORIZON steps, given the ego's plan [B, HORIZON, 4] (detached); ego:
        whom `control.lookahead` asks how it would react."""
        ego_plan = ego_plan.detach()
        noise = torch.stack([self._noise(episode, draw) for draw in range(self.settings.samples)])
        groups, (batch, width) = group_scenes(world), episode.routed.route.shape
        whole, plans = clone(episode), []
        for group in groups:
            part, plan = self._replan_group(
                crop_episode(episode, group, width),
                crop_world(world, group),
                ego_plan[group.rows],
                noise[:, :, group.rows, : group.vehicles],
                None if ego is None else partial(Lookahead(ego, world), group),
            )
            write_episode(whole, part, group)
            plans.append((group, plan))
        return whole, gather_plans(plans, batch, width)

    def _replan_group(
        self, episode: Episode, world: World, ego_plan: Tensor, noise: Tensor, react: Callable[[Tensor], Tensor] | None
    ) -> tuple[Episode, Plan]:
        """`replan` of a group; noise [samples, steps, B, V, SIZE]."""
        episode = replace(episode, state=self._placed(episode, world, ego_plan))
        world = replace(world, route=episode.routed.route)
        controlled, anchor = bool((episode.eta > 0).any()), None
        if controlled:
            episode, anchor = self._reselected(episode, world, ego_plan, noise[0])
            leaves = anchor.off_lane & episode.coalition & (episode.eta > 0)[:, None]
            episode = self._onto(episode, world, episode.routed.route, leaves, anchor.off_lane_path)
            world = replace(world, route=episode.routed.route)
        context = self._encode(episode, world, ego_plan, episode.coalition)
        where = self._where(episode, world, ego_plan)
        control = self._control(episode, where, anchor, react) if controlled else None
        best = None
        for draw in noise:
            sample = self.prior.sample(context, draw, control, self._budget(episode))
            jump = control.jump if control else torch.zeros_like(sample.kl)
            found = (sample.x0, sample.kl, jump, self._cost(sample.x0, context, where, episode.eta))
            best = found if best is None else _cheaper(best, found)
        plan = self.prior.plan(best[0], context)
        there = world.valid[:, : plan.on_map.shape[1], None]  # who is gone does not come back
        return replace(
            episode, replans=episode.replans + 1, kl=episode.kl + best[1], jump=episode.jump + best[2]
        ), replace(plan, on_map=plan.on_map & there)

    def _noise(self, episode: Episode, sample: int = 0) -> Tensor:
        shape = (self.prior.sampler.steps, episode.routed.route.shape[1], SIZE)
        return noise_of(episode.seed, 1 + episode.replans + PER_SAMPLE * sample, shape).transpose(0, 1)

    def _budget(self, episode: Episode) -> Tensor | None:
        """Path KL [B] that control may still add to each scene."""
        limit = self.settings.control.transport_budget
        return None if limit is None else (limit - episode.kl.sum(-1)).clamp(min=0)

    def _cost(self, x0: Tensor, context: Context, where: PotentialContext, eta: Tensor) -> Tensor:
        """V_feas of everybody plus eta V_adv of the coalition [B]: whole joint samples are compared, never vehicles."""
        if self.settings.samples == 1:
            return torch.zeros_like(eta)
        states = self.prior.decode(x0, context, steps=SAMPLED_STEPS).states()
        infeasible = feasibility_potential(states, where, self.settings.potentials) * context.active
        threat = adversarial_potential(states, where, self.settings.potentials)
        return self.settings.selection * infeasible.sum(-1) + eta * threat.sum(-1)

    def _placed(self, episode: Episode, world: World, ego_plan: Tensor) -> LaneState:
        """The lane states now: the ego as it really drove and is about to turn, the others where their plans led;
        plans in free space do not know their routes, so the place beside them is looked up."""
        state, routed = episode.state, episode.routed
        yaw_rate = wrap(ego_plan[:, LOOK - 1, 2] - world.states[:, 0, 2]) / (LOOK * DT)
        ego = torch.zeros_like(routed.parked)
        ego[:, 0] = True
        v = torch.where(ego, world.states[:, :1, 3], state.v)
        now = locate(
            world.states[:, : ego.shape[1]],
            torch.where(ego, world.accel[:, :1], state.a),
            torch.where(ego, yaw_rate[:, None], state.kappa * state.v),
            routed.points,
            state.s + ego * v / 2,
        )
        beside = ("s", "d", "d1", "d2")
        looked_up = {name: ego | ~routed.has_lane if name in beside else ego for name in vars(state)}
        return LaneState(
            **{name: torch.where(rows, getattr(now, name), getattr(state, name)) for name, rows in looked_up.items()}
        )

    def _encode(self, episode: Episode, world: World, ego_plan: Tensor, exempt: Tensor) -> Context:
        return self.prior.encode(episode.routed, episode.state, world.states, world.valid, world.step, ego_plan, exempt)

    def _reselected(self, episode: Episode, world: World, ego_plan: Tensor, noise: Tensor) -> tuple[Episode, Anchor]:
        """The episodes and their anchors, those with a new support whose choice is due and of whose coalition no member
        can meet its target any more."""
        every = self.settings.reselect
        due = (episode.replans == 0) | ((episode.replans % every == 0) if every > 0 else False)
        anchor = self._anchor(episode, world, ego_plan)
        rows = (due & (episode.eta > 0) & ~anchor.feasible.any(1)).nonzero().squeeze(-1)
        if not len(rows):
            return episode, anchor
        lost, there = take_rows(episode, rows), take_rows(world, rows)
        chosen = self._select(lost, there, ego_plan[rows], noise[:, rows])
        found = self._anchor(chosen, replace(there, route=chosen.routed.route), ego_plan[rows])
        return put_rows(episode, rows, chosen), put_rows(anchor, rows, found)

    def _anchor(self, episode: Episode, world: World, ego_plan: Tensor) -> Anchor:
        """Proposals for the present coalition on its present routes."""
        depth = chain_depth(episode.target)
        skeleton = Skeleton(
            episode.coalition, episode.target, depth, depth == 1, depth > 1, episode.replans, episode.replans
        )
        return propose(
            world.scene,
            world,
            skeleton,
            ego_plan,
            self.settings.anchor,
            self.settings.interception,
            episode.eta,
            keep_route=True,
        )

    def _select(self, episode: Episode, world: World, ego_plan: Tensor, noise: Tensor) -> Episode:
        """Topology on a reference rollout, feasibility, skeleton; the coalition takes the routes that meet targets."""
        scene, vehicles = world.scene, episode.routed.route.shape[1]
        context = self._encode(episode, world, ego_plan, torch.zeros_like(episode.coalition))
        nominal = self.prior.plan(self.prior.sample(context, noise).x0, context)
        reference = torch.cat([ego_plan[:, None], nominal.states()[:, 1:]], 1).transpose(1, 2)
        valid = world.valid[:, None, :vehicles] & nominal.on_map.transpose(1, 2)
        found = topological_candidates(reference, valid, scene["size"][:, :vehicles], self.settings.topology)
        feasible = self.feasible_vehicles(scene, world, self.settings.feasibility).mask
        steps = round(self.settings.skeleton.step / DT)
        expected = reference[:, steps - 1 :: steps].transpose(1, 2)
        support, fallback = self._support(episode, world, found.candidates, feasible)
        everybody = direct(support | fallback)  # whom it costs least to meet the ego are the near agents
        anchor = propose(
            scene, world, everybody, ego_plan, self.settings.anchor, self.settings.interception, episode.eta
        )
        skeleton = build_skeleton(scene, world, support, fallback, self.settings.skeleton, expected, anchor.cost)
        self._count(skeleton, found.candidates, feasible)
        if bool(skeleton.far.any()):  # otherwise everybody meets the ego, as just proposed
            anchor = propose(
                scene, world, skeleton, ego_plan, self.settings.anchor, self.settings.interception, episode.eta
            )
        # A member that no route and acceleration lead to its target is pruned (Sec. IV-A3: infeasible configurations),
        # and so is everybody whose chain to the ego leads over it.
        acts = skeleton.coalition & anchor.feasible & (episode.eta > 0)[:, None]
        for _ in range(self.settings.skeleton.max_chain - 1):
            acts = acts & ((skeleton.target <= 0) | acts.gather(1, skeleton.target.clamp(min=0)))
        episode = replace(
            episode,
            coalition=acts,
            target=torch.where(acts, skeleton.target, -1),
            adversaries=episode.adversaries | acts,
        )
        if self.on_selection:
            self.on_selection(
                Selection(
                    episode.seed,
                    world.step,
                    reference[:, found.steps],
                    (DT * (found.steps + 1)).expand(len(reference), -1),
                    found.weights,
                    found.candidates,
                    feasible,
                    episode.coalition,
                    episode.target,
                )
            )
        return self._onto(
            episode, world, torch.where(acts, anchor.route, world.route), acts & False, anchor.off_lane_path
        )

    def _support(self, episode: Episode, world: World, candidates: Tensor, feasible: Tensor) -> tuple[Tensor, Tensor]:
        """S [B, V] and who may take its place where it is empty, by `support` (eq. support_selection)."""
        if self.settings.support == "random":
            there = world.valid[:, : feasible.shape[1]] & ~episode.routed.parked
            there = there & (torch.arange(feasible.shape[1], device=there.device) > 0)
            draw = noise_of(episode.seed, SUPPORT + episode.replans, tuple(feasible.shape[1:]), uniform=True)
            rank = draw.masked_fill(~there, torch.inf).argsort(-1).argsort(-1)
            chosen = there & (rank < self.settings.skeleton.near)
            return chosen, chosen
        if self.settings.support == "topology":
            return candidates, candidates
        return candidates & feasible, feasible

    def _onto(self, episode: Episode, world: World, route: Tensor, leaves: Tensor, ways: Tensor) -> Episode:
        """The episodes with vehicles moved to candidates route [B, V], or those that leave their lanes [B, V] to ways
        [B, V, P, 2], placed on them where they are now. Who left its lane and leaves it no more returns."""
        changed = (route != episode.routed.route) | leaves | episode.leaves
        if not bool(changed.any()):
            return episode
        routed = reroute(episode.routed, world.scene, route, changed, leaves, ways, self.prior.free_space)
        old = episode.state
        moved = locate(world.states[:, : route.shape[1]], old.a, old.kappa * old.v, routed.points)
        state = LaneState(
            *(torch.where(changed, getattr(moved, f.name), getattr(old, f.name)) for f in fields(LaneState))
        )
        return replace(episode, routed=routed, state=state, leaves=leaves)

    def _where(self, episode: Episode, world: World, ego_plan: Tensor) -> PotentialContext:
        vehicles = episode.routed.route.shape[1]
        return PotentialContext(
            world.scene,
            world.states[:, :vehicles],
            episode.state.a,
            world.valid[:, :vehicles],
            episode.routed.points,
            episode.routed.has_lane,
            ego_plan[:, :HORIZON],
            episode.target,
        )

    def _control(
        self, episode: Episode, where: PotentialContext, anchor: Anchor, react: Callable | None
    ) -> SparseControl:
        settings = self.settings
        literal = noise_of(episode.seed, LITERAL + episode.replans, (*episode.target.shape[1:], SIZE))
        return SparseControl(
            self.prior,
            settings.control,
            settings.potentials,
            where,
            episode.coalition,
            episode.eta,
            anchor,
            settings.anchor.strength,
            literal,
            react,
        )

    def _count(self, skeleton: Skeleton, candidates: Tensor, feasible: Tensor) -> None:
        """Running totals for logging."""
        counts = {
            "scenes": len(candidates),
            "candidates": int(candidates.sum()),
            "feasible": int(feasible.sum()),
            "coalition": int(skeleton.coalition.sum()),
            **skeleton.counts(),
        }
        for name, value in counts.items():
            self.statistics[name] = self.statistics.get(name, 0) + value
