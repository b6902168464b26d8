"""The cloning loss: one label is the hard loss, many are its mean; every kind of expert has its share."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import BCLoss

from e2rl.learning.cloning import LABEL_WIDTH, cloning_loss, drawn, mirrored_demonstrations, teaching_loss
from e2rl.planners.actor import ActorEgo
from e2rl.sim.observation import OBSERVATION_SIZE, mirrored


def network():
    torch.manual_seed(0)
    ego = ActorEgo(hidden=(16,))
    torch.nn.init.normal_(ego.network.network.trunk.last.weight, std=0.1)
    return ego.network


def shown(action, weight):
    """Demonstrations [5] at random observations with labels action [C, 2] and weight [C]."""
    action, weight = torch.tensor(action), torch.tensor(weight)
    observation = torch.randn(5, OBSERVATION_SIZE, generator=torch.Generator().manual_seed(1))
    labels = {"action": action.expand(5, -1, -1), "weight": weight.expand(5, -1)}
    return TensorDict({"observation": observation, **labels}, [5])


def gradient(actor, given):
    """The loss and its gradient by all parameters."""
    loss = cloning_loss(actor.actor, given)
    parts = torch.autograd.grad(loss, list(actor.network.parameters()))
    return loss.detach(), torch.cat([part.flatten() for part in parts])


def test_one_label_is_the_hard_loss():
    actor, given = network(), shown([[-3.0, 0.2]], [1.0])
    hard = TensorDict({"observation": given["observation"], "action": given["action"][:, 0]}, [5])
    torch.testing.assert_close(cloning_loss(actor.actor, given), BCLoss(actor.actor)(hard)["loss_bc"])


def test_loss_and_gradient_are_the_weighted_means_of_those_of_the_labels():
    actor, actions, weights = network(), [[-3.0, 0.2], [1.0, -0.4], [2.0, 0.0]], [0.5, 0.3, 0.2]
    soft = gradient(actor, shown(actions, weights))
    single = [gradient(actor, shown([action], [1.0])) for action in actions]
    for found, of_each in zip(soft, zip(*single, strict=True), strict=True):
        expected = sum(weight * each for weight, each in zip(weights, of_each, strict=True))
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("count", [9, 10, 11])
def test_kinds_share_a_minibatch_evenly_whatever_their_sizes(count):
    few, many = shown([[-3.0, 0.2]], [1.0])[:1], shown([[1.0, 0.0], [2.0, 0.0]], [0.25, 0.75]).repeat(100)
    found = drawn([few, many], count)
    first = found["action"][:, 0, 0] == -3.0
    assert len(found) == count and abs(int(first.sum()) - count / 2) < 1
    assert torch.equal(found["weight"].sum(1), torch.ones(count))
    assert not found["weight"][first, 1].any(), "filled up"


def taught(actions, weights, acted):
    """The teaching loss of a policy that acts as `acted` [2] everywhere, and its gradient there."""
    policy, acted = network().network, torch.nn.Parameter(torch.tensor(acted))
    policy.deterministic = lambda observation: acted.expand(len(observation), 2)
    loss = teaching_loss(policy, shown(actions, weights))
    return loss.item(), torch.autograd.grad(loss, acted)[0]


def test_of_two_ways_out_one_is_taken_and_not_their_mean():
    left_and_right = [[0.0, 1.2], [0.0, -1.2]]
    between, _ = taught(left_and_right, [0.5, 0.5], [0.0, 0.0])
    for way in (1.2, -1.2):
        loss, gradient = taught(left_and_right, [0.5, 0.5], [0.0, way])
        assert loss < between - 5 and gradient.abs().max() < 1e-3
    _, gradient = taught(left_and_right, [0.5, 0.5], [0.0, 0.3])
    assert gradient[1] < 0, "to the nearer one: a step down the gradient turns further left"


def test_what_speaks_for_a_label_counts():
    left_and_right = [[0.0, 1.2], [0.0, -1.2]]
    _, gradient = taught(left_and_right, [0.99, 0.01], [0.0, -0.05])
    assert gradient[1] < 0, "towards the likely one, though the other is nearer"
    assert taught([[-3.0, 0.2]], [1.0], [-3.0, 0.2])[0] == pytest.approx(0.0, abs=1e-6)


def test_teaching_leaves_the_explorations_width_alone():
    policy = network().network
    loss = teaching_loss(policy, shown([[-3.0, 0.2], [1.0, -0.4]], [1.0, 0.0]))  # a weight of 0 fills up
    assert torch.autograd.grad(loss, policy.spread, allow_unused=True, retain_graph=True) == (None,)
    assert all(part.isfinite().all() for part in torch.autograd.grad(loss, list(policy.trunk.parameters())))


def test_a_teaching_error_of_the_labels_width_costs_one_half_each():
    policy = network().network
    wide = policy.reach * torch.tensor(LABEL_WIDTH)
    policy.deterministic = lambda observation: torch.zeros(len(observation), 2)
    assert teaching_loss(policy, shown([wide.tolist()], [1.0])).item() == pytest.approx(1.0)


def test_what_is_right_in_a_scene_is_right_in_its_mirror():
    found = shown([[-3.0, 0.2], [1.0, -0.4]], [0.75, 0.25])
    other = mirrored_demonstrations(found)
    assert torch.equal(other["action"], found["action"] * torch.tensor([1.0, -1.0]))
    assert torch.equal(other["weight"], found["weight"])
    assert torch.equal(other["observation"], mirrored(found["observation"]))
