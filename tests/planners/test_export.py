"""An exported actor drives as the actor does."""

import pytest
import torch
from e2rl.scripts.export_policy import export_actor, main

from e2rl.planners.actor import ActorEgo
from e2rl.planners.ego import EgoPolicy
from e2rl.planners.network import read_actor
from e2rl.planners.policy_file import PolicyFileEgo
from e2rl.run.errors import InputError
from e2rl.sim.env import DrivingEnv, SimSettings
from e2rl.sim.observation import OBSERVATION_SIZE
from tests.planners.test_actor import wild
from tests.planners.test_policy_file import needs_onnx
from tests.synthetic import make_scenes

STEPS = 30


def drive(ego, **options):
    """States [STEPS, 3, 4] of the egos of three scenes with others around."""
    env = DrivingEnv(make_scenes(3, num_vehicles=6, red_light_x=60.0), SimSettings(), 3, agents=True, **options)
    env.reset()
    td = env.reset(env.reset().select("scene_index").set("scene_index", torch.arange(3)[:, None]))
    policy, states = EgoPolicy(ego, env), []
    for _ in range(STEPS):
        td = env.step(policy(td))["next"].exclude("reward")
        states.append(env.world().states[:, 0].clone())
    return torch.stack(states)


@pytest.fixture(scope="module")
def actor():
    """With an opinion, and statistics of observations of its own."""
    torch.manual_seed(1)
    ego = wild(ActorEgo(hidden=(16, 8)), 0.1)
    ego.network.normaliser.observe(torch.randn(50, OBSERVATION_SIZE))
    return ego


@pytest.mark.parametrize("name", ["policy.pt", pytest.param("policy.onnx", marks=needs_onnx)])
def test_the_same_rollouts(actor, tmp_path, name):
    actor.network.save(tmp_path / "actor.safetensors")
    export_actor(str(tmp_path), tmp_path / name)
    ego = PolicyFileEgo(str(tmp_path / name))
    observation = 2 * torch.randn(200, OBSERVATION_SIZE)
    expected = actor.act(None, observation, None)
    assert torch.allclose(ego.decide(observation), expected, atol=1e-5) and expected.std(0).min() > 0.05
    driven, own = drive(ego), drive(actor)
    assert torch.allclose(driven, own, atol=1e-3) and (own[-1, :, 0] - own[0, :, 0]).min() > 5


def test_an_actor_s_file_tells_its_architecture(actor, tmp_path):
    actor.network.save(tmp_path / "actor.safetensors")
    read = read_actor(tmp_path / "actor.safetensors")
    assert read.architecture == actor.network.architecture
    for key, value in actor.network.weights().items():
        assert torch.equal(read.weights()[key], value), key


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"observation": 12}, "of another version .of 12 numbers"),
        ({"hidden": [10**9]}, "another version"),
        ({"hidden": []}, "another version"),
        ({"agent_units": 0}, "another version"),
        ({"low": [1]}, "another"),
    ],
)
def test_an_actor_of_another_version_is_refused(actor, tmp_path, monkeypatch, change, what):
    monkeypatch.setattr(actor.network, "architecture", actor.network.architecture | change)
    actor.network.save(tmp_path / "actor.safetensors")
    with pytest.raises(InputError, match=what):
        read_actor(tmp_path / "actor.safetensors")


def test_the_command_says_how_to_drive_and_refuses_other_kinds(actor, tmp_path, capsys):
    actor.network.save(tmp_path / "actor.safetensors")
    main([str(tmp_path), str(tmp_path / "out" / "p.pt")])
    assert f"ego=policy_file ego.file={tmp_path / 'out' / 'p.pt'}" in capsys.readouterr().out
    for given, what in (([str(tmp_path), "p.h5"], "name it .onnx"), ([str(tmp_path / "no"), "p.pt"], "no actor there")):
        with pytest.raises(SystemExit):
            main(given)
        assert what in capsys.readouterr().err
