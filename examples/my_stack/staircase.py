"""A curriculum: the intensity climbs one stair whenever the ego has coped with the
present one."""

from e2rl.learning.rounds.scheduler import CurriculumScheduler


class Staircase(CurriculumScheduler):
    """Starts on the first of `stairs`; goes up after a round with a collision rate of
    at most `coped`."""

    lasting = ("_level",)

    def __init__(
        self,
        num_scenes,
        rounds,
        seed=0,
        stairs=(0.5, 1.0, 2.0, 3.0),
        coped=0.3,
        fraction=0.5,
        **scenes,
    ):
        super().__init__(num_scenes, rounds, seed, **scenes)
        self._stairs = list(stairs)
        self._coped = coped
        self.fraction = fraction
        self._level = 0

    @property
    def eta(self) -> float:
        """The present stair."""
        return self._stairs[self._level]

    def advance(self, collision_rate: float | None = None) -> None:
        """Climb, unless at the top."""
        super().advance(collision_rate)
        if collision_rate is not None and collision_rate <= self._coped:
            self._level = min(self._level + 1, len(self._stairs) - 1)
