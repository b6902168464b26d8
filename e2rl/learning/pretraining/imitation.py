"""Demonstrations (observation, action) of recorded egos, and the actor's warm start
from them.

Demonstrations come in two kinds. Replayed: the ego follows its log exactly and the
action is the inverse unicycle's. Disturbed: the ego tracks its log while its actions
are perturbed for a second at a time (Laskey et al. 2017), so they show recoveries; the
label is the undisturbed action.

During cloning, noise is added to the network's input, most to the last executed action:
actions are strongly autocorrelated, so the actor would copy it instead of learning its
causes (de Haan et al. 2019).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from e2rl.evaluation.build import build_ego, build_sim
from e2rl.learning.logging import RunLogger
from e2rl.learning.pretraining.cloning import (
    INPUT_NOISE,
    LAST_ACTION_NOISE,
    clip_expert,
    cloning_loss,
)
from e2rl.learning.pretraining.supervised import Epochs, EpochSettings, stage_settings
from e2rl.planners.actor import ActorEgo
from e2rl.planners.ego_policy import EgoPolicy
from e2rl.planners.log_replay import ReplayEgo
from e2rl.planners.network import WEIGHTS, ActorCritic
from e2rl.run.config import configured
from e2rl.run.errors import InputError
from e2rl.run.parts import Parts
from e2rl.run.run import Run
from e2rl.run.terminal import Bar
from e2rl.scenes.recording import DT
from e2rl.scenes.scene import SceneSet
from e2rl.scenes.scene_list import listed
from e2rl.scenes.source import load_scenes
from e2rl.sim.dynamics import wrap
from e2rl.sim.env import DrivingEnv
from e2rl.sim.settings import SimSettings
from e2rl.traffic.pool import TrafficPool
from e2rl.traffic.transform import AdversarialSynthesizer

BURST = 10  # steps of a disturbance
PAUSE = 20  # steps from the start of a disturbance to the next
DISTURBED = (1.0, 0.15)  # m/s^2, rad/s: standard deviations of the disturbances
DRIVES = 3  # of a scene under disturbances, besides its exact replay
BATCH = 64  # environments that run at once
WEIGHT_DECAY = 1e-2
# (action [B, 2], step [B]) -> the action [B, 2] that is executed instead
Disturbance = Callable[[Tensor, Tensor], Tensor]


@configured("stage/imitation")
@dataclass(frozen=True, kw_only=True)
class ImitationSettings(EpochSettings):
    """Settings of stage=imitation."""


def recorded_demonstrations(
    scenes: SceneSet,
    sim: SimSettings,
    *,
    seed: int,
    drives: int = DRIVES,
) -> TensorDict:
    """Returns demonstrations of the recorded egos.

    Every recording is replayed once, and driven `drives` times under disturbances. A
    disturbed episode counts until contact or off the road; actions are clipped to 0.99
    of the bounds.

    Args:
        scenes: the recordings.
        sim: settings of the simulator.
        seed: of the disturbances.
        drives: of each scene under disturbances.

    Returns:
        [M] with scene_index [M] (e2rl/learning/pretraining/cloning.py), on the CPU.
    """
    generator = torch.Generator().manual_seed(seed)
    batch = min(BATCH, len(scenes))
    replay = replace(sim, replay_ego=True, end_on_contact=False, end_off_road=False)
    exact = DrivingEnv(scenes, replay, batch, agents=True)
    free = DrivingEnv(scenes, replace(sim, replay_ego=False), batch, agents=True)
    turns = -(-len(scenes) // batch)  # the last one is filled up by repetition
    batches = (torch.arange(turns * batch) % len(scenes)).split(batch)
    jobs = [(rows, number) for number in range(drives + 1) for rows in batches]
    parts = []
    for rows, number in Bar(jobs, "demonstrations", unit="batch", leave=False):
        if number:
            parts.append(shown(free, rows, _bursts(batch, generator)))
        else:
            parts.append(shown(exact, rows))
    return torch.cat(parts)


def shown(
    env: DrivingEnv,
    scenes: Tensor,
    disturb: Disturbance | None = None,
) -> TensorDict:
    """Demonstrations [M] of egos that follow their logs for an episode in scenes [B],
    of an environment's batch: what they executed, or under disturbances meant to."""
    transform = AdversarialSynthesizer(
        TrafficPool.recorded(scenes), lambda count: torch.arange(count)
    )
    driven = TransformedEnv(env, transform)
    policy = EgoPolicy(ReplayEgo(), driven)

    def disturbed(tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = policy(tensordict)
        tensordict["intended"] = action = tensordict["action"]
        if disturb is not None:
            tensordict["action"] = disturb(action, tensordict["timestep"][:, 0])
        return tensordict

    steps = driven.rollout(env.horizon, disturbed, break_when_any_done=False)
    ends = steps["next", "done"][..., 0].int()
    alive = ends.cumsum(1) - ends == 0
    action = executed(steps) if disturb is None else steps["intended"]
    bounds = env.action_spec.space
    return TensorDict(
        {
            "observation": steps["observation"][alive],
            "action": clip_expert(action[alive], bounds.low[0], high=bounds.high[0]),
            "scene_index": scenes[:, None].expand_as(alive)[alive],
        },
        batch_size=[int(alive.sum())],
    )


def executed(steps: TensorDictBase) -> Tensor:
    """Accelerations and yaw rates [B, T, 2] (m/s^2, rad/s) of the ego in the steps of a
    rollout."""
    before = steps["agents", "states"][:, :, 0]
    after = steps["next", "agents", "states"][:, :, 0]
    turn = wrap(after[..., 2:3] - before[..., 2:3])
    return torch.cat([after[..., 3:] - before[..., 3:], turn], -1) / DT


def _bursts(batch: int, generator: torch.Generator) -> Disturbance:
    """Constant offsets of random size for BURST steps out of every PAUSE, at a random
    phase per scene."""
    size = torch.tensor(DISTURBED)
    offsets = torch.randn(batch, 100, 2, generator=generator) * size
    phase = torch.randint(PAUSE, (batch,), generator=generator)

    def disturb(action: Tensor, step: Tensor) -> Tensor:
        time = step.cpu() + phase
        offset = offsets[torch.arange(batch), time // PAUSE]
        return action + (offset * (time % PAUSE < BURST)[:, None]).to(action.device)

    return disturb


class Imitation(Epochs):
    """Behaviour cloning of an ActorCritic's actor from demonstrations."""

    def __init__(
        self,
        network: ActorCritic,
        shown: TensorDictBase,
        settings: ImitationSettings,
    ) -> None:
        super().__init__(network, shown, settings, network.network, WEIGHT_DECAY)

    def loss(self, batch: TensorDictBase) -> Tensor:
        """The cloning loss [] under noise on the input."""
        with self.network.network.noisy(INPUT_NOISE, LAST_ACTION_NOISE):
            return cloning_loss(self.network.actor, batch)

    @torch.no_grad()
    def measure(self, data: TensorDictBase) -> dict[str, float]:
        """The cloning loss, and `miss`: the mean distance of the deterministic action
        from the labels in halves of the action's range."""
        reach = (self.network.high - self.network.low) / 2
        central = self.network.network.deterministic(data["observation"])
        miss = ((central - data["action"]).abs() / reach).mean(-1)
        loss = cloning_loss(self.network.actor, data).item()
        return {"loss": loss, "miss": miss.mean().item()}

    def turn(self) -> dict[str, float]:
        """One pass; training losses are measured after it, without noise."""
        return super().turn() | self.measure(self.train)

    def weights(self) -> dict[str, Tensor]:
        """Those of the ActorCritic with its observation statistics."""
        return dict(self.network.weights())

    def set_weights(self, weights: Mapping[str, Tensor]) -> None:
        self.network.set_weights(dict(weights))


def run_imitation_stage(run: Run, logger: RunLogger) -> dict[str, float]:
    """stage=imitation: ego=actor clones the recorded egos of the training scenes, and
    its weights are written to the run's folder. Returns the losses of the chosen epoch.
    """
    config = run.config
    ego = build_ego(config)
    if not isinstance(ego, ActorEgo):
        raise InputError("stage=imitation trains ego=actor; set it")
    if ego.evader is not None:
        raise InputError(
            "stage=imitation ego.evades=true: recordings do not say what a planner would "
            "have done; set ego.evades=false"
        )
    settings = stage_settings(config, ImitationSettings)
    scenes = load_scenes(
        config.data,
        config.num_scenes,
        split="train",
        scenes=config.scenes,
    )
    shown = recorded_demonstrations(scenes, build_sim(config), seed=settings.seed)
    training = Imitation(ego.network, shown, settings=settings)
    run.begin({"scenes": listed(scenes)})
    row = training.fit(
        "imitation",
        settings.epochs,
        Parts(run.folder, "imitation"),
        logger=logger,
    )
    ego.network.save(run.folder / WEIGHTS)
    return row
