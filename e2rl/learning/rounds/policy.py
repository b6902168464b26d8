"""The update of a learned ego: PPO on episodes collected in the
round's pool."""

import copy
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import Compose, RewardSum, TransformedEnv

from e2rl.learning.rounds.episodes import Episodes, finished_episodes, outcomes
from e2rl.learning.rounds.improvement import Improvement
from e2rl.learning.rounds.scheduler import CurriculumScheduler
from e2rl.learning.rounds.update import Learner, UpdateSettings
from e2rl.planners.actor import ActorEgo
from e2rl.planners.ego import Ego
from e2rl.planners.evader import Evasions
from e2rl.run.config import configured, setting, settings_of
from e2rl.run.cpu import onednn_products
from e2rl.run.errors import InputError
from e2rl.run.terminal import Bar
from e2rl.scenes.scene import SceneSet
from e2rl.sim.env import DrivingEnv
from e2rl.sim.settings import SimSettings
from e2rl.traffic.pool import RowDraw, TrafficPool
from e2rl.traffic.transform import AdversarialSynthesizer


@configured("learner/ppo_bc", "collect")
@dataclass(frozen=True)
class CollectSettings:
    """Settings `learner.collect`."""

    batch: int = setting(low=1)
    steps: int = setting(low=1)
    hold: int = setting(low=1)
    iterations: int = setting(low=1)


def on_device(ego: ActorEgo, device: str) -> ActorEgo:
    """The ego itself, or a copy where it is on another device."""
    if ego.network.device == torch.device(device):
        return ego
    moved = copy.copy(ego)
    moved.network = ego.network.copied(device)
    return moved


def steps_of(data: TensorDictBase) -> int:
    """Steps of 0.1 s that were driven in a batch of decisions."""
    return int((data["next", "timestep"] - data["timestep"]).sum())


@configured("learner/ppo_bc")
class PolicyImprovement(Improvement):
    """Collects episodes with the actor's stochastic policy in the round's pool and
    updates it after each batch."""

    ego: ActorEgo

    def __init__(
        self,
        ego: Ego,
        scenes: SceneSet,
        sim: SimSettings,
        *,
        seed: int = 0,
        device: str,
        rounds: int,
        collect: Mapping[str, Any],
        ppo: Mapping[str, Any],
    ) -> None:
        """
        Args:
            ego: an actor.
            scenes: of the pools.
            sim: settings of the simulator.
            seed: of the draws of rows.
            device: where the policy drives and learns.
            rounds: of the run, over which the learning rate falls.
            collect: of CollectSettings.
            ppo: of UpdateSettings.

        Raises:
            InputError: the ego is no actor, or a round shorter than an episode.
        """
        if not isinstance(ego, ActorEgo):
            raise InputError(
                f"learner=ppo_bc improves ego=actor, not {type(ego).__name__}; "
                "tune a planner with `e2rl tune`"
            )
        self.settings = settings_of(CollectSettings, collect, where="learner.collect")
        update = settings_of(UpdateSettings, ppo, where="learner.ppo")
        self.horizon = scenes.steps
        decisions = self.settings.steps * self.settings.iterations
        if decisions * self.settings.hold < self.horizon:
            raise InputError(
                f"learner.collect: {decisions} decisions of {self.settings.hold} steps "
                f"a round cannot hold an episode of {self.horizon} steps"
            )
        self.ego = ego
        self.learning = on_device(ego, device)
        network = self.learning.network
        self.learner = Learner(network, update, total=rounds * self.settings.iterations)
        self.frames = 0
        count = len(scenes)
        self.draw = RowDraw(torch.full((count,), 1 / count, dtype=torch.float64), seed)
        self.synthesizer = AdversarialSynthesizer(
            TrafficPool.recorded(torch.arange(count)), self.draw
        )
        self.env = DrivingEnv(
            scenes.to(device),
            sim,
            self.settings.batch,
            device,
            hold=self.settings.hold,
        )
        transforms = [self.synthesizer, RewardSum()]
        if ego.evader is not None:
            transforms.append(Evasions(ego.evader, self.settings.hold))
        self._collector = Collector(
            TransformedEnv(self.env, Compose(*transforms)),
            network.actor,
            frames_per_batch=self.settings.batch * self.settings.steps,
            total_frames=-1,
            trust_policy=True,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
            device=device,
        )
        self._batches = iter(self._collector)

    @onednn_products()
    def __call__(
        self,
        pool: TrafficPool,
        curriculum: CurriculumScheduler,
    ) -> tuple[dict[str, float], Episodes]:
        """Reset every environment; `iterations` times: collect [B, steps] decisions,
        update. `frames` are steps of 0.1 s."""
        self.learning.network.set_weights(self.ego.network.weights())
        self.synthesizer.pool = pool
        self.draw.probability = pool.probabilities(
            curriculum.priority(), curriculum.fraction
        )
        self._collector.reset()
        driven = []
        metrics = []
        seconds = 0.0
        frames = self.frames
        bar = Bar(
            range(self.settings.iterations),
            "collect and update",
            unit="batch",
            leave=False,
        )
        for _ in bar:
            begin = time.perf_counter()
            data = self.collected()
            seconds += time.perf_counter() - begin
            self.frames += steps_of(data)
            driven.append(outcomes(data))
            row = self.learner.update(data)
            metrics.append(row)
            bar.set_postfix(
                reward=f"{data['next', 'reward'].mean().item():.3f}",
                kl=f"{row['kl']:.4f}",
            )
        self.ego.network.set_weights(self.learning.network.weights())
        episodes = finished_episodes(
            driven,
            pool.adversarial,
            horizon=self.horizon,
            hold=self.settings.hold,
        )
        return {
            **means(metrics),
            **episodes.summary(),
            "frames": float(self.frames),
            "collect": seconds,
            "steps_per_second": (self.frames - frames) / seconds,
        }, episodes

    def collected(self) -> TensorDictBase:
        """The next batch [B, steps] of decisions, by the present policy."""
        self._collector.update_policy_weights_()
        return next(self._batches)

    def outcome(self, folder: Path) -> str:
        """How to evaluate the improved ego of a run's folder."""
        return (
            "evaluate the policy with: python evaluate.py ego=actor "
            f"ego.checkpoint={folder}"
        )

    def state_dict(self) -> dict:
        """Learner, draws and frames; the weights are the network's."""
        return {
            "learner": self.learner.state_dict(),
            "frames": self.frames,
            "draws": self.draw.generator.get_state(),
        }

    def load_state_dict(self, state: dict) -> None:
        self.learner.load_state_dict(state["learner"])
        self.draw.generator.set_state(state["draws"].cpu())
        self.frames = state["frames"]


def means(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The mean of each metric over the updates that have it."""
    columns = defaultdict(list)
    for row in rows:
        for name, value in row.items():
            columns[name].append(value)
    return {name: sum(values) / len(values) for name, values in columns.items()}
