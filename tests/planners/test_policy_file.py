"""A policy's file drives by what it returns, and is refused with one message where it is no policy."""

import math
from importlib.util import find_spec

import pytest
import torch
from torch import nn

from e2rl.commands.export_policy import export_actor
from e2rl.planners.actor import ActorEgo
from e2rl.planners.ego import EgoPolicy, NotFinite
from e2rl.planners.network import read_actor
from e2rl.planners.policy_file import PolicyFileEgo
from e2rl.run.errors import InputError
from e2rl.sim.env import DrivingEnv, SimSettings
from e2rl.sim.observation import OBSERVATION_SIZE
from tests.planners.test_actor import wild
from tests.synthetic import make_scenes

needs_onnx = pytest.mark.skipif(not (find_spec("onnxruntime") and find_spec("onnxscript")), reason="extra onnx")


class Proportional(nn.Module):
    """Accelerates towards 12 m/s, steers by nothing; `more` is added to both."""

    def __init__(self, more: float = 0.0) -> None:
        super().__init__()
        self.more = more

    def forward(self, observation):
        accel = 12.0 - 15.0 * observation[:, :1]
        return torch.cat([accel, torch.zeros_like(accel)], 1) + self.more


class Shaped(nn.Module):
    """Returns what is no action of a batch."""

    def __init__(self, rows: int | None, numbers: int) -> None:
        super().__init__()
        self.rows, self.numbers = rows, numbers

    def forward(self, observation):
        return observation[: self.rows, : self.numbers]


def scripted(folder, module):
    torch.jit.save(torch.jit.trace(module.eval(), torch.zeros(2, OBSERVATION_SIZE)), folder / "policy.pt")
    return str(folder / "policy.pt")


def test_it_drives_by_its_actions_within_the_bounds(tmp_path):
    env = DrivingEnv(make_scenes(2, speed=6.0), SimSettings(), 2, agents=True)
    ego = PolicyFileEgo(scripted(tmp_path, Proportional()))
    td = EgoPolicy(ego, env)(env.reset())
    assert torch.equal(td["action"], torch.tensor([[5.0, 0.0]] * 2)), "6 m/s^2 are asked for"
    assert td["ego", "plan"][:, 4, 3].tolist() == pytest.approx([8.5, 8.5])
    assert td["ego", "plan"][:, -1, 3].tolist() == pytest.approx([12, 12], abs=0.1), "the plan is what it would do"


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_rollout_in_which_it_returns_nan_ends(tmp_path, value):
    env = DrivingEnv(make_scenes(1), SimSettings(), 1, agents=True)
    ego = PolicyFileEgo(scripted(tmp_path, Proportional(value)))
    with pytest.raises(NotFinite):
        EgoPolicy(ego, env)(env.reset())


@pytest.mark.parametrize(
    ("rows", "numbers", "what"),
    [
        (None, 3, r"fails at observations \[1, 326\]: maps them to torch.float32 \[1, 3\]; it maps float32"),
        (1, 2, r"fails at observations \[3, 326\]: maps them to .* \[1, 2\]; .*for every B"),
    ],
)
def test_other_shapes_are_refused(tmp_path, rows, numbers, what):
    with pytest.raises(InputError, match=f"^ego.file=.*policy.pt: {what}"):
        PolicyFileEgo(scripted(tmp_path, Shaped(rows, numbers)))


@pytest.mark.parametrize(
    ("name", "content", "what"),
    [
        ("policy.pt", None, "no such file"),
        ("policy.pt", b"nonsense", "no TorchScript archive"),
        pytest.param("policy.onnx", b"nonsense", "cannot be read as ONNX", marks=needs_onnx),
    ],
)
def test_what_is_no_policy_is_named(tmp_path, name, content, what):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=what):
        PolicyFileEgo(name and str(tmp_path / name))


def drive(ego, **options):
    """States [30, 3, 4] of the egos of three scenes with others around."""
    env = DrivingEnv(make_scenes(3, num_vehicles=6, red_light_x=60.0), SimSettings(), 3, agents=True, **options)
    env.reset()
    td = env.reset(env.reset().select("scene_index").set("scene_index", torch.arange(3)[:, None]))
    policy, states = EgoPolicy(ego, env), []
    for _ in range(30):
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


@pytest.mark.parametrize(
    ("change", "what"),
    [({"observation": 12}, "of another version .of 12 numbers"), ({"hidden": [10**9]}, "another version")],
)
def test_an_actor_of_another_version_is_refused(actor, tmp_path, monkeypatch, change, what):
    monkeypatch.setattr(actor.network, "architecture", actor.network.architecture | change)
    actor.network.save(tmp_path / "actor.safetensors")
    with pytest.raises(InputError, match=what):
        read_actor(tmp_path / "actor.safetensors")
