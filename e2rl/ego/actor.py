"""The learned ego: acts from the environment's observation, and plans by what it expects itself to do."""

from collections.abc import Sequence

import torch
from torch import Tensor

from e2rl.ego.base import PLAN_STEPS, Ego
from e2rl.ego.network import ActorCritic, find_weights
from e2rl.scene.recording import DT
from e2rl.scene.route import project
from e2rl.sim import dynamics
from e2rl.sim.around import axes, look_around
from e2rl.sim.mission import mission_of
from e2rl.sim.observation import EgoState, lens, observe, probe
from e2rl.sim.setting import Place, Setting, setting_of
from e2rl.sim.world import World

HOLD = 5  # steps for which a planned action is held: 10 evaluations of the network per plan


class ActorEgo(Ego):
    """Drives by the actor's most central action; `network` is what the learner improves, in place."""

    def __init__(
        self,
        hidden: Sequence[int] = (256, 256),
        reference: bool = True,
        initial_std: Sequence[float] = (0.12, 0.04),
        max_acceleration: float = 5.0,
        max_braking: float = 8.0,
        max_yaw_rate: float = 1.6,
        checkpoint: str | None = None,
        device: str = "cpu",
    ) -> None:
        """Fields: conf/ego/actor.yaml. Raises InputError where the checkpoint is missing or does not fit."""
        super().__init__(replan_every=1)
        low, high = torch.tensor([-max_braking, -max_yaw_rate]), torch.tensor([max_acceleration, max_yaw_rate])
        self.network = ActorCritic(low, high, hidden, reference, initial_std, device)
        if checkpoint is not None:
            self.network.load(find_weights(checkpoint))
        self._seen: tuple[Tensor, Tensor, Tensor] | None = None  # step, ego's state and yaw rate when it last acted

    def reset(self, world: World) -> None:
        """Forget what was seen where the number of scenes changed; a scene at step 0 starts from its own estimate."""
        if self._seen is not None and len(self._seen[0]) != len(world.step):
            self._seen = None

    @torch.no_grad()
    def act(self, world: World, observation: Tensor | None = None) -> Tensor:
        """Action [B, 2]; the observation [B, D] is taken from the world where none is given."""
        yaw_rate = self._yaw_rate(world)
        self._seen = (world.step.clone(), world.states[:, 0].clone(), yaw_rate)
        if observation is None:
            action = torch.stack([world.accel[:, 0], yaw_rate], -1)
            observation = _look(world, setting_of(world.scene, mission_of(world.scene)), world.states[:, 0], action)
        return self.network.network.deterministic(observation)

    @torch.no_grad()
    def plan(self, world: World) -> Tensor:
        """Planned states [B, PLAN_STEPS, 4]: the policy rolled forward, each action held HOLD steps.

        The others move as they plan to, or at constant velocity where nobody plans.
        """
        setting, future = setting_of(world.scene, mission_of(world.scene)), _others(world)
        ego, action = world.states[:, 0], torch.stack([world.accel[:, 0], self._yaw_rate(world)], -1)
        pieces = []
        for done in range(0, PLAN_STEPS, HOLD):
            now = World(
                scene=world.scene,
                step=world.step + done,
                states=torch.cat([ego[:, None], future[:, 1:, done]], 1),
                valid=world.valid,
                accel=torch.cat([action[:, :1], _accelerations(world, future, done)], 1),
                route=world.route,
            )
            action = self.network.network.deterministic(_look(now, setting, ego, action))
            driven = dynamics.rollout(ego, action[:, None].expand(-1, HOLD, -1))
            last_two = torch.cat([ego[:, None], driven], 1)[:, -2:]
            ego, action = driven[:, -1], dynamics.inverse(last_two)[:, 0]
            pieces.append(driven)
        return torch.cat(pieces, 1)

    def _yaw_rate(self, world: World) -> Tensor:
        """Executed yaw rate [B] that led to this moment, as the environment reports it in the observation.

        The World does not hold it, so it is the turn since this ego last acted, one step ago; before that, the scene's
        estimate at the start and 0 for an ego that has not acted before.
        """
        first = torch.where(world.step == 0, world.scene["start_yaw_rate"][:, 0], 0.0)
        if self._seen is None or len(self._seen[0]) != len(world.step):
            return first
        step, state, before = self._seen
        turned = dynamics.wrap(world.states[:, 0, 2] - state[:, 2]) / DT
        known = torch.where(step == world.step, before, torch.where(step == world.step - 1, turned, 0.0))
        return torch.where(world.step == 0, first, known)


def _look(world: World, setting: Setting, ego: Tensor, action: Tensor) -> Tensor:
    """Observation [B, D] of a world, the environment's function."""
    place = Place(*(value[:, 0] for value in project(ego[:, None, :2], setting.points)))
    turn, glass = axes(ego), lens(ego.device)
    around = look_around(ego, turn, setting, world.states[:, 1:], world.valid[:, 1:], world.accel[:, 1:])
    horizon = world.scene["logged"].shape[1] - 1
    return observe(
        glass,
        setting,
        EgoState(ego, turn, action, place),
        world.step,
        horizon,
        probe(glass, setting, ego, turn),
        around,
    )[0]


def _others(world: World) -> Tensor:
    """States [B, N, PLAN_STEPS + 1, 4] of everyone at steps 0.. from now: as planned, else at constant velocity."""
    now = world.states[:, :, None]
    if world.plan is not None and world.plan.shape[2] >= PLAN_STEPS:
        return torch.cat([now, world.plan[:, :, :PLAN_STEPS]], 2)
    time = DT * torch.arange(PLAN_STEPS + 1, device=now.device, dtype=now.dtype)[:, None]
    velocity = now[..., 3:] * torch.stack([now[..., 2].cos(), now[..., 2].sin()], -1)
    straight = now[..., :2] + velocity * time
    return torch.cat([straight, now[..., 2:].expand(*straight.shape[:-1], 2)], -1)


def _accelerations(world: World, future: Tensor, step: int) -> Tensor:
    """Accelerations [B, N - 1] of the others at planned step `step`: now as observed, later as planned."""
    if step == 0:
        return world.accel[:, 1:]
    return (future[:, 1:, step, 3] - future[:, 1:, step - 1, 3]) / DT
