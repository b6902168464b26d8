"""What populations say of an ego: the probability in each scene, the rate over scenes,
and the likeliest failures (docs/guide/rate.md)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from e2rl.driving.scored import Scored
from e2rl.metrics.statistics import cluster_index
from e2rl.scenes.recording import DT
from e2rl.scenes.scene import SceneSet
from e2rl.tail.estimate import Estimate
from e2rl.tail.interval import Bounds, Side, of_counts, of_logs, of_ratio
from e2rl.tail.sampler import REACHED

EVENTS = ("contact", "preventable", "counted")
HOUR = 3600.0  # s
DISTANCE = 1000.0  # km
UNITS = ("scene", "hour", "1000km")


@dataclass(frozen=True)
class SceneRate:
    """What is known of one scene.

    Args:
        scene_id: of the scene.
        location: of the scene, "" where it has no name.
        probability: of each event in each repetition, {event: [R]}.
        bounds: of the target's probability; without an interval where it is of one
            population.
        at_most: estimate of what populations that ended before the target may add to
            its probability.
        independent: its rollouts are, and not of populations.
        km: that the ego drives in a rollout.
        rollouts: that were driven.
        end: of the first population.
        raised: rollouts in which the planner raised.
        lost: rollouts in which the traffic raised.
        failures: that were drawn; rows have a `weight`, their part of the probability,
            and the scene's nats as `transport`.
    """

    scene_id: str
    location: str
    probability: dict[str, Tensor]
    bounds: Bounds
    at_most: float
    independent: bool
    km: float
    rollouts: int
    end: str
    raised: int
    lost: int
    failures: Scored

    @property
    def nats(self) -> float:
        """-log P(failure | scene): the least that any control of the traffic costs."""
        return -math.log(self.bounds.value) if self.bounds.value > 0 else math.inf


def scene_rates(
    estimates: Sequence[Estimate], scenes: SceneSet, target: str
) -> list[SceneRate]:
    """Returns the scenes of some estimates, the likeliest failure first.

    Args:
        estimates: of one ego.
        scenes: whose positions they count.
        target: of the populations.
    """
    by_scene: dict[int, list[Estimate]] = {}
    for estimate in estimates:
        by_scene.setdefault(estimate.scene, []).append(estimate)
    rates = [
        scene_rate(
            parts,
            target,
            scene_id=scenes.scene_id[scene],
            location=scenes.location[scene],
        )
        for scene, parts in by_scene.items()
    ]
    return sorted(rates, key=lambda rate: (-rate.bounds.value, -rate.at_most))


def scene_rate(
    parts: Sequence[Estimate],
    target: str,
    *,
    scene_id: str,
    location: str,
) -> SceneRate:
    """Returns what the populations of one scene say."""
    tallies = [part.tally for part in parts]

    def column(values: Sequence[float]) -> Tensor:
        return torch.tensor(values, dtype=torch.float64)

    probability = {
        "contact": column([tally.contact for tally in tallies]),
        "counted": column([tally.counted for tally in tallies]),
    }
    probability[target] = column([tally.probability for tally in tallies])
    unresolved = column([0.0 if t.end == REACHED else t.bound for t in tallies])
    hits = [tally.hits for tally in tallies if tally.hits is not None]
    if hits:
        bounds = of_counts(sum(hits), sum(tally.rollouts for tally in tallies))
    else:
        bounds = target_bounds(probability[target], unresolved)
    failures = Scored()
    for part in parts:
        failures.add(part.failures)
    for row in failures.rows:
        row["weight"] /= len(parts)
        row["transport"] = -math.log(bounds.value)
    return SceneRate(
        scene_id,
        location,
        probability=probability,
        bounds=bounds,
        at_most=float(unresolved.mean()),
        independent=bool(hits),
        km=sum(part.km for part in parts) / len(parts),
        rollouts=sum(tally.rollouts for tally in tallies),
        end=tallies[0].end,
        raised=sum(part.raised for part in parts),
        lost=sum(part.lost for part in parts),
        failures=failures,
    )


def target_bounds(probability: Tensor, unresolved: Tensor) -> Bounds:
    """Returns the target's probability in a scene with its interval.

    Args:
        probability: [R], estimates of populations, 0 of those that ended before.
        unresolved: [R], what the probability may be in these.
    """
    value = float(probability.mean())
    if len(probability) == 1:
        return Bounds(value, math.nan, math.nan)
    interval = of_logs((probability + unresolved).log())
    low = 0.0 if bool(unresolved.any()) else interval.low
    return Bounds(value, low, high=interval.high)


def rates_of(scenes: Sequence[SceneRate], steps: int) -> dict[str, dict[str, Bounds]]:
    """Returns the rates {event: {unit: bounds}} of the events that all scenes know, over
    scenes of so many steps.

    The interval's end holds what is `unresolved_in` the scenes.
    """
    km = torch.tensor([scene.km for scene in scenes], dtype=torch.float64)
    unresolved = unresolved_in(scenes)
    ones = torch.ones_like(km)
    exposures = (ones, ones * steps * DT / HOUR, km / DISTANCE)
    place, _ = cluster_index(
        [scene.location for scene in scenes], [scene.scene_id for scene in scenes]
    )
    rates: dict[str, dict[str, Bounds]] = {}
    for event in EVENTS:
        if event not in scenes[0].probability:
            continue
        estimates = [scene.probability[event] for scene in scenes]
        rates[event] = {}
        for unit, exposure in zip(UNITS, exposures, strict=True):
            bounds = of_ratio(Side(estimates, exposure, place))
            high = bounds.high + unresolved / float(exposure.sum())
            high = min(high, 1.0) if unit == "scene" else high
            rates[event][unit] = bounds._replace(high=high)
    return rates


def unresolved_in(scenes: Sequence[SceneRate]) -> float:
    """Returns the sum of what scenes may add in which populations ended before the
    target.

    Of independent rollouts, n in each, scenes without a failure share one bound b: that n
    fail in none has a chance of (1 - p)^n (1 - q)^n <= exp(-n (p + q)), which is (1 -
    b)^n where p + q is -log(1 - b).
    """
    at_most = [scene.at_most for scene in scenes]
    if scenes[0].independent:
        return -math.log1p(-max(at_most))
    return sum(at_most)


def as_json(scene: SceneRate) -> dict[str, Any]:
    """Returns the row of rates.json of a scene."""
    return {
        "scene_id": scene.scene_id,
        "location": scene.location,
        "probability": scene.bounds.value,
        "low": scene.bounds.low,
        "high": scene.bounds.high,
        "at_most": scene.at_most,
        "nats": scene.nats if scene.bounds.value > 0 else None,
        "repetitions": {
            name: values.tolist() for name, values in scene.probability.items()
        },
        "km": scene.km,
        "rollouts": scene.rollouts,
        "end": scene.end,
        "raised": scene.raised,
        "lost": scene.lost,
        "failures": len(scene.failures.rows),
    }
