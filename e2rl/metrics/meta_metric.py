"""A realism meta-metric in the style of the Waymo Open Sim Agents Challenge (features and weights of its 2025 edition).

Each vehicle has a histogram of every feature over all its rollouts and steps (steps taken as independent). With it,
likelihood = exp(mean log p(logged value)) over a scene's vehicles and known steps. Indications (collision, off the
road, red light) happen to a vehicle in a rollout or not: their p is Bernoulli, the share of rollouts. Every bin has
additive smoothing SMOOTHING. The meta-metric is the weighted sum of the likelihoods, in (0, 1].
"""

from dataclasses import dataclass

import torch
from torch import Tensor

SMOOTHING = 0.1


@dataclass(frozen=True)
class Feature:
    """Its weight in the meta-metric; range and number of bins of its histogram, bins = 0 for an indication."""

    weight: float
    low: float = 0.0
    high: float = 0.0
    bins: int = 0


FEATURES = {
    "linear_speed": Feature(0.05, 0.0, 25.0, 10),
    "linear_accel": Feature(0.05, -12.0, 12.0, 11),
    "angular_speed": Feature(0.05, -0.628, 0.628, 11),
    "angular_accel": Feature(0.05, -3.14, 3.14, 11),
    "nearest_object": Feature(0.10, -5.0, 40.0, 10),
    "collision": Feature(0.25),
    "time_to_collision": Feature(0.10, 0.0, 5.0, 10),
    "road_edge": Feature(0.05, -20.0, 40.0, 10),
    "offroad": Feature(0.25),
    "red_light": Feature(0.05),
}
HISTOGRAMS = tuple(name for name, feature in FEATURES.items() if feature.bins)
INDICATIONS = tuple(name for name, feature in FEATURES.items() if not feature.bins)


def bin_index(values: Tensor, feature: Feature) -> Tensor:
    """Bin [...] int64 of values [...]; values outside the range count in the first or last bin."""
    position = (values - feature.low) / (feature.high - feature.low) * feature.bins
    return position.floor().long().clamp(0, feature.bins - 1)


def bin_counts(index: Tensor, known: Tensor, bins: int) -> Tensor:
    """Number [M, bins] of known [M, T] values in each bin index [M, T]."""
    empty = torch.zeros(len(index), bins, dtype=torch.float64, device=index.device)
    return empty.scatter_add(1, index, known.double())


def log_probability(counts: Tensor, index: Tensor) -> Tensor:
    """log p [M, T] of bins index [M, T] under the smoothed histogram of counts [M, bins]."""
    p = (counts + SMOOTHING) / (counts.sum(-1, keepdim=True) + SMOOTHING * counts.shape[-1])
    return p.log().gather(1, index)


def log_bernoulli(hits: Tensor, rollouts: Tensor | float, happened: Tensor) -> Tensor:
    """log p [M] of an indication that happened [M] bool in the log and in `hits` [M] of the rollouts."""
    p = (hits + SMOOTHING) / (rollouts + 2 * SMOOTHING)
    return torch.where(happened, p, 1 - p).log()


def likelihood(log_p: Tensor, known: Tensor, scene: Tensor, scenes: int) -> Tensor:
    """exp of the mean log_p [M, T] over the known [M, T] values of each scene [M] int64; NaN where it has none."""
    total = log_p.new_zeros(scenes).index_add(0, scene, (log_p * known).sum(-1))
    count = log_p.new_zeros(scenes).index_add(0, scene, known.to(log_p.dtype).sum(-1))
    return (total / count).exp()


def meta_metric(likelihoods: dict[str, Tensor]) -> Tensor:
    """Weighted sum [...] of the features' likelihoods [...]."""
    return sum((feature.weight * likelihoods[name] for name, feature in FEATURES.items()), start=torch.zeros(()))
