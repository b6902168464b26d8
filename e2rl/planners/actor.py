"""Egos that map the environment's observation to an action, the learned one among them."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.planners.ego import PLAN_STEPS, Ego
from e2rl.planners.evader import Evader
from e2rl.planners.network import ActorCritic, Architecture, find_weights, read_actor
from e2rl.run.config import configured, setting
from e2rl.run.errors import InputError
from e2rl.scenes.recording import DT
from e2rl.sim import dynamics
from e2rl.sim.mission import mission_of
from e2rl.sim.observation import features, placed_ego
from e2rl.sim.static import static_scene
from e2rl.sim.world import Agents, World

HOLD = 5  # steps for which a planned action is held: 10 evaluations of the policy


class ObservingEgo(Ego):
    """Drives by `decide`, at every step."""

    replan_every = HOLD

    @abstractmethod
    def decide(self, observation: Tensor) -> Tensor:
        """Action [B, 2] (acceleration [m/s^2], yaw rate [rad/s]) at observations [B,
        OBSERVATION_SIZE]."""

    def corrected(self, world: World, observation: Tensor, plan: Tensor) -> Tensor:
        """The plan [B, PLAN_STEPS, 4] that is announced at the observation, where it is
        not what `decide` leads to."""
        return plan

    @torch.no_grad()
    def act(
        self,
        world: World,
        observation: Tensor,
        plan: Tensor,
    ) -> Tensor:
        """The action [B, 2] at the observation; the plan is ignored."""
        return self.decide(observation)

    @torch.no_grad()
    def plan(self, world: World) -> Tensor:
        """Planned states [B, PLAN_STEPS, 4]: the policy rolled forward, each action
        held HOLD steps.

        Vehicles follow their plans where these are known; all other agents keep their
        velocity.
        """
        static = static_scene(world.scene, mission_of(world.scene))
        expected = expected_states(world)
        horizon = world.scene["logged"].shape[1] - 1
        present = world.valid[:, 0]
        state = world.states[:, 0]
        action = world.ego_action()
        place = world.mission_s
        parts = []
        for step in range(0, PLAN_STEPS, HOLD):
            ego = placed_ego(
                static.mission,
                state,
                step=world.step + step,
                action=action,
                present=present,
                place=place,
                others=static.vehicle,
            )
            others = others_at(world, expected, step=step)
            observation = features(static, ego, others, ego.step / horizon)
            if step == 0:
                present_observation = observation
            action = self.decide(observation)
            driven = dynamics.rollout(state, action[:, None].expand(-1, HOLD, -1))
            last_two = torch.cat([state[:, None], driven], 1)[:, -2:]
            action = dynamics.inverse(last_two)[:, 0]
            state = driven[:, -1]
            place = ego.pose.s + DT * driven[..., 3].sum(1)
            parts.append(driven)
        return self.corrected(world, present_observation, torch.cat(parts, 1))


def others_at(
    world: World,
    expected: Tensor,
    step: int,
) -> Agents:
    """All agents but the ego `step` steps from now, by their expected states [B, N,
    PLAN_STEPS + 1, 4]."""
    if step == 0:
        return world.others()
    states = expected[:, 1:, step]
    change = states - expected[:, 1:, step - 1]
    return Agents(
        states,
        world.valid[:, 1:],
        accel=change[..., 3] / DT,
        turn_rate=dynamics.wrap(change[..., 2]) / DT,
    )


def expected_states(world: World) -> Tensor:
    """States [B, N, PLAN_STEPS + 1, 4] of all agents at steps 0.. from now: as planned,
    else at constant velocity."""
    states = world.states
    times = DT * torch.arange(PLAN_STEPS + 1, device=states.device, dtype=states.dtype)
    expected = dynamics.constant_velocity(states, times)
    if world.plan is None:
        return expected
    vehicles = world.plan.shape[1]
    start = states[:, :vehicles, None]
    planned = torch.cat([start, world.plan[:, :, :PLAN_STEPS]], 2)
    return torch.cat([planned, expected[:, vehicles:]], 1)


@configured("ego/actor")
@dataclass(eq=False)
class ActorEgo(ObservingEgo):
    """Drives by the actor's most central action; the learner updates `network` in
    place."""

    hidden: Sequence[int] = setting()
    agent_units: int = setting(low=1)
    reference: bool = setting()
    slack: float | None = setting(low=0, optional=True)
    room: float | None = setting(low=0.1, optional=True)
    evades: bool = setting()
    initial_std: Sequence[float] = setting()
    max_acceleration: float = setting()
    max_braking: float = setting()
    max_yaw_rate: float = setting()
    checkpoint: str | None = setting()
    device: str = setting()

    def __post_init__(self) -> None:
        """Raises InputError for a checkpoint that is missing or whose actions have
        other bounds."""
        if not self.hidden:
            raise InputError("ego.hidden=[]: give the units of one layer at least")
        if self.evades and (self.room is None or not self.reference):
            raise InputError(
                "ego.evades=true: it needs ego.room, which says what danger is, and "
                "ego.reference=true"
            )
        low = (-float(self.max_braking), -float(self.max_yaw_rate))
        high = (float(self.max_acceleration), float(self.max_yaw_rate))
        architecture = Architecture(
            low,
            high,
            hidden=tuple(self.hidden),
            agent_units=self.agent_units,
            reference=self.reference,
            slack=self.slack,
            room=self.room,
            evades=self.evades,
        )
        self.network = ActorCritic(architecture, self.initial_std, self.device)
        if self.checkpoint is not None:
            path = find_weights(self.checkpoint)
            self.network = read_actor(path, self.device)
            saved = self.network.architecture
            if (saved.low, saved.high) != (low, high):
                raise InputError(
                    f"{path}: its actions have the bounds {saved.low}, {saved.high}, not "
                    f"{low}, {high}; set sim.max_* as in its run"
                )

        self.evader: Evader | None = None
        architecture = self.network.architecture
        if architecture.evades and architecture.room is not None:
            self.evader = Evader(architecture.room)

    def decide(self, observation: Tensor) -> Tensor:
        """Most central action [B, 2] at the observation, if nobody evades."""
        return self.network.network.deterministic(observation)

    @torch.no_grad()
    def act(self, world: World, observation: Tensor, plan: Tensor) -> Tensor:
        """Most central action [B, 2]."""
        if self.evader is None:
            return self.decide(observation)
        evasion = self.evader.actions(world, observation)
        return self.network.network.deterministic(observation, evasion)

    def corrected(self, world: World, observation: Tensor, plan: Tensor) -> Tensor:
        """The evader's plan in danger."""
        if self.evader is None:
            return plan
        rows = self.evader.endangered(observation)
        if not len(rows):
            return plan
        return plan.index_copy(0, rows, self.evader.plans(world, rows))
