"""The extension point for curricula: intensity, fraction of adversarial episodes, scenes.

All scenes are alike: draws by what can be learned in a scene (Jiang et al. 2021;
Rutherford et al., "No Regrets", 2024) or by regret are no better than uniform ones
(docs/results/training.md).
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.learning.rounds.episodes import Episodes
from e2rl.run.config import Extension, check_range, configured
from e2rl.run.errors import InputError

Choice = dict[str, int | float]  # a row of curriculum.csv
SMOOTHING = 0.3  # weight of a round in a scene's moving failure rate
BIN = 0.5  # intensities are counted under multiples of it


@dataclass(frozen=True)
class Outcomes:
    """What became of the S attacks of a round.

    eta [S]; left_out [S] bool: no driver avoids it, so it did not enter D'; episodes
    [S] int64: how many the learning policy drove in it; failures [S] int64: how many of
    these ended by contact or off the road.
    """

    eta: Tensor
    left_out: Tensor
    episodes: Tensor
    failures: Tensor


def outcomes_of(eta: Tensor, *, drawn: Tensor, row: Tensor, failed: Tensor) -> Outcomes:
    """Returns what became of attacks [S].

    Args:
        eta: intensities of the attacks [S].
        drawn: the attack of each of the pool's first K rows, [K] int64.
        row: the pool's row of each episode, [E] int64; those beyond K do not count.
        failed: episodes that failed, [E] bool.

    Returns:
        The outcomes of all S attacks.
    """
    count = len(eta)
    counts = row < len(drawn)
    attack = drawn[row[counts]]
    return Outcomes(
        eta,
        torch.ones(count, dtype=torch.bool).index_fill(0, drawn, False),
        episodes=torch.bincount(attack, minlength=count),
        failures=torch.bincount(attack[failed[counts]], minlength=count),
    )


def tally(number: int, outcomes: Outcomes, attack: Tensor) -> list[Choice]:
    """The table of round `number` and its attacks [S]: a row for each multiple of BIN
    to which their intensities are rounded. Unknown numbers are NaN."""
    level = (outcomes.eta / BIN).round() * BIN
    rows: list[Choice] = []
    for eta in level.unique().tolist():
        attacks = level == eta
        episodes = int(outcomes.episodes[attacks].sum())
        failures = int(outcomes.failures[attacks].sum())
        rows.append(
            {
                "round": number,
                "eta": round(eta, 4),
                "draws": int(attacks.sum()),
                "harder": int(attack[attacks].sum()),
                "left_out": int(outcomes.left_out[attacks].sum()),
                "episodes": episodes,
                "failures": failures,
                "failure_rate": failures / episodes if episodes else math.nan,
            }
        )
    return rows


@configured("curriculum/adaptive")
class CurriculumScheduler(Extension):
    """State over S scenes. Per round: `draw` scenes and `etas` for them, read
    `fraction`, then `update` from the episodes and `advance`.

    A curriculum is a subclass with `eta` and `fraction`, attributes or properties, and
    a YAML file in conf/curriculum with its `_target_` and settings. It overrides `etas`
    where the scenes of a round differ in intensity, and `priority` where it prefers
    scenes, for instance by `failing` [S], the recent failure rates in their adversarial
    traffic, NaN where there is none. Its constructor takes its own settings by name and
    hands on the others, `def __init__(self, num_scenes, rounds,
    seed=0, *, stairs, **scenes): super().__init__(num_scenes, rounds, seed, **scenes)`.

    Args:
        rounds: of the whole run.
        solvable_only: see conf/curriculum/adaptive.yaml.
    """

    eta: float  # adversarial intensity of this round
    fraction: float  # of this round's episodes that are in adversarial traffic
    lasting: tuple[str, ...] = ()  # a subclass's attributes that checkpoints hold

    def __init__(
        self,
        num_scenes: int,
        rounds: int,
        seed: int = 0,
        *,
        solvable_only: bool,
    ) -> None:
        if num_scenes < 1:
            raise InputError("curriculum: no scenes; check data.path and data.split")
        self.rounds = rounds
        self.round = 0
        self.solvable_only = solvable_only
        self._generator = torch.Generator().manual_seed(seed)
        self.failing = torch.full((num_scenes,), torch.nan)

    def etas(self, scenes: Tensor) -> Tensor:
        """Intensities [S] for this round's scenes [S]; by default `eta` for all."""
        return torch.full((len(scenes),), float(self.eta))

    def around(
        self,
        count: int,
        spread: float,
        *,
        low: float = 0.0,
        high: float = math.inf,
    ) -> Tensor:
        """Returns intensities [count] around `eta`, drawn uniformly.

        Args:
            count: how many.
            spread: they are at most so far from `eta`.
            low: the lowest.
            high: the highest.
        """
        first = max(self.eta - spread, low)
        last = min(self.eta + spread, high)
        return first + (last - first) * torch.rand(count, generator=self._generator)

    def priority(self) -> Tensor:
        """Probability [S] with which scenes are drawn: all alike."""
        count = len(self.failing)
        return torch.full((count,), 1 / count)

    def draw(self, count: int) -> Tensor:
        """Scenes [count] to synthesize for: each scene count // S times, the rest by
        priority without replacement."""
        total = len(self.failing)
        check_range("learner.round.scenes", count, low=1)
        chosen = torch.arange(total).repeat(count // total)
        if count % total:
            rest = torch.multinomial(
                self.priority().double(),
                count % total,
                generator=self._generator,
            )
            chosen = torch.cat([chosen, rest])
        return chosen

    def update(self, episodes: Episodes) -> None:
        """Learn from episodes how often the ego fails in the scenes' adversarial
        traffic."""
        attacked = episodes.adversarial
        scenes, inverse = episodes.scene_index[attacked].unique(return_inverse=True)
        failures = episodes.failed[attacked].float()
        failed = torch.zeros(len(scenes)).index_add(0, inverse, failures)
        rate = failed / torch.bincount(inverse, minlength=len(scenes)).clamp(min=1)
        before = self.failing[scenes]
        self.failing[scenes] = torch.where(
            before.isnan(),
            rate,
            before + SMOOTHING * (rate - before),
        )

    def advance(self, collision_rate: float | None = None) -> None:
        """Advance to the next round. collision_rate: the ego's in this round's
        adversarial traffic."""
        self.round += 1

    def summary(self) -> dict[str, float]:
        """Metrics to log."""
        driven = ~self.failing.isnan()
        metrics = {
            "eta": self.eta,
            "fraction": self.fraction,
            "scenes_seen": driven.float().mean().item(),
        }
        if driven.any():
            rate = self.failing[driven]
            metrics["learnability"] = (rate * (1 - rate)).mean().item()
        return metrics

    def state_dict(self) -> dict:
        """All state."""
        return {
            "failing": self.failing,
            "round": self.round,
            "generator": self._generator.get_state(),
            "lasting": {name: getattr(self, name) for name in self.lasting},
        }

    def load_state_dict(self, state: dict) -> None:
        """Restore a `state_dict`; raises InputError if the number of scenes differs."""
        if len(state["failing"]) != len(self.failing):
            raise InputError(
                f"the checkpoint's curriculum holds {len(state['failing'])} scenes, "
                f"the data {len(self.failing)}; resume with the data of the run"
            )
        self.failing = state["failing"].clone()
        self.round = state["round"]
        self._generator.set_state(state["generator"].cpu())
        for name in self.lasting:
            setattr(self, name, state["lasting"][name])
