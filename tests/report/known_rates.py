"""Rates of an ego as `e2rl rate` would estimate them, of known probabilities."""

from types import SimpleNamespace

from e2rl.driving.scored import Scored
from e2rl.evaluation.rates import EgoRates
from e2rl.tail.estimate import Estimate
from e2rl.tail.sampler import REACHED, SPENT, Tally
from e2rl.tail.summary import scene_rates

COUNT = 40
KM = 0.1
LEAST = 1e-5  # 11.5 nats


def ego_rates(ego, factor=1.0):
    """An ego that fails in every other of COUNT scenes with 0.01 times a factor."""
    estimates = []
    for scene in range(COUNT):
        likely = Tally(0.01 * factor, 0.01, contact=0.02 * factor, rollouts=50)
        likely.end = REACHED
        tally = likely if scene % 2 else Tally(bound=1e-4, rollouts=70, end=SPENT)
        estimates.append(Estimate(scene, 0, tally, KM, 0, 0, Scored()))
    names = SimpleNamespace(
        scene_id=[f"scene {k}" for k in range(COUNT)], location=[""] * COUNT
    )
    scenes = scene_rates(estimates, names, "preventable")
    return EgoRates.of(ego, scenes, target="preventable", least=LEAST, steps=80)
