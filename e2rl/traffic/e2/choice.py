"""The choice among joint samples of a replan, and its price in nats.

Of every scene one plain sample is drawn, and one to each of its kernels; the one of
highest value is driven.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.traffic.e2.kernels import Kernels

# Weight of all drawn samples of a scene together in the price of a choice; the plain
# one has the rest.
DRAWN = 0.1


@dataclass(frozen=True)
class Tries:
    """The joint samples of a replan: a plain one of each of B scenes, then one to each
    kernel of scenes rows [R].

    scenes [C] int64 of the samples; goal [C, V, SIZE]; drawn [C, V] bool: who is pulled
    to it.
    """

    rows: Tensor
    scenes: Tensor
    goal: Tensor
    drawn: Tensor


def joint_tries(kernels: Kernels, rows: Tensor) -> Tries:
    """Returns the samples to draw to kernels in scenes rows [R] int64."""
    batch, count, _ = kernels.goal.shape
    first = torch.arange(batch, device=rows.device)
    vehicle = torch.cat([torch.full_like(first, -1), kernels.vehicle[rows].flatten()])
    plain = torch.zeros_like(kernels.goal[:, 0])
    goal = torch.cat([plain, kernels.goal[rows].flatten(0, 1)])
    return Tries(
        rows=rows,
        scenes=torch.cat([first, rows.repeat_interleave(count)]),
        goal=goal[:, None].expand(-1, kernels.vehicles, -1),
        drawn=vehicle[:, None] == torch.arange(kernels.vehicles, device=rows.device),
    )


def best_try(value: Tensor, rows: Tensor, batch: int) -> Tensor:
    """Returns which [B] of the samples is worth the most in each scene, of their value
    [C]; ties: the first. rows [R]: scenes with more than one; batch: B."""
    count = (len(value) - batch) // max(len(rows), 1)
    place = torch.arange(batch, device=rows.device)[:, None].repeat(1, count + 1)
    drawn = torch.arange(batch, len(value), device=rows.device)
    place[rows, 1:] = drawn.view(len(rows), count)
    return place.gather(1, value[place].argmax(1, keepdim=True))[:, 0]


def drawn_nats(count: int) -> float:
    """Returns the nats of taking one of `count` drawn samples of a scene."""
    return math.log(count / DRAWN)


def choice_nats(rows: Tensor, batch: int, count: int) -> Tensor:
    """Returns the nats [C] of taking each of the samples: -log of its weight among the
    plain one and `count` drawn ones; 0 in scenes without a choice, not in rows [R].

    Let r be the law of what is taken, m the sample that it is. r(x, m) <= q_m(x), so
    KL(r, p) <= E[log q_m/p - log w_m] for any weights w that sum to 1.
    """
    plain = torch.zeros(batch, device=rows.device)
    plain = plain.index_fill(0, rows, -math.log1p(-DRAWN))
    taken = plain.new_full((len(rows) * count,), drawn_nats(count))
    return torch.cat([plain, taken])
