"""The curriculum: how strong the adversary is, how many episodes meet it, and in which scenes (paper, IV-C).

Scenes are prioritised as in prioritised level replay (Jiang et al. 2021): by the rank of a regret estimate, mixed with
staleness. The regret of a scene is the best return seen there, in any traffic, less the recent return in adversarial
traffic: high where the ego is known to be able to drive and the adversary keeps it from it, low where it is solved,
and low where nobody ever drove well.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.errors import InputError

SCHEDULES = ("constant", "linear", "adaptive")


@dataclass(frozen=True)
class CurriculumSettings:
    """Fields: conf/curriculum/adaptive.yaml."""

    schedule: str = "adaptive"
    eta: float = 1.0
    eta_final: float = 3.0
    eta_min: float = 0.25
    eta_max: float = 5.0
    eta_step: float = 0.25
    target_low: float = 0.25
    target_high: float = 0.45
    ramp: float = 0.5
    share: float = 0.5
    share_final: float = 0.9
    prioritised: bool = True
    temperature: float = 0.3
    staleness: float = 0.2
    smoothing: float = 0.3
    solvable_only: bool = True

    def __post_init__(self) -> None:
        if self.schedule not in SCHEDULES:
            raise InputError(f"curriculum.schedule={self.schedule}: choose one of {', '.join(SCHEDULES)}")
        if not 0 <= self.target_low <= self.target_high <= 1:
            raise InputError("curriculum.target_low and target_high are collision rates, 0 <= low <= high <= 1")
        if not (0 <= self.share <= 1 and 0 <= self.share_final <= 1 and 0 <= self.staleness <= 1):
            raise InputError("curriculum.share, share_final and staleness are shares between 0 and 1")
        if self.temperature <= 0 or not 0 < self.smoothing <= 1:
            raise InputError("curriculum.temperature must be positive and smoothing between 0 and 1")


class CurriculumScheduler:
    """State over S scenes. Per round: `draw` scenes, read `eta` and `share`, `update` with outcomes, `advance`."""

    def __init__(self, num_scenes: int, rounds: int, settings: CurriculumSettings | None = None, seed: int = 0) -> None:
        """rounds: of the whole run; the linear schedules reach their final value after `ramp` of them."""
        if num_scenes < 1:
            raise InputError("curriculum: no scenes; check data.path and data.split")
        self.settings, self.rounds = settings or CurriculumSettings(), rounds
        self.round, self._adapted = 0, self.settings.eta
        self._generator = torch.Generator().manual_seed(seed)
        self._best = torch.full((num_scenes,), -torch.inf)
        self._recent = torch.full((num_scenes,), torch.nan)
        self._drawn = torch.full((num_scenes,), -1, dtype=torch.int64)

    @property
    def eta(self) -> float:
        """Adversarial intensity of this round: set, rising linearly, or following the target band."""
        settings = self.settings
        if settings.schedule == "adaptive":
            return self._adapted
        if settings.schedule == "linear":
            return settings.eta + self._ramp() * (settings.eta_final - settings.eta)
        return settings.eta

    @property
    def share(self) -> float:
        """Share of episodes in adversarial traffic: constant, or growing as CAT's over the first `ramp` of the run."""
        settings = self.settings
        if settings.schedule == "linear":
            return settings.share + self._ramp() * (settings.share_final - settings.share)
        return settings.share

    def _ramp(self) -> float:
        return min(1.0, self.round / max(1.0, self.settings.ramp * self.rounds))

    def regret(self) -> Tensor:
        """Estimated regret [S], at least 0; NaN for scenes never driven in adversarial traffic."""
        return (self._best - self._recent).clamp(min=0)

    def priority(self) -> Tensor:
        """Probability [S] with which scenes are drawn: (1 - staleness) by rank of regret, scenes not yet driven in
        adversarial traffic first, the rest by the rounds since they were last drawn."""
        count = len(self._best)
        if not self.settings.prioritised:
            return torch.full((count,), 1 / count)
        weight = (1 / ranks(self.regret().nan_to_num(nan=torch.inf))) ** (1 / self.settings.temperature)
        age = (self.round - self._drawn).float()
        old = age / age.sum() if age.sum() > 0 else torch.full((count,), 1 / count)
        share = self.settings.staleness
        return (1 - share) * weight / weight.sum() + share * old

    def draw(self, count: int) -> Tensor:
        """Scenes [count] to synthesize for, by priority without replacement; all scenes once more for each full
        round through them."""
        total = len(self._best)
        if count < 1:
            raise InputError(f"learner.round.scenes={count}: at least one scene a round")
        whole = torch.arange(total).repeat(count // total)
        rest = (
            torch.multinomial(self.priority().double(), count % total, generator=self._generator)
            if count % total
            else whole[:0]
        )
        chosen = torch.cat([whole, rest])
        self._drawn[chosen] = self.round
        return chosen

    def update(self, scene_index: Tensor, returns: Tensor, adversarial: Tensor) -> None:
        """Take in episodes [E]: scene, return, and whether the traffic was adversarial."""
        scene_index, returns, adversarial = scene_index.cpu(), returns.cpu().float(), adversarial.cpu()
        self._best = self._best.scatter_reduce(0, scene_index, returns, "amax")
        scenes, inverse = scene_index[adversarial].unique(return_inverse=True)
        total = torch.zeros(len(scenes)).index_add(0, inverse, returns[adversarial])
        mean = total / torch.bincount(inverse, minlength=len(scenes)).clamp(min=1)
        before = self._recent[scenes]
        moved = before + self.settings.smoothing * (mean - before)
        self._recent[scenes] = torch.where(before.isnan(), mean, moved)

    def leave_out(self, scene_index: Tensor) -> None:
        """Scenes whose adversarial traffic was not driven because nobody could: not known to hold regret, they count as
        solved until they are driven, or they would come first in every draw."""
        scene_index = scene_index.cpu()
        recent, best = self._recent[scene_index], self._best[scene_index]
        self._recent[scene_index] = torch.where(recent.isnan() & best.isfinite(), best, recent)

    def advance(self, collision_rate: float | None = None) -> None:
        """Go to the next round. collision_rate: the ego's in this round's adversarial traffic, deterministic and in
        closed loop; below the target band the intensity rises, above it falls."""
        settings = self.settings
        if collision_rate is not None:
            below, above = collision_rate < settings.target_low, collision_rate > settings.target_high
            moved = self._adapted + settings.eta_step * (below - above)
            self._adapted = min(max(moved, settings.eta_min), settings.eta_max)
        self.round += 1

    def summary(self) -> dict[str, float]:
        """Figures to log."""
        regret, seen = self.regret(), ~self._recent.isnan()
        result = {"eta": self.eta, "share": self.share, "scenes_seen": seen.float().mean().item()}
        return result | ({"regret": regret[seen].mean().item()} if seen.any() else {})

    def state_dict(self) -> dict:
        """Everything that changes."""
        return {
            "round": self.round,
            "adapted": self._adapted,
            "best": self._best,
            "recent": self._recent,
            "drawn": self._drawn,
            "generator": self._generator.get_state(),
        }

    def load_state_dict(self, state: dict) -> None:
        """Go on from a `state_dict`; raises InputError where the number of scenes differs."""
        if len(state["best"]) != len(self._best):
            raise InputError(
                f"the checkpoint's curriculum holds {len(state['best'])} scenes, the data "
                f"{len(self._best)}; resume with the data of the run"
            )
        self.round, self._adapted = state["round"], state["adapted"]
        self._best, self._recent, self._drawn = (state[key].clone() for key in ("best", "recent", "drawn"))
        self._generator.set_state(state["generator"].cpu())


def ranks(value: Tensor) -> Tensor:
    """Ranks [S] of values [S], 1 for the largest; equal values share the mean of their ranks."""
    distinct, inverse, count = value.unique(return_inverse=True, return_counts=True)
    above = count.flip(0).cumsum(0).flip(0) - count
    return (above + (count + 1) / 2)[inverse]
