"""Behaviour cloning: demonstrations with soft labels, and their losses.

Demonstrations are a TensorDict [M] of observation [M, D], action [M, C, 2] and weight
[M, C] >= 0 that sums to 1: what a teacher might do there, and how much speaks for each.
One certain action is C = 1 with weight 1.
"""

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import LossModule

from e2rl.planners.network import ActorNetwork
from e2rl.sim.env import DrivingEnv
from e2rl.sim.observation import mirrored

LABELLED = ("observation", "action", "weight")
LABEL_WIDTH = (
    0.25,
    0.12,
)  # of acceleration and yaw rate, in halves of the action's range
EXPERT_RANGE = 0.99  # expert actions are clipped to this fraction of the bounds, where the squashed density is infinite
# Standard deviations of noise on the network's normalised input while cloning, and on
# the last executed action in it, which an imitator otherwise just repeats.
NOISE = (0.3, 1.0)


def clip_expert(action: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Actions [..., 2] within EXPERT_RANGE of the bounds low, high [2]."""
    middle = (high + low) / 2
    reach = (high - low) / 2 * EXPERT_RANGE
    return torch.maximum(torch.minimum(action, middle + reach), middle - reach)


def demonstrations_of(
    frames: TensorDictBase,
    kept: Tensor,
    scene_index: Tensor,
    env: DrivingEnv,
    action: Tensor,
) -> TensorDict:
    """Returns demonstrations [M] with their scene_index [M], on the CPU, of frames kept
    [B, T] of a `PoolDriver.drive`.

    action [B, T, C, 2], clipped here, all C of the same weight; scene_index [B].
    """
    action = clip_expert(
        action[kept], env.action_spec.space.low[0], high=env.action_spec.space.high[0]
    )
    weight = torch.full_like(action[..., 0], 1 / action.shape[1])
    scene = scene_index[:, None].to(kept.device).expand(kept.shape)[kept]
    found = {
        "observation": frames["observation"][kept],
        "action": action,
        "weight": weight,
        "scene_index": scene,
    }
    return TensorDict(found, batch_size=[len(scene)]).cpu()


class CloningLoss(LossModule):
    """Cross-entropy "loss_cloning" [] of an actor's density under the labels of
    demonstrations [M]: the mean of -sum_c w_c log pi(a_c | o), where `BCLoss` takes one
    label.

    Its gradient is the weighted mean of the gradients of the single actions. A squashed
    Gaussian has one mode: at the minimum its mean before squashing is the weighted mean
    of the actions there, and its variance theirs.
    """

    in_keys, out_keys, functional = [*LABELLED], ["loss_cloning"], False

    def __init__(self, actor: ProbabilisticActor) -> None:
        super().__init__()
        self.actor = actor

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The loss on demonstrations [M]."""
        density = self.actor.get_dist(tensordict.select("observation"))
        likelihood = density.log_prob(tensordict["action"].transpose(0, 1)).transpose(
            0, 1
        )
        return TensorDict(
            {"loss_cloning": -(tensordict["weight"] * likelihood).sum(1).mean()}
        )


class TeachingLoss(LossModule):
    """Mean "loss_teaching" [] of -log sum_c w_c exp(-|a_c - a(o)|^2 / 2), distances in
    units of LABEL_WIDTH, of the most central actions a(o) under the labels of
    demonstrations [M]: least where a(o) is near one label of large weight.

    Evasions differ: the mean of one to the left and one to the right is none.
    `CloningLoss` has such means, and fits the actor's own deviation too: late in a
    training, when that is a tenth, its gradient is a hundred times as large as early,
    and it widens the exploration.
    """

    in_keys, out_keys, functional = [*LABELLED], ["loss_teaching"], False

    def __init__(self, network: ActorNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The loss on demonstrations [M]."""
        width = self.network.reach * self.network.reach.new_tensor(LABEL_WIDTH)
        central = self.network.deterministic(tensordict["observation"])
        apart = (tensordict["action"] - central[:, None]) / width
        likelihood = (
            tensordict["weight"].log() - apart.square().sum(-1) / 2
        ).logsumexp(1)
        return TensorDict({"loss_teaching": -likelihood.mean()})


def mirrored_demonstrations(shown: TensorDictBase) -> TensorDict:
    """The demonstrations [M] with left and right exchanged."""
    action = shown["action"] * shown["action"].new_tensor([1.0, -1.0])
    found = {
        "observation": mirrored(shown["observation"]),
        "action": action,
        "weight": shown["weight"],
    }
    return TensorDict(found, batch_size=shown.batch_size)


def drawn(experts: Sequence[TensorDictBase], count: int) -> TensorDict:
    """`count` demonstrations, drawn evenly from each kind of experts (none empty),
    however many it has.

    Labels are filled up to the most candidates C of any kind, with actions of weight 0.
    """
    kinds = len(experts)
    most = max(each["action"].shape[1] for each in experts)
    parts = []
    for kind, each in enumerate(experts):
        own = count * (kind + 1) // kinds - count * kind // kinds
        part = each[torch.randint(len(each), (own,), device=each.device)]
        action = part["action"]
        weight = part["weight"]
        missing = most - action.shape[1]
        action = torch.cat([action, action[:, :1].expand(-1, missing, -1)], 1)
        weight = torch.nn.functional.pad(weight, (0, missing))
        parts.append(
            {"observation": part["observation"], "action": action, "weight": weight}
        )
    joined = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    return TensorDict(joined, batch_size=[count])
