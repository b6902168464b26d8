"""The extension point for curricula: intensity, fraction of adversarial episodes, scene
priorities.

Scenes are prioritised by rank, mixed with staleness, as in prioritised level replay
(Jiang et al. 2021). What is ranked is the learnability p (1 - p) of Rutherford et al.
("No Regrets", 2024): p is the recent failure rate of the ego in a scene's adversarial
traffic. It is 0 for a scene that is solved and for one that is hopeless.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.learning.rounds.episodes import Episodes
from e2rl.run.config import Extension, check_range, configured
from e2rl.run.errors import InputError

Choice = dict[str, int | float]  # a row of curriculum.csv
TEMPERATURE = 2.0  # of ranks: the first tenth of the scenes has a quarter of the draws
STALENESS = 0.2  # fraction of the draws by the rounds since a scene was last drawn
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
    where the scenes of a round differ in intensity. Its constructor takes its own
    settings by name and hands on the others, `def __init__(self, num_scenes, rounds,
    seed=0, *, stairs, **scenes): super().__init__(num_scenes, rounds, seed, **scenes)`.

    Args:
        rounds: of the whole run.
        prioritised, solvable_only: see conf/curriculum/adaptive.yaml.
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
        prioritised: bool,
        solvable_only: bool,
    ) -> None:
        if num_scenes < 1:
            raise InputError("curriculum: no scenes; check data.path and data.split")
        self.rounds = rounds
        self.round = 0
        self.prioritised = prioritised
        self.solvable_only = solvable_only
        self._generator = torch.Generator().manual_seed(seed)
        self._failing = torch.full((num_scenes,), torch.nan)
        self._drawn = torch.full((num_scenes,), -1, dtype=torch.int64)

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

    def learnability(self) -> Tensor:
        """p (1 - p) [S] of the recent failure rate p: what can be learned; NaN for
        scenes never driven in adversarial traffic."""
        return self._failing * (1 - self._failing)

    def priority(self) -> Tensor:
        """Probability [S] with which scenes are drawn: 1 - STALENESS of it by rank of
        learnability, scenes not yet driven in adversarial traffic first, the rest by the
        rounds since they were last drawn."""
        count = len(self._failing)
        if not self.prioritised:
            return torch.full((count,), 1 / count)
        rank = ranks(self.learnability().nan_to_num(nan=torch.inf))
        weight = (1 / rank) ** (1 / TEMPERATURE)
        age = (self.round - self._drawn).float()
        stale = age / age.sum() if age.sum() > 0 else torch.full((count,), 1 / count)
        return (1 - STALENESS) * weight / weight.sum() + STALENESS * stale

    def draw(self, count: int) -> Tensor:
        """Scenes [count] to synthesize for: each scene count // S times, the rest by
        priority without replacement."""
        total = len(self._failing)
        check_range("learner.round.scenes", count, low=1)
        chosen = torch.arange(total).repeat(count // total)
        if count % total:
            rest = torch.multinomial(
                self.priority().double(),
                count % total,
                generator=self._generator,
            )
            chosen = torch.cat([chosen, rest])
        self._drawn[chosen] = self.round
        return chosen

    def update(self, episodes: Episodes) -> None:
        """Learn from episodes how often the ego fails in the scenes' adversarial
        traffic."""
        attacked = episodes.adversarial
        scenes, inverse = episodes.scene_index[attacked].unique(return_inverse=True)
        failures = episodes.failed[attacked].float()
        failed = torch.zeros(len(scenes)).index_add(0, inverse, failures)
        rate = failed / torch.bincount(inverse, minlength=len(scenes)).clamp(min=1)
        before = self._failing[scenes]
        self._failing[scenes] = torch.where(
            before.isnan(),
            rate,
            before + SMOOTHING * (rate - before),
        )

    def leave_out(self, scenes: Tensor) -> None:
        """Mark scenes whose adversarial traffic was left out because no driver survives
        it. They count as solved until they are driven; otherwise they would come first
        in every draw."""
        self._failing[scenes] = self._failing[scenes].nan_to_num(nan=0.0)

    def advance(self, collision_rate: float | None = None) -> None:
        """Advance to the next round. collision_rate: the ego's in this round's
        adversarial traffic."""
        self.round += 1

    def summary(self) -> dict[str, float]:
        """Metrics to log."""
        driven = ~self._failing.isnan()
        metrics = {
            "eta": self.eta,
            "fraction": self.fraction,
            "scenes_seen": driven.float().mean().item(),
        }
        if driven.any():
            metrics["learnability"] = self.learnability()[driven].mean().item()
        return metrics

    def state_dict(self) -> dict:
        """All state."""
        return {
            "failing": self._failing,
            "drawn": self._drawn,
            "round": self.round,
            "generator": self._generator.get_state(),
            "lasting": {name: getattr(self, name) for name in self.lasting},
        }

    def load_state_dict(self, state: dict) -> None:
        """Restore a `state_dict`; raises InputError if the number of scenes differs."""
        if len(state["failing"]) != len(self._failing):
            raise InputError(
                f"the checkpoint's curriculum holds {len(state['failing'])} scenes, "
                f"the data {len(self._failing)}; resume with the data of the run"
            )
        self._failing = state["failing"].clone()
        self._drawn = state["drawn"].clone()
        self.round = state["round"]
        self._generator.set_state(state["generator"].cpu())
        for name in self.lasting:
            setattr(self, name, state["lasting"][name])


def ranks(value: Tensor) -> Tensor:
    """Ranks [S] of values [S], 1 for the largest; equal values share the mean of their
    ranks."""
    _, inverse, count = value.unique(return_inverse=True, return_counts=True)
    above = count.flip(0).cumsum(0).flip(0) - count
    return (above + (count + 1) / 2)[inverse]
