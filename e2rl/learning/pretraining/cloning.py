"""Behaviour cloning of demonstrations, a TensorDict [M] of observation [M, D] and action
[M, 2]."""

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.modules import ProbabilisticActor

EXPERT_RANGE = 0.99  # of the bounds, at which the squashed density is infinite
# Standard deviations of noise on the network's normalised input while cloning, and on
# the last executed action in it, which an imitator otherwise just repeats.
INPUT_NOISE = 0.3
LAST_ACTION_NOISE = 1.0


def clip_expert(action: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Actions [..., 2] within EXPERT_RANGE of the bounds low, high [2]."""
    middle = (high + low) / 2
    reach = (high - low) / 2 * EXPERT_RANGE
    return torch.maximum(torch.minimum(action, middle + reach), middle - reach)


def cloning_loss(actor: ProbabilisticActor, shown: TensorDictBase) -> Tensor:
    """Mean of -log pi(a | o) over demonstrations [M]: behaviour cloning.

    TorchRL's `BCLoss` would also sample an action, and draw the input's noise twice.
    """
    density = actor.get_dist(shown.select("observation"))
    return -density.log_prob(shown["action"]).mean()
