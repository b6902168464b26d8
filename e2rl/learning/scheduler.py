"""The extension point for curricula: intensity, causal template, share of adversarial episodes, priorities of scenes.

Scenes are prioritised by rank, mixed with staleness, as in prioritised level replay (Jiang et al. 2021). What is ranked
is the learnability of Rutherford et al. ("No Regrets", 2024): p (1 - p), where p is the recent share of the ego's
episodes in a scene's adversarial traffic that fail. It is 0 for a scene that is solved and for one that is hopeless.

What became of a round's attacks, and the table of a curriculum's choices (curriculum.csv).
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.run.config import Extension
from e2rl.run.errors import InputError
from e2rl.run.settings import check_range
from e2rl.traffic.traffic import FULL, TEMPLATES

Choice = dict[str, int | float | str]  # a row of the table, by COLUMNS
COLUMNS = {"round": int, "eta": float, "template": str, "draws": int, "left_out": int, "episodes": int, "failures": int}
COLUMNS |= {"failure_rate": float, "value": float}


@dataclass(frozen=True)
class Outcomes:
    """The S attacks of a round: eta [S]; template [S] int64; left_out [S] bool: no driver survives it, so it did not
    enter D'; episodes [S] int64 that the learning policy drove in it; failures [S] int64: those among them that ended
    by contact or off the road."""

    eta: Tensor
    template: Tensor
    left_out: Tensor
    episodes: Tensor
    failures: Tensor

    @property
    def failure_rate(self) -> Tensor:
        """The share of failures in the episodes [S]; NaN without an episode."""
        return self.failures / self.episodes


def outcomes_of(eta: Tensor, template: Tensor, drawn: Tensor, row: Tensor, failed: Tensor) -> Outcomes:
    """Outcomes of attacks [S] of which drawn [K] int64 are the first K rows of the pool (several rows may be one's):
    from episodes [E] with their pool row and whether they failed. Episodes in other rows do not count."""
    count, known = len(eta), row < len(drawn)
    attack, failed = drawn[row[known]], failed[known]
    left_out = torch.ones(count, dtype=torch.bool).index_fill(0, drawn, False)
    episodes, failures = (torch.bincount(each, minlength=count) for each in (attack, attack[failed]))
    return Outcomes(eta, template, left_out, episodes, failures)


def tally(number: int, level: Tensor, outcomes: Outcomes, value: Mapping[tuple[float, str], float]) -> list[Choice]:
    """The table of round `number`: a row for each intensity and causal template that was drawn or has a value.

    level [S]: the intensity under which each attack is counted; value: what the curriculum expects to learn from each
    (eta, template), {} where it does not estimate this. Unknown numbers are NaN.
    """
    arms = [
        (round(eta, 4), TEMPLATES[code]) for eta, code in zip(level.tolist(), outcomes.template.tolist(), strict=True)
    ]
    value = {(round(eta, 4), name): number for (eta, name), number in value.items()}
    rows: list[Choice] = []
    for arm in sorted({*arms, *value}, key=lambda each: (TEMPLATES.index(each[1]), each[0])):
        of_arm = torch.tensor([each == arm for each in arms], dtype=torch.bool)
        draws, left_out = int(of_arm.sum()), int(outcomes.left_out[of_arm].sum())
        episodes, failures = (int(each[of_arm].sum()) for each in (outcomes.episodes, outcomes.failures))
        rate = failures / episodes if episodes else float("nan")
        numbers = (draws, left_out, episodes, failures, rate, value.get(arm, float("nan")))
        rows.append(dict(zip(COLUMNS, (number, *arm, *numbers), strict=True)))
    return rows


BIN = 0.5  # intensities are counted under multiples of it


class CurriculumScheduler(Extension, ABC):
    """State over S scenes. Per round: `draw` scenes and `choices` for them, read `share`, `update` with episodes,
    `observe` what became of the attacks, `advance`.

    A schedule is a subclass with the properties `eta` and `share`, and a YAML file in conf/curriculum with its
    `_target_` and settings; `etas` where the scenes of a round differ in intensity, `choices` and `templates` where
    they differ in causal template as well. State of its own between rounds belongs in `extra_state`.

    templates: the causal templates that it may choose (e2rl/traffic/traffic.py).
    """

    templates: tuple[str, ...] = (TEMPLATES[FULL],)

    def __init__(
        self,
        num_scenes: int,
        rounds: int,
        seed: int = 0,
        prioritised: bool = True,
        temperature: float = 2.0,
        staleness: float = 0.2,
        smoothing: float = 0.3,
        solvable_only: bool = True,
    ) -> None:
        """rounds: of the whole run; other fields: conf/curriculum/adaptive.yaml. Raises InputError out of range."""
        if num_scenes < 1:
            raise InputError("curriculum: no scenes; check data.path and data.split")
        check_range("curriculum.temperature", temperature, 1e-6)
        check_range("curriculum.staleness", staleness, 0, 1)
        check_range("curriculum.smoothing", smoothing, 1e-6, 1)
        self.rounds, self.round, self.prioritised, self.solvable_only = rounds, 0, prioritised, solvable_only
        self.temperature, self.staleness, self.smoothing = temperature, staleness, smoothing
        self._generator = torch.Generator().manual_seed(seed)
        self._failing = torch.full((num_scenes,), torch.nan)
        self._drawn = torch.full((num_scenes,), -1, dtype=torch.int64)

    @property
    @abstractmethod
    def eta(self) -> float:
        """Adversarial intensity of this round."""

    @property
    @abstractmethod
    def share(self) -> float:
        """Share of this round's episodes in adversarial traffic."""

    def etas(self, scenes: Tensor) -> Tensor:
        """Intensities [S] for this round's scenes [S]; by default `eta` for all."""
        return torch.full((len(scenes),), float(self.eta))

    def choices(self, scenes: Tensor) -> tuple[Tensor, Tensor]:
        """Intensities [S] and causal templates [S] int64 for this round's scenes [S]; by default `etas`, full for
        all."""
        return self.etas(scenes), torch.full((len(scenes),), FULL)

    def around(self, count: int, spread: float, low: float = 0.0, high: float = float("inf")) -> Tensor:
        """Intensities [count] drawn uniformly from [eta - spread, eta + spread], cut at `low` and `high`."""
        first, last = max(self.eta - spread, low), min(self.eta + spread, high)
        return first + (last - first) * torch.rand(count, generator=self._generator)

    def extra_state(self) -> dict:
        """State of a schedule between rounds, besides the scenes' state."""
        return {}

    def load_extra_state(self, state: dict) -> None:  # noqa: B027
        """Restore an `extra_state`."""

    def learnability(self) -> Tensor:
        """p (1 - p) [S], of a recent share p of failures; NaN for scenes never driven in adversarial traffic."""
        return self._failing * (1 - self._failing)

    def priority(self) -> Tensor:
        """Probability [S] with which scenes are drawn: (1 - staleness) by rank of learnability, scenes not yet driven
        in adversarial traffic first, the rest by the rounds since they were last drawn."""
        count = len(self._failing)
        if not self.prioritised:
            return torch.full((count,), 1 / count)
        weight = (1 / ranks(self.learnability().nan_to_num(nan=torch.inf))) ** (1 / self.temperature)
        age = (self.round - self._drawn).float()
        old = age / age.sum() if age.sum() > 0 else torch.full((count,), 1 / count)
        return (1 - self.staleness) * weight / weight.sum() + self.staleness * old

    def draw(self, count: int) -> Tensor:
        """Scenes [count] to synthesize for: each scene count // S times, the rest by priority without replacement."""
        total = len(self._failing)
        check_range("learner.round.scenes", count, 1)
        chosen = torch.arange(total).repeat(count // total)
        if count % total:
            rest = torch.multinomial(self.priority().double(), count % total, generator=self._generator)
            chosen = torch.cat([chosen, rest])
        self._drawn[chosen] = self.round
        return chosen

    def update(self, scene_index: Tensor, failed: Tensor, adversarial: Tensor) -> None:
        """Update with episodes [E]: scene, whether the ego failed, and whether the traffic was adversarial."""
        scene_index, adversarial = scene_index.cpu(), adversarial.cpu()
        scenes, inverse = scene_index[adversarial].unique(return_inverse=True)
        total = torch.zeros(len(scenes)).index_add(0, inverse, failed.cpu().float()[adversarial])
        mean = total / torch.bincount(inverse, minlength=len(scenes)).clamp(min=1)
        before = self._failing[scenes]
        moved = before + self.smoothing * (mean - before)
        self._failing[scenes] = torch.where(before.isnan(), mean, moved)

    def observe(self, outcomes: Outcomes) -> None:  # noqa: B027
        """Learn from what became of the round's attacks; by default nothing."""

    def level(self, eta: Tensor) -> Tensor:
        """The intensities [S] under which those of attacks [S] are counted in curriculum.csv: multiples of BIN."""
        return (eta / BIN).round() * BIN

    def values(self) -> dict[tuple[float, str], float]:
        """What is expected to be learned from attacks by (eta, template), where the schedule estimates it."""
        return {}

    def leave_out(self, scene_index: Tensor) -> None:
        """Mark scenes whose adversarial traffic was left out because no driver survives it. They count as solved until
        they are driven; otherwise they would come first in every draw."""
        scene_index = scene_index.cpu()
        self._failing[scene_index] = self._failing[scene_index].nan_to_num(nan=0.0)

    def advance(self, collision_rate: float | None = None) -> None:
        """Advance to the next round. collision_rate: the ego's in this round's adversarial traffic."""
        self.round += 1

    def summary(self) -> dict[str, float]:
        """Metrics to log."""
        learnability, seen = self.learnability(), ~self._failing.isnan()
        result = {"eta": self.eta, "share": self.share, "scenes_seen": seen.float().mean().item()}
        return result | ({"learnability": learnability[seen].mean().item()} if seen.any() else {})

    def state_dict(self) -> dict:
        """All state."""
        scenes = {"failing": self._failing, "drawn": self._drawn}
        return scenes | {"round": self.round, "generator": self._generator.get_state(), "extra": self.extra_state()}

    def load_state_dict(self, state: dict) -> None:
        """Restore a `state_dict`; raises InputError if the number of scenes differs."""
        if len(state["failing"]) != len(self._failing):
            raise InputError(
                f"the checkpoint's curriculum holds {len(state['failing'])} scenes, the data {len(self._failing)}; "
                "resume with the data of the run"
            )
        self._failing, self._drawn = (state[key].clone() for key in ("failing", "drawn"))
        self.round = state["round"]
        self._generator.set_state(state["generator"].cpu())
        self.load_extra_state(state["extra"])


def ranks(value: Tensor) -> Tensor:
    """Ranks [S] of values [S], 1 for the largest; equal values share the mean of their ranks."""
    _, inverse, count = value.unique(return_inverse=True, return_counts=True)
    above = count.flip(0).cumsum(0).flip(0) - count
    return (above + (count + 1) / 2)[inverse]
