"""Subset simulation beside that of OpenTURNS, on the four-branch series system (Waarts
2000), whose failures are four regions far apart."""

import math

import pytest
import torch

from e2rl.tail.sampler import SamplerSettings
from tests.tail.closed_forms import tally

openturns = pytest.importorskip("openturns")

SHIFT = 4.3  # of the branches: P(failure) some 1e-5
POPULATIONS = 16
SETTINGS = SamplerSettings(
    first=64, particles=64, killed=0.5, moves=16, rollouts=100_000, least=1e-12
)


def branches(x):
    """Minus the limit state of the first two numbers of x [M, V, D]."""
    first, second = x[:, 0, 0].double(), x[:, 1, 0].double()
    across = (first - second) / math.sqrt(2)
    along = (first + second) / math.sqrt(2)
    curved = SHIFT + 0.2 * across**2 - along.abs()
    straight = 7 / math.sqrt(2) + (SHIFT - 3) - math.sqrt(2) * across.abs()
    return -torch.minimum(curved, straight)


@pytest.fixture(scope="module")
def oracle():
    """P(failure) and its standard error, by OpenTURNS."""
    formula = (
        f"min({SHIFT} + 0.1 * (a - b)^2 - abs(a + b) / sqrt(2), "
        f"7 / sqrt(2) + {SHIFT - 3} - abs(a - b))"
    )
    limit_state = openturns.SymbolicFunction(["a", "b"], [formula])
    vector = openturns.RandomVector(openturns.Normal(2))
    event = openturns.ThresholdEvent(
        openturns.CompositeRandomVector(limit_state, vector), openturns.Less(), 0.0
    )
    openturns.RandomGenerator.SetSeed(0)
    algorithm = openturns.SubsetSampling(event)
    algorithm.setMaximumOuterSampling(20_000)
    algorithm.run()
    result = algorithm.getResult()
    return result.getProbabilityEstimate(), result.getStandardDeviation()


def test_the_probability_is_that_of_openturns(oracle):
    probability, deviation = oracle
    estimates = torch.tensor(
        [
            tally(branches, 0.0, numbers=8, seed=seed, settings=SETTINGS).probability
            for seed in range(POPULATIONS)
        ]
    )
    error = math.hypot(float(estimates.std()) / math.sqrt(POPULATIONS), deviation)
    assert error < 0.4 * probability
    assert abs(float(estimates.mean()) - probability) < 3 * error
