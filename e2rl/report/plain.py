"""The answer of a run for a reader who knows no word of its field."""

import math
from typing import Any

from e2rl.evaluation.rates import EgoRates
from e2rl.evaluation.summary import Headline
from e2rl.metrics.statistics import LEAST
from e2rl.report.answer import per_cent, tally
from e2rl.report.rates import number

FAILED = "cfr_preventable"
PREVENTABLE = "that a careful driver in its place would have avoided"
INTERVAL = (
    "95% interval: of 100 ranges made like this one, about 95 hold the true value."
)
UNKNOWN = "How far chance changes this is not known."
FEW = f"{UNKNOWN} That takes scenes of at least {LEAST} places."
ATTACKED = (
    "Some vehicles, red in the pictures, are steered to provoke a collision. So this "
    "says in what ways the planner fails, not how often it would on a road."
)
NOMINAL = "Nobody is steered against the car."
DRIVER = (
    "A model of an attentive human driver, from the United Nations' rule on automated "
    "driving (Regulation 157), put in the car's place."
)


def plain_answer(
    headline: Headline,
    measured: dict[str, Any],
    *,
    ego: str,
    eta: float,
) -> dict[str, Any]:
    """Returns what such a reader is told of one ego in one traffic: `number`, what it is
    a number of (`meaning`), its `interval`, and what was `driven`, by term.

    Args:
        headline: of the rollouts.
        measured: their row of metrics.json; without metrics where the run goes on.
        ego: its name.
        eta: intensity of the traffic.
    """
    estimate = measured["metrics"].get(FAILED, {})
    count = headline.failed
    total = headline.scenes
    unit = "scenes"
    interval = UNKNOWN
    if estimate.get("n"):
        count = tally(measured, FAILED)
        total = estimate["n"]
        several = headline.searches > 1
        if several or total != headline.scenes:
            unit = "series of tries" if several else "drives"
        interval = FEW
        if not math.isnan(estimate["low"]):
            low = per_cent(estimate["low"])
            high = per_cent(estimate["high"])
            interval = (
                f"In other scenes of this kind, expect between {low} and {high}. "
                f"{INTERVAL}"
            )
    share = f" ({per_cent(count / total)})" if total else ""
    meaning = f"the car has a collision {PREVENTABLE}"
    if headline.raised:
        meaning += ", or its program stops with an error"
    tries = ""
    if headline.searches:
        tries = f" Each is tried {headline.tries:.1f} times on average."
    scenes = (
        f"{headline.scenes} of the data set {measured['dataset']} (part "
        f"{measured['split']}): a scene is a few seconds of traffic at one place.{tries}"
    )
    return {
        "number": f"In {count} of {total} {unit}{share}",
        "meaning": f"{meaning}.",
        "interval": interval,
        "driven": {**planner(ego), "Scenes": scenes, **others(eta)},
    }


def plain_rate(ego: EgoRates) -> dict[str, Any]:
    """Returns the same of a rate in traffic as the prior has it."""
    rate = ego.rates[ego.target]["1000km"]
    meaning = "in traffic that nobody steers against the car"
    if ego.target == "preventable":
        meaning = f"{PREVENTABLE}, {meaning}"
    interval = FEW
    if not math.isnan(rate.low):
        interval = (
            f"Expect between {number(rate.low)} and {number(rate.high)}. {INTERVAL}"
        )
    scenes = f"{len(ego.scenes)}: a scene is a few seconds of traffic at one place."
    return {
        "number": f"About {number(rate.value)} collisions per 1,000 km",
        "meaning": f"{meaning}.",
        "interval": interval,
        "driven": {**planner(ego.ego), "Scenes": scenes, **others(0.0)},
    }


def planner(ego: str) -> dict[str, str]:
    """Returns what is told of a planner."""
    return {
        "Planner": f"{ego}: the program under test. It steers one car, blue in the "
        "pictures, in traffic that a computer simulates."
    }


def others(eta: float) -> dict[str, str]:
    """Returns what is told of the other drivers."""
    return {
        "Other vehicles": ATTACKED if eta else NOMINAL,
        "Careful driver": DRIVER,
    }
