"""The estimate of a population of rollouts in one scene."""

from typing import NamedTuple

from e2rl.driving.scored import Scored
from e2rl.tail.sampler import Tally


class Estimate(NamedTuple):
    """What one population says of a scene.

    Args:
        scene: its position.
        repetition: of the population.
        tally: the probabilities.
        km: that the ego drives in a rollout, on average.
        raised: rollouts in which the planner raised, which count as failures.
        lost: rollouts in which the traffic raised, which are none.
        failures: the rollouts that reached the target; rows have a `weight`.
    """

    scene: int
    repetition: int
    tally: Tally
    km: float
    raised: int
    lost: int
    failures: Scored
