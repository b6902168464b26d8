"""The two kinds of update of a round: the actor by PPO and cloning on collected episodes, a planner by grid tuning.

Both are called with the round's pool and the curriculum, improve their `ego` and return the metrics to log and the
episodes that they saw.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from tqdm import tqdm

from e2rl.ego.actor import ActorEgo
from e2rl.ego.base import Ego
from e2rl.errors import InputError
from e2rl.learning.curriculum import CurriculumScheduler
from e2rl.learning.driving import drive_all
from e2rl.learning.episodes import OUTCOME_KEYS, Episodes, finished_episodes
from e2rl.learning.imitation import corrective_pairs
from e2rl.learning.planner_tuning import Parameters, TuningSettings, tune
from e2rl.learning.pool import TrafficPool
from e2rl.learning.scene_sampler import SceneSampler
from e2rl.learning.update import Learner, UpdateSettings
from e2rl.scene.scene import SceneSet
from e2rl.sim.env import DrivingEnv, SimSettings


@dataclass(frozen=True)
class CollectSettings:
    """Fields: conf/learner/ppo_bc.yaml."""

    batch: int = 64
    steps: int = 80
    iterations: int = 20


class PolicyImprovement:
    """Collects episodes with the actor's stochastic policy in the round's pool and updates it after each batch."""

    def __init__(
        self,
        ego: ActorEgo,
        scenes: SceneSet,
        sim: SimSettings,
        update: UpdateSettings,
        collect: CollectSettings,
        expert: TensorDictBase | None = None,
        teacher: Ego | None = None,
        seed: int = 0,
        device: str = "cpu",
    ) -> None:
        """expert: pairs to clone all along (`recorded_pairs`); teacher: an ego whose survived drives through the
        round's adversarial traffic are cloned too (`corrective_pairs`)."""
        if not isinstance(ego, ActorEgo):
            raise InputError(f"learner=ppo_bc improves ego=actor, not {type(ego).__name__}; use learner=planner_tuning")
        horizon = scenes.scenes["logged"].shape[1] - 1
        if collect.steps * collect.iterations < horizon:
            raise InputError(
                f"learner.collect: {collect.steps} x {collect.iterations} steps a round cannot hold an "
                f"episode of {horizon}"
            )
        self.ego, self.settings, self.expert, self.teacher, self.horizon = ego, collect, expert, teacher, horizon
        self.learner, self.frames = Learner(ego.network, update), 0
        self.sampler = SceneSampler(len(scenes), collect.batch, seed)
        self.env = TransformedEnv(DrivingEnv(scenes, sim, collect.batch, device), self.sampler)
        self._collector = Collector(
            self.env,
            ego.network.actor,
            frames_per_batch=collect.batch * collect.steps,
            total_frames=-1,
            trust_policy=True,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
            device=device,
        )
        self._batches = iter(self._collector)

    def __call__(self, pool: TrafficPool, curriculum: CurriculumScheduler) -> tuple[dict[str, float], Episodes]:
        """Every environment begins anew; `iterations` times: collect [B, steps], update."""
        expert = self._expert(pool)
        self.sampler.load(pool, curriculum.priority(), curriculum.share)
        self._collector.reset()
        kept, rows = [], []
        for _ in (bar := tqdm(range(self.settings.iterations), "collect and update", unit="batch", leave=False)):
            data = next(self._batches)
            self.frames += data.numel()
            kept.append(data.select(*OUTCOME_KEYS).cpu().clone())
            rows.append(self.learner.update(data, expert))
            self._collector.update_policy_weights_()
            bar.set_postfix(reward=f"{data['next', 'reward'].mean().item():.3f}", kl=f"{rows[-1]['kl']:.4f}")
        episodes = finished_episodes(kept, pool.adversarial, self.horizon)
        names = {name for row in rows for name in row}
        metrics = {name: _mean([row[name] for row in rows if name in row]) for name in sorted(names)}
        pairs = 0 if expert is None else len(expert)
        return metrics | episodes.summary() | {"frames": float(self.frames), "expert_pairs": float(pairs)}, episodes

    def _expert(self, pool: TrafficPool) -> TensorDictBase | None:
        if self.teacher is None or not pool.adversarial.any():
            return self.expert
        pairs = corrective_pairs(self.env.base_env, self.teacher, pool).select("observation", "action")
        return pairs if self.expert is None else torch.cat([self.expert.select("observation", "action"), pairs])

    def state_dict(self) -> dict:
        """Learner, sampler and frames; the weights are the network's."""
        return {"learner": self.learner.state_dict(), "frames": self.frames, "sampler": self.sampler.get_extra_state()}

    def load_state_dict(self, state: dict) -> None:
        """Go on from a `state_dict`."""
        self.learner.load_state_dict(state["learner"])
        self.sampler.set_extra_state(state["sampler"])
        self.frames = state["frames"]

    def outcome(self, folder: Path) -> str:
        """How to evaluate the improved ego of a run's folder."""
        return f"evaluate the policy with: python evaluate.py ego=actor ego.checkpoint={folder}"

    def close(self) -> None:
        """Shut the collector down."""
        self._collector.shutdown()


class PlannerImprovement:
    """Tunes a planner's parameters on the round's pool; `ego` is the planner with the best parameters so far."""

    def __init__(
        self,
        make_ego: Callable[..., Ego],
        present: Parameters,
        grid: Mapping[str, Sequence],
        scenes: SceneSet,
        sim: SimSettings,
        settings: TuningSettings | None = None,
        batch: int = 64,
        device: str = "cpu",
    ) -> None:
        """make_ego(**parameters) -> Ego; present: parameters to begin with; grid: values to try of some of them."""
        unknown = sorted(set(grid) - set(present))
        if unknown:
            raise InputError(
                f"learner.grid: {', '.join(unknown)} are no parameters of the planner; it has "
                f"{', '.join(sorted(present))}"
            )
        self.make_ego, self.present, self.grid = make_ego, dict(present), {key: list(grid[key]) for key in grid}
        self.settings, self.env = settings or TuningSettings(), DrivingEnv(scenes, sim, batch, device)
        self.ego, self.trials = make_ego(**present), []

    def __call__(self, pool: TrafficPool, curriculum: CurriculumScheduler) -> tuple[dict[str, float], Episodes]:
        """Drive the pool once with every combination of the grid; the whole grid is left in `trials`."""
        driven: dict[str, Episodes] = {}

        def evaluate(parameters: Parameters) -> dict[str, float]:
            episodes = drive_all(self.env, self.make_ego(**parameters), pool)
            driven[_name(parameters)] = episodes
            summary = episodes.summary()
            return {"collision": summary["contact"], "comfort": summary["acceleration"]} | summary

        tuning = tune(evaluate, self.present, self.grid, self.settings)
        before, after = tuning.trials[0], next(t for t in tuning.trials if t["parameters"] == tuning.best)
        self.present, self.trials, self.ego = tuning.best, tuning.trials, self.make_ego(**tuning.best)
        chosen = {
            f"parameter_{key}": float(value)
            for key, value in self.present.items()
            if key in self.grid and isinstance(value, int | float)
        }
        metrics = {
            "objective_before": before["objective"],
            "objective": after["objective"],
            "trials": float(len(tuning.trials)),
            **chosen,
        }
        return metrics | driven[_name(tuning.best)].summary(), driven[_name(tuning.best)]

    def outcome(self, folder: Path) -> str:
        """Write the last round's whole grid to tuning.json; how to evaluate the planner as tuned."""
        (folder / "tuning.json").write_text(json.dumps({"best": self.present, "trials": self.trials}, indent=1))
        tuned = " ".join(f"ego.{key}={self.present[key]}" for key in self.grid)
        return f"every trial of the last round is in tuning.json; evaluate the planner as tuned with: {tuned}"

    def state_dict(self) -> dict:
        """The best parameters so far."""
        return {"present": dict(self.present)}

    def load_state_dict(self, state: dict) -> None:
        """Go on from a `state_dict`."""
        self.present = dict(state["present"])
        self.ego = self.make_ego(**self.present)

    def close(self) -> None:
        """Nothing is held open."""


def _name(parameters: Parameters) -> str:
    return repr(sorted(parameters.items()))


def _mean(values: list[float]) -> float:
    return sum(values) / len(values)
