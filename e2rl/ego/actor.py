"""The learned ego: acts on the environment's observation; its plan is a rollout of its own policy."""

from collections.abc import Sequence

import torch
from torch import Tensor

from e2rl.ego.base import PLAN_STEPS, Ego
from e2rl.ego.network import ActorCritic, find_weights
from e2rl.scene.recording import DT
from e2rl.scene.route import project
from e2rl.sim import dynamics
from e2rl.sim.mission import mission_of
from e2rl.sim.observation import EgoState, observation_config, observe
from e2rl.sim.static import FrenetPose, static_scene
from e2rl.sim.trajectories import Agents
from e2rl.sim.world import World

HOLD = 5  # steps for which a planned action is held: 10 network evaluations per plan


class ActorEgo(Ego):
    """Drives by the actor's most central action; the learner updates `network` in place."""

    def __init__(
        self,
        hidden: Sequence[int] = (256, 256),
        reference: bool = True,
        initial_std: Sequence[float] = (0.25, 0.12),
        max_acceleration: float = 5.0,
        max_braking: float = 8.0,
        max_yaw_rate: float = 1.6,
        checkpoint: str | None = None,
        device: str = "cpu",
    ) -> None:
        """Fields: conf/ego/actor.yaml. Raises InputError if the checkpoint is missing or does not fit."""
        super().__init__(replan_every=HOLD)
        low, high = torch.tensor([-max_braking, -max_yaw_rate]), torch.tensor([max_acceleration, max_yaw_rate])
        self.network = ActorCritic(low, high, hidden, reference, initial_std, device)
        if checkpoint is not None:
            self.network.load(find_weights(checkpoint))

    @torch.no_grad()
    def act(self, world: World, observation: Tensor, plan: Tensor) -> Tensor:
        """Most central action [B, 2] at the observation; the plan is ignored."""
        return self.network.network.deterministic(observation)

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
            action = self.network.network.deterministic(seen.features)
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
