"""e2, the adversarial synthesizer: Algorithm 1's inner part for batches of scenes.

`E2.replan_group` is the attack on one page: select, propose, pull, yield, choose, book.
With eta = 0 nothing is controlled, and the traffic is the prior's, bit for bit.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, get_args

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.prior.lane_relative import ACCEL_SCALE, HORIZON, KNOTS, SIZE
from e2rl.prior.prior import Context, Control, Plan, Sample, uncontrolled
from e2rl.run.config import configured, setting, settings_of
from e2rl.run.errors import InputError
from e2rl.sim.world import World
from e2rl.traffic.decisions import ANY, RULE, eligible
from e2rl.traffic.e2.anchoring import Anchor, AnchorSettings
from e2rl.traffic.e2.choice import Tries, best_try, choice_nats, drawn_nats, joint_tries
from e2rl.traffic.e2.coalition import SUPPORTS, Selector, on_paths
from e2rl.traffic.e2.control import ControlSettings, SparseControl
from e2rl.traffic.e2.feasibility import FeasibilitySettings, feasible_vehicles
from e2rl.traffic.e2.foresight import time_before
from e2rl.traffic.e2.interception import InterceptionSettings, interception_nats
from e2rl.traffic.e2.kernels import KernelAttack, KernelSettings, propose_kernels
from e2rl.traffic.e2.paper import GuidanceSettings, LiteralAnchor, MaskedGuidance
from e2rl.traffic.e2.pull import Pull
from e2rl.traffic.e2.reasoner import LanguageReasoner, ReasonerSettings
from e2rl.traffic.e2.skeleton import SkeletonSettings
from e2rl.traffic.e2.state import E2State
from e2rl.traffic.e2.topology import TopologySettings
from e2rl.traffic.grouping import noise_of, of_scenes, take_rows
from e2rl.traffic.nominal import NominalTraffic, React, Replan
from e2rl.traffic.potentials import PotentialContext, PotentialSettings
from e2rl.traffic.responsibility import RESPONSIBILITIES, YieldingSettings, duty_of
from e2rl.traffic.traffic import TrafficPlan

BLEND_DRAW = 500  # number of the draw of eq. 14's noise


@configured("synthesizer/e2")
@dataclass(eq=False, repr=False)
class E2(NominalTraffic):
    """The guided reverse SDE with a sparse coalition, on a frozen prior.

    Settings: conf/synthesizer/e2.yaml. Groups of settings may be given as mappings;
    `guidance` and `potentials` are None unless the paper's guidance acts (paper.py).
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
    control: ControlSettings
    yielding: YieldingSettings
    guidance: GuidanceSettings | None
    potentials: PotentialSettings | None

    adversarial = True
    follows_decisions = True

    def __post_init__(self) -> None:
        super().__post_init__()
        for group in fields(self):
            values = getattr(self, group.name)
            if isinstance(values, Mapping):
                kind: Any = next(iter(get_args(group.type)), group.type)
                where = f"synthesizer.{group.name}"
                setattr(self, group.name, settings_of(kind, values, where=where))
        if self.guidance is not None and self.potentials is None:
            self.potentials = PotentialSettings()
        if self.control.anchoring == "literal" and self.guidance is None:
            raise InputError(
                "synthesizer.control.anchoring=literal is eq. 14 at the noise level "
                "guidance.anchor_level: take synthesizer=e2_paper, or set "
                "synthesizer.guidance"
            )
        sampler = self.prior.sampler
        without_noise = sampler.churn == 0 and sampler.sampler != "euler_maruyama"
        if without_noise and self.control.transport_budget is not None:
            raise InputError(
                "prior.sampler.churn=0: control of steps without noise has no price in "
                "nats, so that a transport_budget binds nothing; set it above 0, or "
                "synthesizer.control.transport_budget=null"
            )
        by_rules = self.reasoner.kind == "rules"
        self.selector = Selector(
            prior=self.prior,
            lawful=self.responsibility == "full",
            support=self.support,
            reselect=self.reselect,
            topology=self.topology,
            feasibility=self.feasibility,
            feasible_vehicles=(
                feasible_vehicles if by_rules else LanguageReasoner(self.reasoner)
            ),
            skeleton=self.skeleton,
            anchor=self.anchor,
            interception=self.interception,
            budget=self.control.transport_budget,
        )

    @property
    def tuned(self) -> Mapping[str, tuple]:  # type: ignore[override]
        """e2 has no gain: eta multiplies the limits of its interceptions. Where V_adv
        acts, its clip is the gain, or, without a clip, the weight of its distance."""
        lateral = {"interception.lateral": (0.5, 4.0, "log")}
        distance = {"potentials.distance": (1.0, 40.0, "log")}
        if self.guidance is None or self.guidance.adversarial_clip == 0:
            return lateral | {"interception.push": (0.5, 3.0, "log")}
        if self.guidance.adversarial_clip is None:
            return distance | {"anchor.strength": (0.05, 1.0, "log")}
        clip = {"guidance.adversarial_clip": (0.05, 4.0, "log")}
        return clip | (distance if self.skeleton.pursuit else lateral)

    def reset(
        self,
        scenes: TensorDictBase,
        seed: Tensor,
        eta: Tensor,
        decisions: Tensor | None = None,
    ) -> E2State:
        """Returns states of scenes with routes drawn from the prior and no vehicle
        under control.

        Args:
            scenes: [B].
            seed: [B] int64, of the noise.
            eta: [B], intensities.
            decisions: [B, D], `Decisions` of each (None: by rule).
        """
        nominal = super().reset(scenes, seed, eta=eta)
        if decisions is None:
            decisions = eta.new_tensor(RULE).expand(len(eta), -1)
        nobody = torch.zeros_like(nominal.routed.parked)
        zero = torch.zeros_like(nominal.routed.length)
        return E2State(
            **vars(nominal),
            eta=eta * decisions[:, 0],
            decided=decisions,
            coalition=nobody,
            target=nobody.long() - 1,
            off_lane=nobody,
            committed=nobody,
            knots=zero[..., None].repeat(1, 1, KNOTS),
            drawn=nobody,
            since=zero - 1,
            settled=nobody,
            path_kl=zero,
            anchor_jump=zero,
        )

    def replan(
        self,
        state: E2State,
        world: World,
        ego_plan: Tensor,
        react: React | None = None,
    ) -> tuple[E2State, TrafficPlan]:
        """Returns states and plans of the coming HORIZON steps.

        Args:
            state: of B scenes.
            world: the scenes now.
            ego_plan: [B, >= HORIZON, 4], what the ego announces.
            react: not asked.
        """
        state, plan = super().replan(state, world, ego_plan=ego_plan, react=react)
        plan = replace(
            plan,
            adversary=state.coalition | state.drawn,
            target=torch.where(state.drawn & ~state.coalition, 0, state.target),
            path_kl=state.path_kl,
            anchor_jump=state.anchor_jump,
        )
        return state, plan

    def replan_group(self, replan: Replan) -> tuple[E2State, Tensor, Context]:
        """Returns state, joint sample x0 [G, V, SIZE] and context of a group."""
        state = replan.state
        if not bool(state.attacked.any()) or self.control.transport_budget == 0:
            return super().replan_group(replan)
        world = replace(replan.world, route=state.routed.route)
        ego_plan = replan.ego_plan

        # Select C* where a choice is due, and propose how its members meet their
        # targets, on a lane or by an interception, whose nats are booked.
        state, anchor = self.selector.select(state, world, ego_plan, self._reference)
        state, anchor = self._onto_interceptions(state, world, anchor)
        context = self.encode(state, world, ego_plan=ego_plan, known=replan.before)
        anchored = anchor.feasible & state.coalition
        if self.control.anchoring == "off":
            anchored = anchored & state.off_lane
        state = replace(state, committed=anchored, knots=anchor.knots)

        # Propose kernels to vehicles without a proposal; pull a joint sample to each,
        # and choose among them and the sample that is pulled to the anchors alone.
        if self.kernels.samples == 1 or not bool(self._affords_kernels(state).any()):
            control = self._control(state, world, ego_plan, anchor, context)
            left = state.nats_left(self.control.transport_budget)
            sample = self.prior.sample(context, replan.noise, control, left)
            state = self._booked(state, sample.kl, control)
            state = replace(state, drawn=torch.zeros_like(state.drawn))
            x0 = sample.x0
        else:
            state, x0 = self._best_sample(state, world, replan, anchor, context)

        # Yield: adversaries brake for the ego as they owe it.
        decisions = state.decisions
        duty = duty_of(
            self.responsibility,
            self.yielding,
            world=world,
            coalition=state.coalition | state.drawn,
            eta=state.eta,
            lateness=decisions.patience,
            owes=decisions.owes >= 0.5,
        )
        context = replace(context, obstacles=replace(context.obstacles, duty=duty))
        return state, x0, context

    def _reference(self, state: E2State, world: World, ego_plan: Tensor) -> Plan:
        """The prior's plan without control, for the topology."""
        context = self.encode(state, world, ego_plan=ego_plan)
        return self.prior.plan(self.prior.estimate(context), context)

    def _onto_interceptions(
        self,
        state: E2State,
        world: World,
        anchor: Anchor,
    ) -> tuple[E2State, Anchor]:
        """States on the interceptions under way, with their nats booked; those beyond
        the budget are off."""
        off_lane = anchor.off_lane & state.coalition & state.attacked[:, None]
        route = state.routed.route
        nats = interception_nats(
            anchor.off_lane_path,
            anchor.knots,
            world=world,
            lane=state.lane,
            route=route,
            off_lane=off_lane,
        )
        left = state.nats_left(self.control.transport_budget)
        if left is not None:
            affordable = (nats.sum(-1) <= left)[:, None]
            feasible = anchor.feasible & (affordable | ~off_lane)
            anchor = replace(anchor, feasible=feasible)
            off_lane = off_lane & affordable
            nats = nats * affordable
        state = replace(state, path_kl=state.path_kl + nats)
        state = on_paths(
            state,
            world,
            route=route,
            off_lane=off_lane,
            paths=anchor.off_lane_path,
        )
        return state, anchor

    def _best_sample(
        self,
        state: E2State,
        world: World,
        replan: Replan,
        anchor: Anchor,
        context: Context,
    ) -> tuple[E2State, Tensor]:
        """State and the joint sample x0 of highest value in each scene: a plain one, or
        one of those drawn to kernels.

        A drawn sample has gain times its worth more and its nats less. All samples of a
        scene have the same noise. The price of the choice is booked in row 0
        (`choice_nats`); it favours noise that leads where the kernel does, so drawn
        vehicles pay log q/p of their path where that is more than its KL.
        """
        ego_plan = replan.ego_plan
        attack, tries = self._kernel_tries(state, world, ego_plan, context)
        copies = take_rows(state, tries.scenes)
        contexts = of_scenes(context, tries.scenes)
        control = self._control(
            copies,
            take_rows(attack.world, tries.scenes),
            attack.ego_plan[tries.scenes],
            take_rows(anchor, tries.scenes),
            contexts,
            kernel=Pull(tries.goal, tries.drawn, self.kernels.pull * copies.eta),
        )
        price = choice_nats(tries.rows, len(state.eta), self.kernels.samples - 1)
        left = copies.nats_left(self.control.transport_budget)
        sample = self.prior.sample(
            contexts,
            replan.noise[:, tries.scenes],
            control,
            None if left is None else left - price,
        )
        nats = sample_nats(sample, tries.drawn, price)
        worth, prevented = self._worth(attack, contexts, sample.x0, tries.scenes)
        value = self.kernels.gain * copies.eta * worth.amax(-1) - nats.sum(-1)
        if left is not None:
            beyond = tries.drawn.any(1) & (nats.sum(-1) > left)
            value = value.masked_fill(beyond, -torch.inf)
        pick = best_try(value, tries.rows, len(state.eta))
        settled = state.settled | (tries.drawn & (worth > 0) & prevented)[pick]
        state = replace(
            state,
            drawn=tries.drawn[pick],
            settled=settled,
            since=time_before(attack.world, attack.ego_plan, state.since),
        )
        return self._booked(state, nats[pick], control, pick), sample.x0[pick]

    def _kernel_tries(
        self,
        state: E2State,
        world: World,
        ego_plan: Tensor,
        context: Context,
    ) -> tuple[KernelAttack, Tries]:
        """What kernels are valued by, and the joint samples to draw: to the best
        kernels of vehicles that have no proposal under way."""
        mean = self.prior.estimate(context)
        room = state.coalition.sum(1) < self.skeleton.near
        may_join = (state.coalition | room[:, None]) & state.attacked[:, None]
        free = context.active & ~state.committed & may_join
        whom = state.decisions.whom
        free &= eligible(world, whom, lawful=False) | (whom == ANY)[:, None]
        attack = KernelAttack.of(
            world,
            free,
            ego_plan=ego_plan,
            plan=self.prior.decode(mean, context).states(),
            since=state.since,
            settled=state.settled,
        )
        kernels = propose_kernels(
            attack,
            state.lane,
            points=state.routed.points,
            mean=mean,
            gain=self.kernels.gain * state.eta,
            count=self.kernels.samples - 1,
        )
        any_kernel = (kernels.vehicle >= 0).any(1)
        rows = (any_kernel & self._affords_kernels(state)).nonzero()[:, 0]
        return attack, joint_tries(kernels, rows)

    def _affords_kernels(self, state: E2State) -> Tensor:
        """Bool [B]: there are nats left to choose a sample that is drawn to a kernel."""
        left = state.nats_left(self.control.transport_budget)
        if left is None:
            return state.attacked
        return state.attacked & (left > drawn_nats(self.kernels.samples - 1))

    def _worth(
        self,
        attack: KernelAttack,
        contexts: Context,
        x0: Tensor,
        scenes: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """What `foresee` makes of samples x0 [C, V, SIZE] of scenes [C]: worth and
        prevented [C, V]."""
        worth = torch.zeros_like(x0[..., 0])
        prevented = torch.zeros_like(worth, dtype=torch.bool)
        copy, pair = (attack.row == scenes[:, None]).nonzero(as_tuple=True)
        place = (copy, attack.vehicle[pair])
        tracks = self.prior.decode(x0, contexts).states()[place]
        foresight = attack.foresight(tracks[:, None], pair)
        worth = worth.index_put(place, foresight.worth[:, 0])
        return worth, prevented.index_put(place, foresight.prevented[:, 0])

    def _control(
        self,
        state: E2State,
        world: World,
        ego_plan: Tensor,
        anchor: Anchor,
        context: Context,
        kernel: Pull | None = None,
    ) -> SparseControl:
        """The pulls of a replan, to a kernel and to anchors, and the paper's guidance
        where it is set."""
        anchored = anchor.feasible & state.coalition
        strength = self.anchor.strength
        pulls = [] if kernel is None else [kernel]
        if self.control.anchoring == "clean" and strength > 0:
            lateral = torch.full_like(anchor.knots[..., : SIZE - KNOTS], torch.nan)
            goal = torch.cat([anchor.knots / ACCEL_SCALE, lateral], -1)
            pulls.append(Pull(goal, anchored, strength=strength * state.eta))
        raw = None
        if self.control.anchoring == "raw":
            driven = anchored & state.attacked[:, None]
            raw = torch.where(driven[..., None], anchor.knots, torch.nan)
        guidance: Control = uncontrolled
        if self.guidance is not None:
            guidance = self._guidance(state, world, ego_plan, anchor, context)
        return SparseControl(state.attacked, pulls, guidance=guidance, raw=raw)

    def _guidance(
        self,
        state: E2State,
        world: World,
        ego_plan: Tensor,
        anchor: Anchor,
        context: Context,
    ) -> MaskedGuidance:
        """Eqs. 14 and 16 for one replan."""
        assert self.guidance is not None and self.potentials is not None
        routed = state.routed
        vehicles = routed.route.shape[1]
        literal = None
        if self.control.anchoring == "literal" and self.anchor.strength > 0:
            number = BLEND_DRAW + state.replans
            blended = anchor.feasible & state.coalition & context.active
            literal = LiteralAnchor(
                knots=anchor.knots,
                vehicles=blended & state.attacked[:, None],
                weight=min(self.anchor.strength, 1.0),
                noise=noise_of(state.seed, number, shape=(vehicles, SIZE)),
            )
        return MaskedGuidance(
            prior=self.prior,
            settings=self.guidance,
            potentials=self.potentials,
            conditions=PotentialContext(
                scene=world.scene,
                start=world.states[:, :vehicles],
                accel=state.lane.a,
                valid=world.valid[:, :vehicles],
                route=routed.points,
                on_route=routed.has_lane,
                ego_plan=ego_plan[:, :HORIZON],
                target=state.target,
            ),
            coalition=state.coalition,
            eta=state.eta,
            anchor=literal,
        )

    def _booked(
        self,
        state: E2State,
        nats: Tensor,
        control: SparseControl,
        pick: Tensor | None = None,
    ) -> E2State:
        """States with nats [B, V] of a sample added; pick [B]: which of the samples of
        the control it is."""
        state = replace(state, path_kl=state.path_kl + nats)
        if not isinstance(control.guidance, MaskedGuidance):
            return state
        jump = control.guidance.jump
        jump = jump if pick is None else jump[pick]
        return replace(state, anchor_jump=state.anchor_jump + jump)


def sample_nats(sample: Sample, drawn: Tensor, price: Tensor) -> Tensor:
    """Returns what C joint samples cost, nats [C, V].

    Path KL, or log q/p of the path of vehicles drawn [C, V] to a kernel where that is
    more; row 0, the ego's, holds the price [C] of the choice.
    """
    nats = torch.where(drawn, torch.maximum(sample.kl, sample.log_ratio), sample.kl)
    return torch.cat([price[:, None], nats[:, 1:]], 1)
