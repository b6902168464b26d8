"""The losses of cloning and of teaching, by their formulas."""

import torch
from tensordict import TensorDict
from torchrl.objectives import BCLoss

from e2rl.learning.pretraining.cloning import cloning_loss, teaching_loss
from e2rl.planners.actor import ActorEgo
from e2rl.sim.observation import OBSERVATION_SIZE


def network():
    torch.manual_seed(0)
    ego = ActorEgo(hidden=(16,), room=None)
    torch.nn.init.normal_(ego.network.network.trunk.last.weight, std=0.1)
    return ego.network


def shown(action, weight):
    """Labels [5] at random observations: action [C, 2] and weight [C]."""
    action = torch.tensor(action)
    weight = torch.tensor(weight)
    observation = torch.randn(
        5, OBSERVATION_SIZE, generator=torch.Generator().manual_seed(1)
    )
    labels = {"action": action.expand(5, -1, -1), "weight": weight.expand(5, -1)}
    return TensorDict({"observation": observation, **labels}, [5])


def test_the_cloning_loss_is_torchrl_s():
    actor = network()
    labels = shown([[-3.0, 0.2]], [1.0])
    hard = TensorDict(
        {"observation": labels["observation"], "action": labels["action"][:, 0]}, [5]
    )
    expected = BCLoss(actor.actor)(hard)["loss_bc"]
    torch.testing.assert_close(cloning_loss(actor.actor, hard), expected)


def test_the_teaching_loss_is_that_of_a_mixture_round_the_labels():
    """Each counts by its weight and by its distance in units of the labels' width."""
    policy = network().network
    weights = [0.7, 0.3]
    inputs = shown([[-3.0, 0.2], [1.0, -0.4]], weights)
    away = inputs["action"] - policy.deterministic(inputs["observation"])[:, None]
    away = away / (policy.reach * torch.tensor([0.25, 0.12]))
    likelihood = (torch.tensor(weights) * torch.exp(-away.square().sum(-1) / 2)).sum(1)
    torch.testing.assert_close(teaching_loss(policy, inputs), -likelihood.log().mean())


def test_teaching_leaves_the_explorations_width_alone():
    policy = network().network
    inputs = shown([[-3.0, 0.2], [1.0, -0.4]], [1.0, 0.0])  # a weight of 0 fills up
    loss = teaching_loss(policy, inputs)
    assert torch.autograd.grad(
        loss, policy.spread, allow_unused=True, retain_graph=True
    ) == (None,)
    assert all(
        part.isfinite().all()
        for part in torch.autograd.grad(loss, list(policy.trunk.parameters()))
    )
