"""The step as a compiled graph: captured whole, and the same as the eager one."""

import pytest
import torch

from e2rl.sim import env
from e2rl.sim.env import DrivingEnv, SimSettings
from tests.synthetic import make_scenes


def outcomes(settings, steps=12):
    torch.manual_seed(0)
    environment = DrivingEnv(make_scenes(3, num_vehicles=9, red_light_x=60.0), settings, 3)
    return environment.rollout(steps, break_when_any_done=False)


@pytest.mark.slow
@pytest.mark.parametrize("replays", [False, True])
def test_a_compiled_step_is_the_eager_one(replays, monkeypatch):
    """By dynamo and autograd without C++, which would take a minute; benchmarks/simulator.py compares the whole."""
    monkeypatch.setattr(env, "compiled", lambda step: torch.compile(step, fullgraph=True, backend="aot_eager"))
    eager, other = (outcomes(SimSettings(replay_ego=replays, compile=on)) for on in (False, True))
    for key in eager.keys(True, True):
        assert torch.allclose(eager[key].float(), other[key].float(), atol=1e-5), key
