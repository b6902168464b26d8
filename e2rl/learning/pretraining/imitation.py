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

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from e2rl.evaluation.build import build_ego, build_sim
from e2rl.learning.logging import RunLogger
from e2rl.learning.pretraining.cloning import NOISE, clip_expert, cloning_loss
from e2rl.learning.pretraining.driving import Disturbance, PoolDriver, filled_batches
from e2rl.learning.pretraining.supervised import Epochs, stage_settings
from e2rl.planners.actor import ActorEgo
from e2rl.planners.log_replay import ReplayEgo
from e2rl.planners.network import WEIGHTS, ActorCritic
from e2rl.run.errors import InputError
from e2rl.run.run import Run
from e2rl.run.settings import configured, setting
from e2rl.run.terminal import Bar
from e2rl.scenes.scene import SceneSet
from e2rl.scenes.scene_list import listed
from e2rl.scenes.source import load_scenes
from e2rl.sim.env import SimSettings
from e2rl.traffic.pool import TrafficPool

BURST, PAUSE = (
    10,
    20,
)  # steps: duration of a disturbance, and from the start of one to the next
DISTURBED = (1.0, 0.15)  # m/s^2, rad/s: standard deviations of the disturbances
DRIVES = 3  # drives of a scene that track the log under disturbances, besides its exact replay
BATCH = 64  # environments that run at once
WEIGHT_DECAY = 1e-2


@configured("stage/imitation")
@dataclass(frozen=True)
class ImitationSettings:
    """Settings of stage=imitation; seed: the run's."""

    epochs: int = setting(low=1)
    minibatch: int = setting(low=1)
    learning_rate: float = setting(low=0)
    held_out: float = setting(low=0, high=0.9)
    seed: int = 0


def recorded_demonstrations(
    scenes: SceneSet, sim: SimSettings, seed: int, drives: int = DRIVES
) -> TensorDict:
    """Returns demonstrations [M] (e2rl.learning.pretraining.cloning) of the recorded egos, on the
    CPU, with their scene_index [M].

    Every recording is replayed once, and driven `drives` times under disturbances. A
    disturbed episode counts until contact or off the road; actions are clipped to 0.99
    of the bounds.
    """
    generator = torch.Generator().manual_seed(seed)
    pool = TrafficPool.recorded(torch.arange(len(scenes)))
    parts = []
    batch = min(BATCH, len(scenes))
    exact = PoolDriver(
        scenes,
        replace(sim, replay_ego=True, end_on_contact=False, end_off_road=False),
        batch=batch,
    )
    free = PoolDriver(scenes, replace(sim, replay_ego=False), batch=batch)
    todo = [
        (rows, number)
        for number in range(drives + 1)
        for rows in filled_batches(len(pool), batch)
    ]
    for rows, number in Bar(todo, "demonstrations", unit="batch", leave=False):
        driver, label = (free, "intended") if number else (exact, "executed")
        frames = driver.drive(
            ReplayEgo(), pool, rows, _bursts(len(rows), generator) if number else None
        )
        alive = frames["alive"]
        bounds = driver.env.action_spec.space
        parts.append(
            TensorDict(
                {
                    "observation": frames["observation"][alive],
                    "action": clip_expert(
                        frames[label][alive], bounds.low[0], high=bounds.high[0]
                    ),
                    "scene_index": pool.scene_index[rows][:, None].expand_as(alive)[
                        alive
                    ],
                },
                batch_size=[int(alive.sum())],
            )
        )
    return torch.cat(parts)


def _bursts(batch: int, generator: torch.Generator) -> Disturbance:
    """Constant offsets of random size for BURST steps out of every PAUSE, at a random
    phase per scene."""
    size = torch.tensor(DISTURBED)
    offsets = torch.randn(batch, 100, 2, generator=generator) * size
    phase = torch.randint(PAUSE, (batch,), generator=generator)

    def disturb(action: Tensor, step: Tensor) -> Tensor:
        since = step.cpu() + phase
        offset = (
            offsets[torch.arange(batch), since // PAUSE]
            * (since % PAUSE < BURST)[:, None]
        )
        return action + offset.to(action.device)

    return disturb


class Imitation(Epochs):
    """Behaviour cloning of an ActorCritic's actor from demonstrations."""

    def __init__(
        self, network: ActorCritic, shown: TensorDictBase, settings: ImitationSettings
    ) -> None:
        super().__init__(network, shown, settings, network.network, WEIGHT_DECAY)

    def loss(self, batch: TensorDictBase) -> Tensor:
        """The cloning loss [] under noise on the input."""
        with self.network.network.noisy(*NOISE):
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
    ego = build_ego(run.config)
    if not isinstance(ego, ActorEgo):
        raise InputError("stage=imitation trains ego=actor; set it")
    settings = stage_settings(config, ImitationSettings)
    scenes = load_scenes(
        config.data, config.num_scenes, split="train", scenes=config.scenes
    )
    shown = recorded_demonstrations(scenes, build_sim(config), seed=settings.seed)
    training = Imitation(ego.network, shown, settings=settings)
    run.begin({"scenes": listed(scenes)})
    row = training.fit(
        "imitation", settings.epochs, run.parts("imitation"), vars(settings), logger
    )
    ego.network.save(run.folder / WEIGHTS)
    return row
