"""The cloning loss: one label is the hard loss, many are its mean; every kind of expert
has its share."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import BCLoss

from e2rl.learning.cloning import CloningLoss, TeachingLoss, drawn
from e2rl.planners.actor import ActorEgo
from e2rl.sim.observation import OBSERVATION_SIZE


def network():
    torch.manual_seed(0)
    ego = ActorEgo(hidden=(16,), room=None)
    torch.nn.init.normal_(ego.network.network.trunk.last.weight, std=0.1)
    return ego.network


def shown(action, weight):
    """Demonstrations [5] at random observations with labels action [C, 2] and weight
    [C]."""
    action = torch.tensor(action)
    weight = torch.tensor(weight)
    observation = torch.randn(
        5, OBSERVATION_SIZE, generator=torch.Generator().manual_seed(1)
    )
    labels = {"action": action.expand(5, -1, -1), "weight": weight.expand(5, -1)}
    return TensorDict({"observation": observation, **labels}, [5])


def gradient(actor, given):
    """The loss and its gradient by all parameters."""
    loss = CloningLoss(actor.actor)(given)["loss_cloning"]
    parts = torch.autograd.grad(loss, list(actor.network.parameters()))
    return loss.detach(), torch.cat([part.flatten() for part in parts])


def test_one_label_is_the_hard_loss():
    actor = network()
    given = shown([[-3.0, 0.2]], [1.0])
    hard = TensorDict(
        {"observation": given["observation"], "action": given["action"][:, 0]}, [5]
    )
    soft = CloningLoss(actor.actor)(given)["loss_cloning"]
    torch.testing.assert_close(soft, BCLoss(actor.actor)(hard)["loss_bc"])


def test_loss_and_gradient_are_the_weighted_means_of_those_of_the_labels():
    actor = network()
    actions = [[-3.0, 0.2], [1.0, -0.4], [2.0, 0.0]]
    weights = [0.5, 0.3, 0.2]
    soft = gradient(actor, shown(actions, weights))
    single = [gradient(actor, shown([action], [1.0])) for action in actions]
    for found, of_each in zip(soft, zip(*single, strict=True), strict=True):
        expected = sum(
            weight * each for weight, each in zip(weights, of_each, strict=True)
        )
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("count", [9, 10, 11])
def test_kinds_share_a_minibatch_evenly_whatever_their_sizes(count):
    few = shown([[-3.0, 0.2]], [1.0])[:1]
    many = shown([[1.0, 0.0], [2.0, 0.0]], [0.25, 0.75]).repeat(100)
    found = drawn([few, many], count)
    first = found["action"][:, 0, 0] == -3.0
    assert len(found) == count and abs(int(first.sum()) - count / 2) < 1
    assert torch.equal(found["weight"].sum(1), torch.ones(count))
    assert not found["weight"][first, 1].any(), "filled up"


def test_the_teaching_loss_is_that_of_a_mixture_round_the_labels():
    """Each counts by its weight and by its distance in units of the labels' width."""
    policy = network().network
    weights = [0.7, 0.3]
    given = shown([[-3.0, 0.2], [1.0, -0.4]], weights)
    away = given["action"] - policy.deterministic(given["observation"])[:, None]
    away = away / (policy.reach * torch.tensor([0.25, 0.12]))
    likelihood = (torch.tensor(weights) * torch.exp(-away.square().sum(-1) / 2)).sum(1)
    torch.testing.assert_close(
        TeachingLoss(policy)(given)["loss_teaching"], -likelihood.log().mean()
    )


def test_teaching_leaves_the_explorations_width_alone():
    policy = network().network
    given = shown([[-3.0, 0.2], [1.0, -0.4]], [1.0, 0.0])  # a weight of 0 fills up
    loss = TeachingLoss(policy)(given)["loss_teaching"]
    assert torch.autograd.grad(
        loss, policy.spread, allow_unused=True, retain_graph=True
    ) == (None,)
    assert all(
        part.isfinite().all()
        for part in torch.autograd.grad(loss, list(policy.trunk.parameters()))
    )
