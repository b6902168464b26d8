"""Algorithm 1: rounds of drawing scenes, attacking the current ego in them, improving it, and moving the curriculum."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.ego.base import Ego
from e2rl.learning.curriculum.scheduler import CurriculumScheduler
from e2rl.learning.episodes import Episodes
from e2rl.learning.improvement import Improvement
from e2rl.settings import check_choice
from e2rl.traffic.pool import TrafficPool

NOMINAL, TRAFFIC = ("prior", "log", "none"), ("replay", "live")
NOISES = 16  # rows per scene in live traffic, each with its own noise
Synthesize = Callable[[Ego, Tensor, float, int], Mapping[str, Tensor]]
Solvable = Callable[[Mapping[str, Tensor]], Tensor]


@dataclass(frozen=True)
class RoundSettings:
    """Fields: `round` in conf/learner/*.yaml."""

    scenes: int = 64
    nominal: str = "prior"
    traffic: str = "replay"

    def __post_init__(self) -> None:
        check_choice("learner.round.nominal", self.nominal, NOMINAL)
        check_choice("learner.round.traffic", self.traffic, TRAFFIC)


@dataclass
class Attack:
    """The traffic of a round: the pool, scenes [L] left out of it, and metrics; contact: the attacked ego's contact
    rate, None if unknown before the episodes are driven."""

    pool: TrafficPool
    left_out: Tensor
    metrics: dict[str, float]
    contact: float | None = None


class Evolution:
    """The state of a run: curriculum, improvement (which holds the ego) and the last round's D'.

    synthesize(ego, scene_index [S], eta, seed) -> {scene_index [S], states [S, T+1, N, 4], valid [S, T+1, N],
    adversaries [S, N] bool, contact [S] bool}: closed-loop traffic against that ego; contact: it was hit.
    solvable(traffic) -> bool [S]: rows that enter D' (None: all).
    """

    def __init__(
        self,
        curriculum: CurriculumScheduler,
        improve: Improvement,
        synthesize: Synthesize,
        settings: RoundSettings,
        seed: int = 0,
        solvable: Solvable | None = None,
    ) -> None:
        self.curriculum, self.improve, self.synthesize = curriculum, improve, synthesize
        self.settings, self.seed, self.solvable = settings, seed, solvable
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
        """One round; returns its metrics, named by group (train/, curriculum/, synthesizer/, time/)."""
        begin = time.perf_counter()
        scenes = self.curriculum.draw(self.settings.scenes)
        state, seed = self.curriculum.summary(), self.seed * 1_000_003 + self.round
        attack = self._live(scenes, seed) if self.settings.traffic == "live" else self._synthesized(scenes, seed)
        synthesized = time.perf_counter()
        learned, self.episodes = self.improve(attack.pool, self.curriculum)
        spent = {"synthesize": synthesized - begin, "improve": time.perf_counter() - synthesized}
        spent |= {name: learned.pop(name) for name in ("collect", "steps_per_second") if name in learned}
        self.curriculum.update(self.episodes.scene_index, self.episodes.returns, self.episodes.adversarial)
        self.curriculum.leave_out(attack.left_out)
        contact = learned.get("contact_adversarial") if attack.contact is None else attack.contact
        self.curriculum.advance(contact)
        attacked = {"scenes": float(len(scenes)), "left_out": float(len(attack.left_out)), **attack.metrics}
        attacked |= {} if contact is None else {"contact": contact}
        groups = {"curriculum": state, "train": learned, "synthesizer": attacked, "time": spent}
        return {f"{group}/{name}": value for group, values in groups.items() for name, value in values.items()}

    def _synthesized(self, scenes: Tensor, seed: int) -> Attack:
        """D' against the current ego, without rows that no driver survives, and nominal traffic."""
        eta = self.curriculum.eta
        traffic = self.synthesize(self.ego, scenes, eta, seed)
        kept = torch.ones_like(traffic["contact"]) if self.solvable is None else self.solvable(traffic)
        self.traffic = {name: value[kept] for name, value in traffic.items()}
        pool = TrafficPool.stored(self.traffic, eta)
        if self.settings.nominal == "prior":
            pool = pool + TrafficPool.stored(self.synthesize(self.ego, scenes, 0.0, seed), 0.0)
        elif self.settings.nominal == "log" or not len(pool):  # without nominal traffic the pool may be empty
            pool = pool + TrafficPool.recorded(scenes)
        attacked = traffic["adversaries"].any(-1).float().mean().item()
        left_out, contact = traffic["scene_index"][~kept], traffic["contact"].float().mean().item()
        return Attack(pool, left_out, {"attacked": attacked}, contact)

    def _live(self, scenes: Tensor, seed: int) -> Attack:
        """Rows whose traffic is replanned against the learning ego, attacked and nominal."""
        index = scenes.repeat(NOISES)
        noise = index + (seed * NOISES + torch.arange(NOISES).repeat_interleave(len(scenes))) * 1_000_003
        pool = TrafficPool.live(index, torch.full((len(index),), float(self.curriculum.eta)), noise)
        if self.settings.nominal == "prior":
            pool = pool + TrafficPool.live(index, torch.zeros(len(index)), noise)
        elif self.settings.nominal == "log":
            pool = pool + TrafficPool.recorded(scenes)
        return Attack(pool, scenes[:0], {})

    def state_dict(self) -> dict:
        """Curriculum and improvement; the checkpoint adds weights, traffic and generators."""
        return {"curriculum": self.curriculum.state_dict(), "improvement": self.improve.state_dict()}

    def load_state_dict(self, state: dict) -> None:
        """Restore a `state_dict`."""
        self.curriculum.load_state_dict(state["curriculum"])
        self.improve.load_state_dict(state["improvement"])
