"""The loss of cloning is TorchRL's."""

import torch
from tensordict import TensorDict
from torchrl.objectives import BCLoss

from e2rl.learning.pretraining.cloning import cloning_loss
from e2rl.planners.actor import ActorEgo
from e2rl.sim.observation import OBSERVATION_SIZE


def network():
    torch.manual_seed(0)
    ego = ActorEgo(hidden=(16,), room=None)
    torch.nn.init.normal_(ego.network.network.trunk.last.weight, std=0.1)
    return ego.network


def test_the_cloning_loss_is_torchrl_s():
    actor = network()
    observation = torch.randn(
        5, OBSERVATION_SIZE, generator=torch.Generator().manual_seed(1)
    )
    action = torch.tensor([-3.0, 0.2]).expand(5, 2)
    demonstrations = TensorDict({"observation": observation, "action": action}, [5])
    expected = BCLoss(actor.actor)(demonstrations)["loss_bc"]
    torch.testing.assert_close(cloning_loss(actor.actor, demonstrations), expected)
