"""Algorithm 1: rounds of drawing scenes, attacking the current ego in them, improving it, and moving the curriculum."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.ego.base import Ego
from e2rl.errors import InputError
from e2rl.learning.curriculum import CurriculumScheduler
from e2rl.learning.episodes import Episodes
from e2rl.learning.improvement import PlannerImprovement, PolicyImprovement
from e2rl.learning.pool import TrafficPool
from e2rl.learning.solvability import Solvable

NOMINAL = ("prior", "log", "none")
Synthesize = Callable[[Ego, Tensor, float, int], Mapping[str, Tensor]]
Measure = Callable[[Ego, int], Mapping[str, float]]


@dataclass(frozen=True)
class RoundSettings:
    """Fields: `round` in conf/learner/*.yaml."""

    scenes: int = 64
    nominal: str = "prior"

    def __post_init__(self) -> None:
        if self.nominal not in NOMINAL:
            raise InputError(f"learner.round.nominal={self.nominal}: choose one of {', '.join(NOMINAL)}")


class Evolution:
    """The state of a run: curriculum, improvement (which holds the ego) and the last round's D'.

    synthesize(ego, scene_index [S], eta, seed) -> {scene_index [S], states [S, T+1, N, 4], valid [S, T+1, N],
    adversaries [S, N] bool, contact [S] bool, and optionally route [S, V]}: closed-loop traffic against that ego and
    whether it was hit. measure(ego, round) -> metrics, called before and after the improvement of each round.
    solvable(traffic) -> bool [S]: rows that enter D'; all for None.
    """

    def __init__(
        self,
        curriculum: CurriculumScheduler,
        improve: PolicyImprovement | PlannerImprovement,
        synthesize: Synthesize,
        settings: RoundSettings,
        seed: int = 0,
        measure: Measure | None = None,
        solvable: Solvable | None = None,
    ) -> None:
        self.curriculum, self.improve, self.synthesize = curriculum, improve, synthesize
        self.settings, self.seed, self.measure, self.solvable = settings, seed, measure, solvable
        self.traffic: dict[str, Tensor] = {}
        self.episodes: Episodes | None = None

    @property
    def ego(self) -> Ego:
        """The current ego."""
        return self.improve.ego

    @property
    def round(self) -> int:
        """Rounds done."""
        return self.curriculum.round

    def run_round(self) -> dict[str, float]:
        """One round; returns its metrics, named by group (train/, curriculum/, synthesizer/, eval/, time/)."""
        clock = [time.perf_counter()]
        scenes = self.curriculum.draw(self.settings.scenes)
        state, seed = self.curriculum.summary(), self.seed * 1_000_003 + self.round
        attack = self.synthesize(self.ego, scenes, self.curriculum.eta, seed)
        kept = torch.ones_like(attack["contact"]) if self.solvable is None else self.solvable(attack)
        self.traffic = {name: value[kept] for name, value in attack.items()}
        pool = TrafficPool.synthesized(self.traffic, adversarial=True) + self._nominal(scenes, seed)
        pool = pool if len(pool) else TrafficPool.recorded(scenes)  # without nominal traffic there may be nothing left
        clock.append(time.perf_counter())
        before = self._measured("before")
        clock.append(time.perf_counter())
        learned, self.episodes = self.improve(pool, self.curriculum)
        clock.append(time.perf_counter())
        after = self._measured("after")
        contact = attack["contact"].float().mean().item()
        self.curriculum.update(self.episodes.scene_index, self.episodes.returns, self.episodes.adversarial)
        self.curriculum.leave_out(attack["scene_index"][~kept])
        self.curriculum.advance(contact)
        spent = [later - earlier for earlier, later in zip(clock[:-1], clock[1:], strict=True)]
        return {
            **_group("curriculum", state),
            **_group("train", learned),
            **before,
            **after,
            **_group(
                "synthesizer",
                {
                    "contact": contact,
                    "attacked": attack["adversaries"].any(-1).float().mean().item(),
                    "scenes": float(len(scenes)),
                    "left_out": float((~kept).sum()),
                },
            ),
            **_group("time", {"synthesize": spent[0], "improve": spent[2]}),
        }

    def _nominal(self, scenes: Tensor, seed: int) -> TrafficPool:
        """The same scenes without an adversary: the prior's traffic (eta 0), the recording, or none."""
        if self.settings.nominal == "prior":
            return TrafficPool.synthesized(self.synthesize(self.ego, scenes, 0.0, seed), adversarial=False)
        return TrafficPool.recorded(scenes if self.settings.nominal == "log" else scenes[:0])

    def _measured(self, stage: str) -> dict[str, float]:
        if self.measure is None:
            return {}
        return {f"eval/{stage}_{name}": value for name, value in self.measure(self.ego, self.round).items()}

    def state_dict(self) -> dict:
        """Curriculum and improvement; weights, traffic and generators are the checkpoint's."""
        return {"curriculum": self.curriculum.state_dict(), "improvement": self.improve.state_dict()}

    def load_state_dict(self, state: dict) -> None:
        """Go on from a `state_dict`."""
        self.curriculum.load_state_dict(state["curriculum"])
        self.improve.load_state_dict(state["improvement"])


def _group(name: str, values: Mapping[str, float]) -> dict[str, float]:
    return {f"{name}/{key}": value for key, value in values.items()}
