"""What e2rl uses of TorchRL and torch without their promise is still there and still does what it did."""

import re
import tomllib
from pathlib import Path

import pytest
import torch
import torchrl
from tensordict import TensorDict
from torchrl.envs import Transform, TransformedEnv

from e2rl.sim.env import DrivingEnv, SimSettings
from e2rl.traffic.transform import AdversarialSynthesizer
from tests.synthetic import make_scenes

ROOT = Path(__file__).parents[1]
HOOKS = ("_reset_env_preprocess", "_reset", "_inv_call", "_step", "_post_step_mdp_hooks")
MEND = (
    "e2rl/traffic/transform.py injects scenes and traffic through it; mend it there, or keep torchrl to the versions "
    "that pyproject.toml names"
)


class Watched(Transform):
    """Notes which hooks are called."""

    def __init__(self):
        super().__init__()
        self.called = []


def noting(name):
    def hook(self, *given):
        self.called.append(name)
        return getattr(Transform, name)(self, *given)

    return hook


for hook_name in HOOKS:
    setattr(Watched, hook_name, noting(hook_name))


class Base(DrivingEnv):
    """Notes when it is reset and stepped."""

    def _reset(self, tensordict=None, **given):
        self.watched.called.append("env reset")
        return super()._reset(tensordict, **given)

    def _step(self, tensordict):
        self.watched.called.append("env step")
        return super()._step(tensordict)


def test_torchrl_calls_the_hooks_of_a_transform_in_their_order():
    where = f"TorchRL {torchrl.__version__}"
    for name in HOOKS:
        assert hasattr(Transform, name), f"{where} has no Transform.{name}: {MEND}"
        assert name in vars(AdversarialSynthesizer), f"{name} is not used any more; take it out of this list"
    env, watched = Base(make_scenes(2, steps=10), SimSettings(), 2), Watched()
    env.watched = watched
    env = TransformedEnv(env, watched)
    tensordict = env.reset()
    first = ["_reset_env_preprocess", "env reset", "_reset"]
    assert watched.called == first, f"{where} resets by {watched.called}, not {first}: {MEND}"
    watched.called.clear()
    tensordict["action"] = torch.zeros(2, 2)
    env.step_and_maybe_reset(tensordict)
    step = ["_inv_call", "env step", "_step", "_post_step_mdp_hooks"]
    assert watched.called == step, f"{where} steps by {watched.called}, not {step}: {MEND}"
    watched.called.clear()
    mask = TensorDict({"_reset": torch.tensor([[True], [False]])}, batch_size=[2])
    env.reset(mask)
    assert watched.called == first, f"{where} resets a part by {watched.called}, not {first}: {MEND}"


@pytest.mark.parametrize("name", ["_is_avx512_bf16_supported", "_is_amx_tile_supported"])
def test_torch_says_whether_the_processor_has_bf16(name):
    """e2rl/learning/prior_training/training.py asks it where stage.bf16 is null."""
    assert isinstance(getattr(torch.cpu, name)(), bool), f"torch {torch.__version__} has no torch.cpu.{name}"


def test_the_oldest_versions_that_are_tested_are_those_that_are_allowed():
    """tools/versions.sh tests what pyproject.toml promises."""
    allowed = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    low = {name: re.search(rf"{name}>=([\d.]+)", " ".join(allowed))[1] for name in ("torch", "torchrl", "tensordict")}
    oldest = re.search(r"oldest\) versions=\((.*?)\)", (ROOT / "tools" / "versions.sh").read_text())[1]
    for name, version in low.items():
        assert re.search(rf"\b{name}=={re.escape(version)}(\.0)?\b", oldest), f"{name}>={version}, tested: {oldest}"
