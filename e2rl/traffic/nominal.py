"""The prior as background traffic: every 0.5 s a joint sample of the reverse SDE, given the ego's plan, no control.

What traffic knows of the ego: what other drivers see, or the plan that it announces (docs/adversaries.md).

A black box announces nothing. With `predicted`, the ego's motion is predicted from its state and past alone, so that no
planner can mislead its adversaries by what it writes as its plan.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.planners.path import MissionPath
from e2rl.prior.lane_relative import HORIZON, SIZE, LaneState, locate
from e2rl.prior.prior import Context, Prior
from e2rl.prior.routes import RoutedScene
from e2rl.prior.stratified_sampling import main_direction, stratified_noise, stratified_uniform
from e2rl.run.settings import check_choice
from e2rl.scenes.recording import DT
from e2rl.sim import dynamics
from e2rl.sim.dynamics import wrap
from e2rl.sim.world import World
from e2rl.traffic.grouping import Group, clone, crop_state, crop_world, group_scenes, noise_of, write_state
from e2rl.traffic.traffic import REPLAN_STEPS, State, Traffic, TrafficPlan

KNOWLEDGE = ("predicted", "plan")
EASING = 0.5  # s in which a seen acceleration fades: of 0.5, 1 and 2 s that of least error


def turn_rate_and_acceleration(world: World) -> Tensor:
    """States [B, HORIZON, 4] of the ego at its present acceleration and yaw rate."""
    assert world.turn_rate is not None
    action = torch.stack([world.accel[:, 0], world.turn_rate[:, 0]], -1)
    return dynamics.rollout(world.states[:, 0], action[:, None].expand(-1, HORIZON, -1))


def along_mission(world: World) -> Tensor:
    """States [B, HORIZON, 4] of the ego along its mission, its acceleration fading over EASING s."""
    time = DT * torch.arange(HORIZON + 1, device=world.states.device)
    gained = EASING * (1 - torch.exp(-time / EASING))
    return MissionPath(world).drive((world.states[:, 0, 3:] + world.accel[:, :1] * gained).clamp(min=0))


# Predictions without a network; `prior` is NominalTraffic's own: the ego's row of the joint estimate.
PREDICTIONS: dict[str, Callable[[World], Tensor] | None] = {
    "prior": None,
    "mission": along_mission,
    "ctra": turn_rate_and_acceleration,
}


LOOK = 5  # steps of the ego's plan over which its current yaw rate is estimated


@dataclass
class PriorState:
    """B scenes driven by the prior; every tensor has the batch first.

    seed [B]: of the scene's noise; replans [B]: replans so far; routed: the vehicles' routes; lane [B, V]: lane states
    at the end of the executed plans.
    """

    seed: Tensor
    replans: Tensor
    routed: RoutedScene
    lane: LaneState


class NominalTraffic(Traffic):
    """Unguided samples of the frozen prior; the ego's row of the joint state is what is known of its motion."""

    def __init__(self, prior: Prior, knowledge: str = "predicted", prediction: str = "prior") -> None:
        """knowledge: of KNOWLEDGE; prediction: of PREDICTIONS, used where the ego's plan is not known.

        Raises InputError for other choices.
        """
        check_choice("synthesizer.knowledge", knowledge, KNOWLEDGE)
        check_choice("synthesizer.prediction", prediction, PREDICTIONS)
        self.prior = prior.requires_grad_(False).eval()
        self.knowledge, self.prediction = knowledge, prediction

    def reset(self, scenes: TensorDictBase, seed: Tensor, eta: Tensor) -> State:
        """States of scenes [B] with routes drawn from the prior."""
        uniform = noise_of(seed, torch.zeros_like(seed), tuple(scenes["route_valid"].shape[1:2]), uniform=True)
        routed, lane = self.prior.start(scenes, self.prior.choose_routes(scenes, uniform))
        return PriorState(seed, torch.zeros_like(seed), routed, lane)

    def replan(self, state: State, world: World, ego_plan: Tensor) -> tuple[State, TrafficPlan]:
        """States and plans of the coming HORIZON steps; scenes of similar size are planned together."""
        ego_plan, noise = ego_plan.detach(), self.noise(state)
        batch, width = state.routed.route.shape
        whole = clone(state)
        states = world.states.new_zeros(batch, width, HORIZON, 4)
        present = torch.zeros(batch, width, HORIZON, dtype=torch.bool, device=states.device)
        for group in group_scenes(world):
            rows, vehicles = group.rows, group.vehicles
            part, there = crop_state(state, group, width), crop_world(world, group)
            known = ego_plan[rows] if self.knowledge == "plan" else self.predicted_ego(part, there)
            part, x0, context = self.replan_group(part, there, known, noise[:, rows, :vehicles], group)
            plan = self.prior.plan(x0, context)
            part = replace(part, replans=part.replans + 1, lane=plan.after(REPLAN_STEPS))
            write_state(whole, part, group)
            states[rows, :vehicles] = plan.states()
            valid = world.valid[rows, :vehicles, None]  # a vehicle that has left does not return
            present[rows, :vehicles] = plan.on_map & valid
        return whole, TrafficPlan(states, present, route=whole.routed.route)

    def replan_group(
        self, state: State, world: World, ego_plan: Tensor, noise: Tensor, group: Group
    ) -> tuple[State, Tensor, Context]:
        """State, joint sample x0 [G, V, SIZE] and context of a group; noise [K, G, V, SIZE]."""
        state = replace(state, lane=self.lane_now(state, world, ego_plan))
        context = self.encode(state, world, ego_plan)
        return state, self.prior.sample(context, noise).x0, context

    @torch.no_grad()
    def predicted_ego(self, state: State, world: World) -> Tensor:
        """States [G, HORIZON, 4] of the ego predicted from its state and past (PREDICTIONS).

        `prior`: the ego's row of the joint clean estimate, nearer to what egos drive than a sample.
        """
        seen = turn_rate_and_acceleration(world)
        predict = PREDICTIONS[self.prediction]
        if predict is not None:
            return predict(world)
        lane = self.lane_now(state, world, seen)
        context = self.prior.encode(state.routed, lane, world.states, world.valid, world.step, None)
        return self.prior.decode(self.prior.estimate(context), context).states()[:, 0]

    def noise(self, state: State) -> Tensor:
        """Standard normal noise [K, B, V, SIZE] of the next replan."""
        shape = (self.prior.sampler.steps, state.routed.route.shape[1], SIZE)
        return noise_of(state.seed, 1 + state.replans, shape).transpose(0, 1)

    def encode(self, state: State, world: World, ego_plan: Tensor) -> Context:
        """The prior's context of a replan."""
        now = world.states, world.valid, world.step
        return self.prior.encode(state.routed, state.lane, *now, ego_plan)

    def lane_now(self, state: State, world: World, ego_plan: Tensor) -> LaneState:
        """Current lane states: the ego's from its simulated state and planned yaw rate, the others' from their plans.

        Plans in free space have no route, so their arc lengths and offsets come from a projection.
        """
        lane, routed = state.lane, state.routed
        yaw_rate = wrap(ego_plan[:, LOOK - 1, 2] - world.states[:, 0, 2]) / (LOOK * DT)
        ego = torch.zeros_like(routed.parked)
        ego[:, 0] = True
        v = torch.where(ego, world.states[:, :1, 3], lane.v)
        accel = torch.where(ego, world.accel[:, :1], lane.a)
        turning = torch.where(ego, yaw_rate[:, None], lane.kappa * lane.v)
        now = locate(world.states[:, : ego.shape[1]], accel, turning, routed.points, lane.s + ego * v / 2)
        projected = {name: ego | ~routed.has_lane for name in ("s", "d", "d1", "d2")}

        def merged(name: str) -> Tensor:
            return torch.where(projected.get(name, ego), getattr(now, name), getattr(lane, name))

        return LaneState(*(merged(field.name) for field in fields(LaneState)))

    @torch.no_grad()
    def open_loop_plans(self, scene: TensorDictBase, seed: Tensor) -> Tensor:
        """Joint samples [B, S, V, HORIZON, 4] beside an ego whose plan is unknown, stratified over the S samples.

        No acceleration bounds are applied: they hold for the executed 0.5 s, and the current bounds applied over 5 s
        would make the samples a tenth less accurate.
        """
        prior, (count, batch), vehicles = self.prior, seed.shape, scene["route_log"].shape[1]

        def draw(number: int, *shape: int, uniform: bool = False) -> Tensor:
            numbers = torch.full((count * batch,), number)
            return noise_of(seed.flatten(), numbers, shape, uniform).unflatten(0, (count, batch))

        order, position = draw(0, 2, vehicles, uniform=True).unbind(2), draw(2, 2, vehicles, uniform=True)[0].unbind(1)
        noise = draw(1, prior.sampler.steps, vehicles, SIZE).transpose(1, 2)
        direction = main_direction(prior.schedule, prior.sampler, noise.device)
        noise = stratified_noise(noise, direction, order[1], position[1])
        step, plans = torch.zeros(batch, dtype=torch.long, device=seed.device), []
        for uniform, one in zip(stratified_uniform(order[0], position[0]), noise, strict=True):
            routed, lane = prior.start(scene, prior.choose_routes(scene, uniform))
            context = prior.encode(routed, lane, scene["start"], scene["valid"], step, None)
            plans.append(prior.decode(prior.sample(context, one).x0, context).states())
        return torch.stack(plans, 1)
