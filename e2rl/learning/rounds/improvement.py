"""The extension point for learners: the update of the ego in a round."""

from abc import ABC, abstractmethod
from pathlib import Path

from e2rl.learning.rounds.episodes import Episodes
from e2rl.learning.rounds.scheduler import CurriculumScheduler
from e2rl.planners.ego import Ego
from e2rl.run.config import Extension
from e2rl.traffic.pool import TrafficPool


class Improvement(Extension, ABC):
    """Improves `ego` in the round's pool. A subclass is built as `_target_(ego=,
    scenes=, sim=, seed=, device=, **settings)`."""

    ego: Ego

    @abstractmethod
    def __call__(
        self,
        pool: TrafficPool,
        curriculum: CurriculumScheduler,
    ) -> tuple[dict[str, float], Episodes]:
        """Learn from the pool; returns the metrics to log and the episodes that the ego
        drove."""

    @abstractmethod
    def outcome(self, folder: Path) -> str:
        """A message that explains how to evaluate the improved ego of a run's folder."""

    def state_dict(self) -> dict:
        """All state but an actor's weights, which have their own file."""
        return {}

    def load_state_dict(self, state: dict) -> None:  # noqa: B027
        """Restore a `state_dict`."""
