"""Learners of others train in the project's environment, as the examples show, and
their policies drive."""

import importlib.util
from pathlib import Path

import pandas
import pytest
import torch

import e2rl
from e2rl.planners.network import read_actor
from e2rl.sim.observation import OBSERVATION_SIZE

EXAMPLES = Path(__file__).parents[2] / "examples"


def example(name):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def settings():
    """Of the environment: few scenes, attacked as in the examples."""
    return {"scenes": e2rl.load_scenes("bundled", 3), "compile": False}


def test_torchrl_trains_the_actor(settings, tmp_path, capsys):
    example("torchrl_ppo").main("320", str(tmp_path / "actor.safetensors"), **settings)
    assert "ego.checkpoint=" in capsys.readouterr().out
    torch.manual_seed(0)
    beginning = e2rl.make_ego("actor").network.weights()
    trained = read_actor(tmp_path / "actor.safetensors").weights()
    assert all(value.isfinite().all() for value in trained.values())
    last = "network.trunk.last.weight"
    assert not torch.equal(beginning[last], trained[last]), "it is zero at the start"


@pytest.mark.parametrize("name", ["sb3_ppo", "torchrl_sac"])
def test_a_policy_of_theirs_is_an_ego(settings, tmp_path, capsys, name):
    """It is written with the log of its episodes, whose steps are at most those asked
    for."""
    file = tmp_path / "policy.pt"
    module = example(name)
    module.UPDATES = 1
    module.main("256", str(file), num_envs=8, **settings | {"method": "replay"})
    assert f"ego.file={file}" in capsys.readouterr().out
    action = e2rl.make_ego("policy_file", file=str(file)).decide(
        torch.randn(50, OBSERVATION_SIZE)
    )
    assert action.isfinite().all()
    assert action.std(0).min() > 1e-3
    log = pandas.read_csv(tmp_path / "policy.monitor.csv", comment="#")
    assert {"r", "l", "contact", "off_road", "progress"} <= set(log)
    assert 0 < log["l"].sum() <= 256
