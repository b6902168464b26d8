"""The learned ego's network: every agent means the same wherever it stands in the observation."""

import pytest
import torch

from e2rl.planners.actor import ActorEgo
from e2rl.planners.reference import AGENTS, Trunk
from e2rl.run.errors import InputError
from e2rl.sim.observation import NEAREST, OBSERVATION_SIZE, PER_AGENT


def test_the_order_of_the_agents_changes_nothing_and_each_of_them_counts():
    torch.manual_seed(0)
    trunk, seen = Trunk((32, 16), 8, 2, last_gain=1.0), torch.randn(5, OBSERVATION_SIZE)
    agents = seen[:, AGENTS].unflatten(1, (NEAREST, PER_AGENT))
    shuffled, out = seen.clone(), trunk(seen)
    shuffled[:, AGENTS] = agents[:, torch.randperm(NEAREST)].flatten(1)
    assert out.shape == (5, 2) and torch.allclose(trunk(shuffled), out, atol=1e-6)
    for slot in range(NEAREST):
        moved = seen.clone()
        moved[:, AGENTS.start + slot * PER_AGENT : AGENTS.start + (slot + 1) * PER_AGENT] += 3.0
        assert (trunk(moved) - out).abs().amax() > 1e-3


def test_the_rest_of_the_scene_counts_and_a_last_layer_of_zeros_says_nothing():
    torch.manual_seed(0)
    seen = torch.randn(OBSERVATION_SIZE, requires_grad=True)
    (gradient,) = torch.autograd.grad(Trunk((32,), 8, 1, last_gain=1.0)(seen).sum(), seen)
    assert (gradient[: AGENTS.start] != 0).all() and (gradient[AGENTS.stop :] != 0).all()
    assert torch.equal(Trunk((32, 16), 8, 2, last_gain=0.0)(seen), torch.zeros(2))


@pytest.mark.parametrize(
    ("change", "what"), [({"hidden": ()}, "one layer at least"), ({"agent_units": 0}, "at least 1")]
)
def test_a_network_without_layers_is_refused(change, what):
    with pytest.raises(InputError, match=what):
        ActorEgo(**change)
