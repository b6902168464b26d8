"""A policy's file drives by what it returns, and is refused with one message where it
is no policy."""

import os

import pytest
import torch
from torch import nn

from e2rl.commands.export_policy import export_actor
from e2rl.planners.actor import ActorEgo
from e2rl.planners.ego_errors import NotFinite
from e2rl.planners.ego_policy import EgoPolicy
from e2rl.planners.policy_file import MAX_FILE, PolicyFileEgo
from e2rl.run.errors import InputError
from e2rl.sim.env import DrivingEnv
from e2rl.sim.observation import OBSERVATION_SIZE
from e2rl.sim.settings import SimSettings
from tests.planners.test_actor import wild
from tests.synthetic import make_scenes


class Acts(nn.Module):
    """A policy by a function of the observations."""

    def __init__(self, function):
        super().__init__()
        self.function = function

    def forward(self, observation):
        return self.function(observation)


def proportional(observation):
    """Accelerates towards 12 m/s, steers by nothing."""
    return torch.cat([12.0 - 15.0 * observation[:, :1], 0 * observation[:, :1]], 1)


def scripted(folder, function):
    torch.jit.save(
        torch.jit.trace(Acts(function), torch.zeros(2, OBSERVATION_SIZE)),
        folder / "policy.pt",
    )
    return str(folder / "policy.pt")


def test_it_drives_by_its_actions_within_the_bounds(tmp_path):
    env = DrivingEnv(make_scenes(2, speed=6.0), SimSettings(), 2, agents=True)
    ego = PolicyFileEgo(scripted(tmp_path, proportional))
    td = EgoPolicy(ego, env)(env.reset())
    assert torch.equal(td["action"], torch.tensor([[5.0, 0.0]] * 2)), (
        "6 m/s^2 are asked for"
    )
    assert td["ego", "plan"][:, 4, 3].tolist() == pytest.approx([8.5, 8.5])
    assert td["ego", "plan"][:, -1, 3].tolist() == pytest.approx([12, 12], abs=0.1), (
        "the plan is what it would do"
    )
    with pytest.raises(NotFinite):
        EgoPolicy(
            PolicyFileEgo(scripted(tmp_path, lambda seen: proportional(seen) / 0)), env
        )(env.reset())


@pytest.mark.parametrize(("rows", "numbers"), [(None, 3), (1, 2)])
def test_other_shapes_are_refused(tmp_path, rows, numbers):
    with pytest.raises(
        InputError,
        match=rf"fails at observations .*float32 \[1, {numbers}\]; it maps .*for every B",
    ):
        PolicyFileEgo(scripted(tmp_path, lambda seen: seen[:rows, :numbers]))


@pytest.mark.parametrize(
    ("name", "content", "what"),
    [
        ("policy.pt", None, "No such file"),
        ("policy.pt", b"nonsense", "no TorchScript archive"),
        ("policy.csv", b"nonsense", "no TorchScript archive"),
        ("policy.pt", os.mkfifo, "no regular file"),
        ("policy.pt", bytes(MAX_FILE + 1), "larger than"),
    ],
)
def test_what_is_no_policy_is_named(
    tmp_path,
    name,
    content,
    what,
):
    if callable(content):
        content(tmp_path / name)
    elif content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=f"ego.file=.*{name}: .*{what}"):
        PolicyFileEgo(str(tmp_path / name))


def drive(ego, **options):
    """States [30, 3, 4] of the egos of three scenes with others around."""
    env = DrivingEnv(
        make_scenes(
            3,
            num_vehicles=6,
            red_light_x=60.0,
        ),
        SimSettings(),
        3,
        agents=True,
        **options,
    )
    env.reset()
    td = env.reset(
        env.reset().select("scene_index").set("scene_index", torch.arange(3)[:, None])
    )
    policy = EgoPolicy(ego, env)
    states = []
    for _ in range(30):
        td = env.step(policy(td))["next"].exclude("reward")
        states.append(env.world().states[:, 0].clone())
    return torch.stack(states)


@pytest.fixture(scope="module")
def actor():
    """With an opinion, and statistics of observations of its own."""
    torch.manual_seed(1)
    ego = wild(
        ActorEgo(
            hidden=(16, 8),
            room=3.0,
        ),
        0.1,
    )
    ego.network.normaliser.observe(torch.randn(50, OBSERVATION_SIZE))
    return ego


def test_the_same_rollouts(actor, tmp_path):
    actor.network.save(tmp_path / "actor.safetensors")
    export_actor(str(tmp_path), tmp_path / "policy.pt")
    ego = PolicyFileEgo(str(tmp_path / "policy.pt"))
    observation = 2 * torch.randn(200, OBSERVATION_SIZE)
    expected = actor.act(None, observation, None)
    assert torch.allclose(ego.decide(observation), expected, atol=1e-5)
    assert expected.std(0).min() > 0.05
    driven = drive(ego)
    ours = drive(actor)
    assert torch.allclose(driven, ours, atol=1e-3)
    assert (ours[-1, :, 0] - ours[0, :, 0]).min() > 5
