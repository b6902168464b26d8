"""Egos that map the environment's observation to an action; their plan is a rollout of their own policy."""

from abc import abstractmethod

import torch
from torch import Tensor

from e2rl.planners.ego import PLAN_STEPS, Ego
from e2rl.scenes.recording import DT
from e2rl.scenes.route import project
from e2rl.sim import dynamics
from e2rl.sim.mission import mission_of
from e2rl.sim.observation import EgoState, observation_config, observe
from e2rl.sim.static import FrenetPose, static_scene
from e2rl.sim.world import Agents, World

HOLD = 5  # steps for which a planned action is held: 10 evaluations of the policy per plan


class ObservingEgo(Ego):
    """Drives by `decide`, at every step."""

    def __init__(self) -> None:
        super().__init__(replan_every=HOLD)

    @abstractmethod
    def decide(self, observation: Tensor) -> Tensor:
        """Action [B, 2] (acceleration [m/s^2], yaw rate [rad/s]) at observations [B, OBSERVATION_SIZE]."""

    @torch.no_grad()
    def act(self, world: World, observation: Tensor, plan: Tensor) -> Tensor:
        """The action [B, 2] at the observation; the plan is ignored."""
        return self.decide(observation)

    @torch.no_grad()
    def plan(self, world: World) -> Tensor:
        """Planned states [B, PLAN_STEPS, 4]: the policy rolled forward, each action held HOLD steps.

        Vehicles follow their plans where these are known; all other agents keep their velocity.
        """
        static, expected = static_scene(world.scene, mission_of(world.scene)), expected_states(world)
        config, horizon = observation_config(world.states.device), world.scene["logged"].shape[1] - 1
        state, present = world.states[:, 0], world.valid[:, 0]
        assert world.turn_rate is not None
        action = torch.stack([world.accel[:, 0], world.turn_rate[:, 0]], -1)
        pieces = []
        for done in range(0, PLAN_STEPS, HOLD):
            pose = FrenetPose(*(value[:, 0] for value in project(state[:, None, :2], static.mission.points)))
            ego = EgoState(world.step + done, state, action, pose, present, present, pose.s)
            seen = observe(config, static, ego, others_at(world, expected, done), horizon)
            action = self.decide(seen.features)
            driven = dynamics.rollout(state, action[:, None].expand(-1, HOLD, -1))
            last_two = torch.cat([state[:, None], driven], 1)[:, -2:]
            state, action = driven[:, -1], dynamics.inverse(last_two)[:, 0]
            pieces.append(driven)
        return torch.cat(pieces, 1)


def others_at(world: World, expected: Tensor, step: int) -> Agents:
    """All agents but the ego `step` steps from now, by their expected states [B, N, PLAN_STEPS + 1, 4]."""
    present, states = world.valid[:, 1:], expected[:, 1:, step]
    if step == 0:
        assert world.turn_rate is not None
        return Agents(states, present, world.accel[:, 1:], world.turn_rate[:, 1:])
    change = states - expected[:, 1:, step - 1]
    return Agents(states, present, change[..., 3] / DT, dynamics.wrap(change[..., 2]) / DT)


def expected_states(world: World) -> Tensor:
    """States [B, N, PLAN_STEPS + 1, 4] of all agents at steps 0.. from now: as planned, else at constant velocity."""
    now = world.states[:, :, None]
    time = DT * torch.arange(PLAN_STEPS + 1, device=now.device, dtype=now.dtype)
    expected = dynamics.constant_velocity(world.states, time)
    if world.plan is None:
        return expected
    vehicles = world.plan.shape[1]
    planned = torch.cat([now[:, :vehicles], world.plan[:, :, :PLAN_STEPS]], 2)
    return torch.cat([planned, expected[:, vehicles:]], 1)
