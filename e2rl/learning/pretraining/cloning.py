"""Behaviour cloning: demonstrations, a teacher's soft labels, and their losses.

Demonstrations are a TensorDict [M] of observation [M, D] and action [M, 2]. A teacher's
labels are a TensorDict [M] of observation [M, D], action [M, C, 2] and weight [M, C] >= 0
that sums to 1: what the teacher might do there, and how much speaks for each.
"""

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.modules import ProbabilisticActor

from e2rl.planners.network import ActorNetwork
from e2rl.sim.observation import mirrored

LABEL_WIDTH = (0.25, 0.12)  # of acceleration and yaw rate, in halves of the range
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


def teaching_loss(network: ActorNetwork, labels: TensorDictBase) -> Tensor:
    """Mean of -log sum_c w_c exp(-|a_c - a(o)|^2 / 2) over labels [M], distances in
    units of LABEL_WIDTH, of the most central actions a(o).

    It is least where a(o) is near one label of large weight. Evasions differ: the mean
    of one to the left and one to the right is none. It leaves the actor's deviation
    alone, which a likelihood of the labels would widen.
    """
    width = network.reach * network.reach.new_tensor(LABEL_WIDTH)
    central = network.deterministic(labels["observation"])
    offset = (labels["action"] - central[:, None]) / width
    likelihood = (labels["weight"].log() - offset.square().sum(-1) / 2).logsumexp(1)
    return -likelihood.mean()


def mirrored_labels(labels: TensorDictBase) -> TensorDict:
    """The labels [M] with left and right exchanged."""
    action = labels["action"] * labels["action"].new_tensor([1.0, -1.0])
    return TensorDict(
        {
            "observation": mirrored(labels["observation"]),
            "action": action,
            "weight": labels["weight"],
        },
        batch_size=labels.batch_size,
    )


def sampled(rows: TensorDictBase, count: int) -> TensorDictBase:
    """`count` of the rows [M], drawn evenly with replacement."""
    return rows[torch.randint(len(rows), (count,), device=rows.device)]
