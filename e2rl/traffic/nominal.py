"""The prior as background traffic: every 0.5 s an uncontrolled joint sample, given what
is known of the ego.

Traffic predicts the ego from its state and past, as other drivers see it: on the route
that its motion makes likeliest. So no planner can mislead its adversaries by what it
announces as its plan (docs/reference/attack.md). With `knowledge` "plan" it is told the plan
and the mission.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import TypeVar

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.prior.lane_relative import HORIZON, SIZE, LaneState, locate, select
from e2rl.prior.prior import Context, Prior
from e2rl.prior.routes import Moment, RoutedScene, reroute
from e2rl.run.config import configured, setting
from e2rl.scenes.recording import DT
from e2rl.sim import dynamics
from e2rl.sim.dynamics import wrap
from e2rl.sim.world import World
from e2rl.traffic.grouping import (
    clone,
    crop_state,
    crop_world,
    group_scenes,
    no_vehicles,
    noise_of,
    write_state,
)
from e2rl.traffic.traffic import REPLAN_STEPS, State, Traffic, TrafficPlan

KNOWLEDGE = ("predicted", "plan")
LOOK = 5  # steps of the ego's plan over which its current yaw rate is estimated
# Rows [G] and planned states [G, V, HORIZON, 4] -> the egos' [G, HORIZON, 4].
React = Callable[[Tensor, Tensor], Tensor]


@dataclass
class PriorState:
    """B scenes driven by the prior; every tensor has the batch first.

    seed [B]: of the scene's noise; replans [B]: replans so far; routed: the vehicles'
    routes; lane [B, V]: lane states at the end of the executed plans.
    """

    seed: Tensor = no_vehicles()
    replans: Tensor = no_vehicles()
    routed: RoutedScene
    lane: LaneState


Own = TypeVar("Own", bound=PriorState)


@dataclass
class Replan:
    """What a group of G scenes is replanned from.

    state: the method's, its lane states now; world: the scenes now; ego_plan [G,
    HORIZON, 4]: the ego's motion, known or predicted; noise [K, G, V, ..., SIZE]:
    standard normal; react: from planned states [G, V, HORIZON, 4] to the ego's own
    answer [G, HORIZON, 4], None where it cannot be asked; before: in which the ego was
    predicted.
    """

    state: State
    world: World
    ego_plan: Tensor
    noise: Tensor
    react: Callable[[Tensor], Tensor] | None = None
    before: Context | None = None


@configured("synthesizer/nominal")
@dataclass(eq=False, repr=False)
class NominalTraffic(Traffic):
    """Unguided samples of the frozen prior. Settings: conf/synthesizer/nominal.yaml."""

    prior: Prior
    knowledge: str = setting(choices=KNOWLEDGE)

    def __post_init__(self) -> None:
        self.prior = self.prior.requires_grad_(False).eval()

    def reset(self, scenes: TensorDictBase, seed: Tensor, eta: Tensor) -> State:
        """Returns the states of scenes [B] with routes drawn from the prior."""
        uniform = self.route_noise(seed, scenes["route_valid"].shape[1])
        scenes = self.as_seen(World.at_start(scenes)).scene
        routes = self.prior.choose_routes(scenes, uniform)
        routed, lane = self.prior.start(scenes, routes)
        return PriorState(seed, torch.zeros_like(seed), routed=routed, lane=lane)

    def replan(
        self,
        state: State,
        world: World,
        ego_plan: Tensor,
        react: React | None = None,
    ) -> tuple[State, TrafficPlan]:
        """Returns states and plans of the coming HORIZON steps; scenes of similar size
        are planned together.

        Args:
            state: of B scenes.
            world: the scenes now.
            ego_plan: [B, >= HORIZON, 4], what the ego announces, looked at where
                `knowledge` is "plan".
            react: the ego's answers to plans (`Traffic.queries_ego`).
        """
        world = self.as_seen(world)
        ego_plan = ego_plan.detach()
        noise = self.noise(state)
        batch, width = state.routed.route.shape
        whole = clone(state)
        states = world.states.new_zeros(batch, width, HORIZON, 4)
        present = torch.zeros_like(states[..., 0], dtype=torch.bool)
        for group in group_scenes(world):
            rows = group.rows
            vehicles = group.vehicles
            part = crop_state(state, group, width=width)
            scenes = crop_world(world, group)
            part = self._expecting(part, scenes)
            expected = ego_plan[rows]
            context = None
            if self.knowledge != "plan":
                expected, context = self.predicted_ego(part, scenes)
            lane = self.lane_now(part, scenes, ego_plan=expected)
            replan = Replan(
                replace(part, lane=lane),
                scenes,
                ego_plan=expected,
                noise=noise[:, rows, :vehicles],
                react=None if react is None else partial(react, rows),
                before=context,
            )
            part, x0, context = self.replan_group(replan)
            plan = self.prior.plan(x0, context)
            part = replace(
                part,
                replans=part.replans + 1,
                lane=plan.after(REPLAN_STEPS),
            )
            write_state(whole, part, group=group)
            states[rows, :vehicles] = plan.states()
            # A vehicle that has left does not return.
            present[rows, :vehicles] = plan.on_map & world.valid[rows, :vehicles, None]
        return whole, TrafficPlan(states, present, route=whole.routed.route)

    @torch.no_grad()
    def as_seen(self, world: World) -> World:
        """Returns the World as other drivers see it: the ego's mission is the route
        that it is expected to follow, the one that its present motion makes likeliest;
        told its plan, they know its mission, too."""
        if self.knowledge == "plan":
            return world
        scene = world.scene.copy()
        scene["route_valid"] = scene["route_valid"] & ~scene["route_recorded"]
        ego = Moment(world.states[:, :1], world.turn_rate[:, :1], step=world.step)
        route = self.prior.route_choice(scene, ego).argmax(-1)
        scene["route_log"] = torch.cat([route, scene["route_log"][:, 1:]], 1)
        return replace(world, scene=scene)

    def _expecting(self, state: State, world: World) -> State:
        """Returns the state with the ego on the route that it is expected to follow."""
        route = state.routed.route
        expected = torch.cat([world.scene["route_log"][:, :1], route[:, 1:]], 1)
        moved = expected != route
        if not bool(moved.any()):
            return state
        return onto(state, world, route=expected, moved=moved)

    def replan_group(self, replan: Replan) -> tuple[State, Tensor, Context]:
        """Returns state, joint sample x0 [G, V, SIZE] and context of a group."""
        context = self.encode(
            replan.state,
            replan.world,
            ego_plan=replan.ego_plan,
            known=replan.before,
        )
        return replan.state, self.prior.sample(context, replan.noise).x0, context

    @torch.no_grad()
    def predicted_ego(self, state: State, world: World) -> tuple[Tensor, Context]:
        """Returns states [G, HORIZON, 4] of the ego, predicted from its state and past:
        its row of the joint clean estimate, which is nearer to what egos drive than a
        sample; and the context of that."""
        action = torch.stack([world.accel[:, 0], world.turn_rate[:, 0]], -1)
        actions = action[:, None].expand(-1, HORIZON, -1)
        going_on = dynamics.rollout(world.states[:, 0], actions)
        lane = self.lane_now(state, world, ego_plan=going_on)
        context = self.prior.encode(state.routed, lane, world)
        plans = self.prior.decode(self.prior.estimate(context), context)
        return plans.states()[:, 0], context

    def route_noise(self, seed: Tensor, vehicles: int) -> Tensor:
        """Returns uniform numbers [B, V] that draw the routes of `vehicles`."""
        first = torch.zeros_like(seed)
        return noise_of(seed, first, shape=(vehicles,), uniform=True)

    def noise(self, state: State) -> Tensor:
        """Returns standard normal noise [K, B, V, SIZE] of the next replan."""
        shape = (self.prior.sampler.steps, state.routed.route.shape[1], SIZE)
        return noise_of(state.seed, 1 + state.replans, shape=shape).transpose(0, 1)

    def encode(
        self,
        state: State,
        world: World,
        ego_plan: Tensor,
        known: Context | None = None,
    ) -> Context:
        """Returns the prior's context of a replan.

        Args:
            state: of G scenes.
            world: the scenes now.
            ego_plan: [G, HORIZON, 4], the ego's expected states.
            known: see `Prior.encode`.
        """
        return self.prior.encode(
            state.routed,
            state.lane,
            world,
            ego_plan=ego_plan,
            known=known,
        )

    def lane_now(self, state: State, world: World, ego_plan: Tensor) -> LaneState:
        """Returns the current lane states: the ego's from its state and planned yaw
        rate; the others' places on their routes from their states, how they go on from
        their plans."""
        lane = state.lane
        routed = state.routed
        yaw_rate = wrap(ego_plan[:, LOOK - 1, 2] - world.states[:, 0, 2]) / (LOOK * DT)
        ego = torch.zeros_like(routed.parked)
        ego[:, 0] = True
        v = torch.where(ego, world.states[:, :1, 3], lane.v)
        projected = locate(
            world.states[:, : ego.shape[1]],
            torch.where(ego, world.accel[:, :1], lane.a),
            yaw_rate=torch.where(ego, yaw_rate[:, None], lane.kappa * lane.v),
            points=routed.points,
            hint=lane.s + ego * v / 2,
        )
        everybody = torch.ones_like(ego)
        replaced = {"s": everybody, "d": everybody, "d1": everybody}
        replaced["d2"] = ego | ~routed.has_lane
        merged = {
            field.name: torch.where(
                replaced.get(field.name, ego),
                getattr(projected, field.name),
                getattr(lane, field.name),
            )
            for field in fields(LaneState)
        }
        return LaneState(**merged)


def onto(
    state: Own,
    world: World,
    *,
    route: Tensor,
    moved: Tensor,
    off_lane: Tensor | None = None,
    paths: Tensor | None = None,
) -> Own:
    """Returns states with vehicles on other routes or paths, and with their poses
    there.

    Args:
        state: of B scenes.
        world: the scenes now.
        route: [B, V] int64, candidates.
        moved: [B, V] bool, who is moved.
        off_lane: [B, V] bool, who is moved on a path instead (None: nobody).
        paths: [B, V, P, 2] m.
    """
    if off_lane is None:
        off_lane = torch.zeros_like(moved)
    if paths is None:
        paths = state.routed.points
    routed = reroute(
        state.routed,
        world.scene,
        route=route,
        moved=moved,
        off_lane=off_lane,
        off_lane_path=paths,
    )
    lane = locate(
        world.states[:, : route.shape[1]],
        state.lane.a,
        yaw_rate=state.lane.kappa * state.lane.v,
        points=routed.points,
    )
    return replace(state, routed=routed, lane=select(moved, lane, other=state.lane))
