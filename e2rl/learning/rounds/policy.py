"""The update of a learned ego: PPO and behaviour cloning on episodes collected in the
round's pool."""

import copy
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import Compose, RewardSum, TransformedEnv

from e2rl.learning.pretraining.driving import OUTCOME_KEYS, Episodes, finished_episodes
from e2rl.learning.pretraining.imitation import recorded_demonstrations
from e2rl.learning.rounds.improvement import Improvement
from e2rl.learning.rounds.scheduler import CurriculumScheduler
from e2rl.learning.rounds.teaching import Teacher
from e2rl.learning.rounds.update import Learner, UpdateSettings
from e2rl.planners.actor import ActorEgo
from e2rl.planners.ego import Ego
from e2rl.run.config import built
from e2rl.run.errors import InputError
from e2rl.run.settings import configured, setting, settings_of
from e2rl.run.terminal import Bar
from e2rl.scenes.scene import SceneSet
from e2rl.sim.env import DrivingEnv, SimSettings
from e2rl.traffic.pool import TrafficPool
from e2rl.traffic.transform import AdversarialSynthesizer


@configured("learner/ppo_bc", "collect")
@dataclass(frozen=True)
class CollectSettings:
    """Settings `learner.collect`."""

    batch: int = setting(low=1)
    steps: int = setting(low=1)
    hold: int = setting(low=1)
    iterations: int = setting(low=1)


class RowDraw:
    """Draws pool rows by probability [R], with a generator of its own."""

    def __init__(self, probability: Tensor, seed: int | None = 0) -> None:
        """seed: None, of the system's entropy, anew in every process that a copy draws
        in until somebody seeds it."""
        self.probability = probability
        self.generator = torch.Generator()
        self._process = os.getpid()
        self._entropy = None
        if seed is None:
            self._entropy = self.generator.seed()
        else:
            self.generator.manual_seed(seed)

    def __call__(self, count: int) -> Tensor:
        """Rows [count]."""
        if (
            self._process != os.getpid()
            and self._entropy == self.generator.initial_seed()
        ):
            self._process = os.getpid()
            self._entropy = self.generator.seed()
        return torch.multinomial(
            self.probability, count, replacement=True, generator=self.generator
        )


def on_device(ego: ActorEgo, device: str) -> ActorEgo:
    """The ego itself, or a copy where it is on another device."""
    if ego.network.device == torch.device(device):
        return ego
    found = copy.copy(ego)
    found.network = ego.network.copied(device)
    return found


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
        collect: Mapping[str, Any],
        ppo: Mapping[str, Any],
        teacher: Ego | Mapping[str, Any],
        teaching: Mapping[str, Any],
        rounds: int,
    ) -> None:
        """Settings: conf/learner/ppo_bc.yaml. Raises InputError if the ego is no actor,
        the teacher no ScoringEgo, or a round shorter than an episode.

        Args:
            teacher: with ppo.teaching > 0, a ScoringEgo that labels states of the
                collected episodes, as `teaching`
                says.
            rounds: of the run, over which the learning rate falls.
        """
        if not isinstance(ego, ActorEgo):
            raise InputError(
                f"learner=ppo_bc improves ego=actor, not {type(ego).__name__}; tune a planner with `e2rl tune`"
            )
        self.settings = settings_of(CollectSettings, collect, where="learner.collect")
        update = settings_of(UpdateSettings, ppo, where="learner.ppo")
        batch = self.settings.batch
        self.horizon = scenes.steps
        hold = self.settings.hold
        iterations = self.settings.iterations
        if self.settings.steps * iterations * hold < self.horizon:
            raise InputError(
                f"learner.collect: {self.settings.steps} x {iterations} decisions of {hold} steps a round cannot hold "
                f"an episode of {self.horizon} steps"
            )
        self.ego = ego
        self._learning = on_device(ego, device)
        self.learner = Learner(
            self._learning.network, update, total=rounds * iterations
        )
        self.frames = 0
        placed = scenes.to(device)
        self.demonstrations: TensorDict | None = None
        self.teacher: Teacher | None = None
        if update.cloning > 0:
            self.demonstrations = recorded_demonstrations(scenes, sim, seed=seed)
        if update.teaching > 0:
            planner = (
                teacher
                if isinstance(teacher, Ego)
                else built(OmegaConf.create(dict(teacher)), "teacher", kind=Ego)
            )
            bounds = self._learning.network.low, self._learning.network.high
            self.teacher = Teacher(
                planner, placed, bounds=bounds, hold=hold, settings=teaching
            )
        every = torch.arange(len(scenes))
        self.draw = RowDraw(
            torch.full((len(scenes),), 1 / len(scenes), dtype=torch.float64), seed
        )
        self.synthesizer = AdversarialSynthesizer(
            TrafficPool.recorded(every), self.draw
        )
        base = DrivingEnv(
            placed,
            sim,
            batch,
            device,
            agents=self.teacher is not None,
            hold=hold,
        )
        self.env = TransformedEnv(base, Compose(self.synthesizer, RewardSum()))
        self._collect_by(self._learning.network.actor, device)

    def _collect_by(self, policy: TensorDictModuleBase, device: str) -> None:
        """Collect batches [B, steps] of decisions of a policy from here on."""
        self._collector = Collector(
            self.env,
            policy,
            frames_per_batch=self.settings.batch * self.settings.steps,
            total_frames=-1,
            trust_policy=True,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
            device=device,
        )
        self._batches = iter(self._collector)

    def __call__(
        self, pool: TrafficPool, curriculum: CurriculumScheduler
    ) -> tuple[dict[str, float], Episodes]:
        """Reset every environment; `iterations` times: collect [B, steps] decisions,
        update. `frames` are steps of 0.1 s."""
        self._learning.network.set_weights(
            self.ego.network.weights()
        )  # those of a checkpoint, in a resumed run
        self.synthesizer.pool = pool
        self.draw.probability = pool.probabilities(
            curriculum.priority(), curriculum.fraction
        )
        self._collector.reset()
        outcomes = []
        rows = []
        collecting = 0.0
        begun = self.frames
        bar = Bar(
            range(self.settings.iterations),
            "collect and update",
            unit="batch",
            leave=False,
        )
        for _ in bar:
            begin = time.perf_counter()
            data = self.collected()
            collecting += time.perf_counter() - begin
            self.frames += steps_of(data)
            outcomes.append(data.select(*OUTCOME_KEYS).cpu().clone())
            labels, made = self._labels(data, pool.adversarial)
            rows.append(self.learner.update(data, self.demonstrations, labels) | made)
            bar.set_postfix(
                reward=f"{data['next', 'reward'].mean().item():.3f}",
                kl=f"{rows[-1]['kl']:.4f}",
            )
        self.ego.network.set_weights(self._learning.network.weights())
        episodes = finished_episodes(
            outcomes, pool.adversarial, horizon=self.horizon, hold=self.settings.hold
        )
        if self.teacher is not None:
            episodes.survivable = self.teacher.survivable(len(pool))[episodes.row]
        counts = {"frames": float(self.frames), "collect": collecting}
        counts["steps_per_second"] = (self.frames - begun) / collecting
        return _means(rows) | episodes.summary() | counts, episodes

    def collected(self) -> TensorDictBase:
        """The next batch [B, steps] of decisions, by the present policy."""
        self._collector.update_policy_weights_()
        return next(self._batches)

    def _labels(
        self, data: TensorDictBase, adversarial: Tensor
    ) -> tuple[TensorDictBase | None, dict[str, float]]:
        """The teacher's labels so far, those in a batch included, and what these were."""
        if self.teacher is None:
            return None, {}
        begin = time.perf_counter()
        count = -(-self.teacher.settings.states // self.settings.iterations)
        made = self.teacher.watch(data, adversarial, self._learning, count)
        return self.teacher.labelled, {
            **made,
            "label_seconds": time.perf_counter() - begin,
        }

    def outcome(self, folder: Path) -> str:
        """How to evaluate the improved ego of a run's folder."""
        return f"evaluate the policy with: python evaluate.py ego=actor ego.checkpoint={folder}"

    def state_dict(self) -> dict:
        """Learner, draws and frames; the weights are the network's."""
        state = {
            "learner": self.learner.state_dict(),
            "frames": self.frames,
            "draws": self.draw.generator.get_state(),
        }
        return state | (
            {} if self.teacher is None else {"labels": self.teacher.state_dict()}
        )

    def load_state_dict(self, state: dict) -> None:
        self.learner.load_state_dict(state["learner"])
        self.draw.generator.set_state(state["draws"].cpu())
        if self.teacher is not None:
            self.teacher.load_state_dict(state["labels"])
        self.frames = state["frames"]


def _means(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The mean of each metric over the updates that have it."""
    names = sorted({name for row in rows for name in row})
    known = {name: [row[name] for row in rows if name in row] for name in names}
    return {name: sum(values) / len(values) for name, values in known.items()}
