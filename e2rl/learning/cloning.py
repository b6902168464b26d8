"""Behaviour cloning: expert pairs with soft labels, and their loss.

Pairs are a TensorDict [M] of observation [M, D], action [M, C, 2] and weight [M, C] >= 0 that sums to 1: what a teacher
might do there, and how much speaks for each. One certain action is C = 1 with weight 1.
"""

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.modules import ProbabilisticActor

from e2rl.planners.network import ActorNetwork
from e2rl.sim.env import DrivingEnv
from e2rl.sim.observation import mirrored

LABEL_WIDTH = (0.25, 0.12)  # of acceleration and yaw rate, in halves of the action's range
EXPERT_SHARE = 0.99  # expert actions are clipped to this share of the bounds, where the squashed density is infinite


def clip_expert(action: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Actions [..., 2] within EXPERT_SHARE of the bounds low, high [2]."""
    middle, reach = (high + low) / 2, (high - low) / 2 * EXPERT_SHARE
    return torch.maximum(torch.minimum(action, middle + reach), middle - reach)


def pairs_of(
    frames: TensorDictBase,
    kept: Tensor,
    scene_index: Tensor,
    env: DrivingEnv,
    action: Tensor,
    weight: Tensor | None = None,
) -> TensorDict:
    """Pairs [M], and their scene_index [M], on the CPU of the frames kept [B, T] bool of a `PoolDriver.drive`.

    action [B, T, C, 2], clipped here, and weight [B, T, C] (None: all alike); scene_index [B].
    """
    action = clip_expert(action[kept], env.action_spec.space.low[0], env.action_spec.space.high[0])
    weight = torch.full_like(action[..., 0], 1 / action.shape[1]) if weight is None else weight[kept]
    scene = scene_index[:, None].to(kept.device).expand(kept.shape)[kept]
    pairs = {"observation": frames["observation"][kept], "action": action, "weight": weight, "scene_index": scene}
    return TensorDict(pairs, batch_size=[len(scene)]).cpu()


def cloning_loss(actor: ProbabilisticActor, pairs: TensorDictBase) -> Tensor:
    """Cross-entropy [] of the actor's density under the labels of pairs [M]: the mean of -sum_c w_c log pi(a_c | o).

    Its gradient is the weighted mean of the gradients of the single actions. A squashed Gaussian has one mode: at the
    minimum its mean before squashing is the weighted mean of the actions there, and its variance theirs.
    """
    density = actor.get_dist(pairs.select("observation"))
    likelihood = density.log_prob(pairs["action"].transpose(0, 1)).transpose(0, 1)
    return -(pairs["weight"] * likelihood).sum(1).mean()


def teaching_loss(network: ActorNetwork, pairs: TensorDictBase) -> Tensor:
    """Mean [] of -log sum_c w_c exp(-|a_c - a(o)|^2 / 2), distances in units of LABEL_WIDTH, of the most
    central actions a(o) under the labels of pairs [M]: least where a(o) is near one label that much speaks for.

    Ways out differ: the mean of one to the left and one to the right is none. `cloning_loss` has such means, and fits
    the actor's own deviation too: late in a training, when that is a tenth, its gradient is a hundred times as large as
    early, and it widens the exploration.
    """
    width = network.reach * network.reach.new_tensor(LABEL_WIDTH)
    apart = (pairs["action"] - network.deterministic(pairs["observation"])[:, None]) / width
    return -(pairs["weight"].log() - apart.square().sum(-1) / 2).logsumexp(1).mean()


def mirrored_pairs(pairs: TensorDictBase) -> TensorDict:
    """The pairs [M] in a mirror: what is right there is what is right here, with left and right exchanged."""
    action = pairs["action"] * pairs["action"].new_tensor([1.0, -1.0])
    found = {"observation": mirrored(pairs["observation"]), "action": action, "weight": pairs["weight"]}
    return TensorDict(found, batch_size=pairs.batch_size)


def drawn(experts: Sequence[TensorDictBase], count: int) -> TensorDict:
    """`count` pairs, drawn evenly from each kind of experts (none empty), however many pairs it has.

    Labels are filled up to the most candidates C of any kind, with actions of weight 0.
    """
    kinds, most, parts = len(experts), max(each["action"].shape[1] for each in experts), []
    for kind, each in enumerate(experts):
        share = count * (kind + 1) // kinds - count * kind // kinds
        part = each[torch.randint(len(each), (share,), device=each.device)]
        action, weight = part["action"], part["weight"]
        missing = most - action.shape[1]
        action = torch.cat([action, action[:, :1].expand(-1, missing, -1)], 1)
        weight = torch.nn.functional.pad(weight, (0, missing))
        parts.append({"observation": part["observation"], "action": action, "weight": weight})
    joined = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    return TensorDict(joined, batch_size=[count])
