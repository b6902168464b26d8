"""TorchRL's own learners train the actor on the project's environment, as the example shows."""

import importlib.util
from pathlib import Path

import pytest
import torch

import e2rl
from e2rl.planners.network import read_actor

EXAMPLE = Path(__file__).parents[2] / "examples" / "torchrl_learners.py"


@pytest.fixture(scope="module")
def example():
    """The example, whose environment is made once."""
    spec = importlib.util.spec_from_file_location("torchrl_learners", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    env = module.attacked()
    module.attacked = lambda: env
    return module


@pytest.mark.parametrize("learner", ["ppo", "sac"])
def test_a_learner_trains_the_actor_and_writes_it(example, learner, tmp_path, capsys):
    example.main(learner, "320", str(tmp_path / "actor.safetensors"))
    assert "ego.checkpoint=" in capsys.readouterr().out
    torch.manual_seed(0)
    begun, trained = e2rl.make_ego("actor").network.weights(), read_actor(tmp_path / "actor.safetensors").weights()
    assert all(value.isfinite().all() for value in trained.values())
    last = "network.trunk.last.weight"
    assert not torch.equal(begun[last], trained[last]), "it is zero at the start"


def test_half_of_the_traffic_is_attacked(example):
    pool = example.attacked().transform[0].pool
    assert pool.adversarial.sum() * 2 == len(pool) == 2 * example.SCENES
