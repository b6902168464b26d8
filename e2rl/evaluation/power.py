"""How many scenes a comparison takes: two egos, or one before and after training, fail in
fractions p and p r of the same scenes.

Of N scenes, p(1 - p r) - c fail with the first alone and p r (1 - p) - c with the second
alone, c the covariance of their failures in a scene. McNemar's test tells them apart with
a chance of `power` where N is at least (Connor 1987)

    (z sqrt(d) + y sqrt(d - e^2))^2 / e^2,  d the sum and e the difference of the two

fractions, z and y the normal quantiles of 97.5% and of the power.
"""

import math

from scipy.optimize import brentq
from scipy.stats import norm

from e2rl.run.errors import InputError

LEVEL = 0.95  # of the two-sided interval that is to exclude 1
LEAST = 1e-6  # ratio that is looked at


def scenes_needed(
    rate: float, ratio: float, *, correlation: float, power: float
) -> int:
    """Returns the scenes in which a ratio of failure rates is seen.

    Args:
        rate: p, of the first ego.
        ratio: r, of the second's rate to it.
        correlation: of their failures in a scene, below what the rates allow.
        power: chance that the interval of the difference excludes 0.

    Raises:
        InputError: rates that are none, equal ones, or a correlation beyond them.
    """
    second = rate * ratio
    if not (0 < rate < 1 and 0 <= second < 1 and ratio != 1 and 0 < power < 1):
        raise InputError(
            f"rate {rate:g}, ratio {ratio:g}, power {power:g}: expected a rate and a "
            "power between 0 and 1, and a ratio other than 1 that leaves a rate below 1"
        )
    spread = math.sqrt(rate * (1 - rate) * second * (1 - second))
    covariance = correlation * spread
    first_alone = rate * (1 - second) - covariance
    second_alone = second * (1 - rate) - covariance
    if min(first_alone, second_alone) < 0:
        highest = min(rate * (1 - second), second * (1 - rate)) / spread
        raise InputError(
            f"correlation {correlation:g}: failures at rates {rate:g} and {second:g} have "
            f"at most {highest:.2f}"
        )
    differ = first_alone + second_alone
    effect = first_alone - second_alone
    quantile = norm.ppf((1 + LEVEL) / 2)
    root = quantile * math.sqrt(differ)
    root += norm.ppf(power) * math.sqrt(differ - effect**2)
    return math.ceil((root / effect) ** 2)


def ratio_seen(rate: float, scenes: int, *, correlation: float, power: float) -> float:
    """Returns the highest ratio below 1 that so many scenes show; NaN where they would
    not see failures vanish. Arguments are those of `scenes_needed`."""

    def missing(ratio: float) -> float:
        needed = scenes_needed(rate, ratio, correlation=correlation, power=power)
        return math.log(needed / scenes)

    if missing(LEAST) > 0:
        return math.nan
    return float(brentq(missing, LEAST, 1 - LEAST, xtol=1e-4))
