"""A compiled step, and the graph of the observation, are the eager ones."""

import pytest
import torch

from e2rl.run import fused
from e2rl.run.fused import has_compiler, switched_off
from e2rl.sim.env import DrivingEnv
from e2rl.sim.observation import features
from e2rl.sim.settings import SimSettings
from e2rl.sim.step import drive
from tests.synthetic import make_scenes
from tests.traffic.test_fusing import traced


def outcomes(
    batch,
    vehicles,
    hold,
    compiled,
):
    """Of a few episodes of egos that steer at random, and reset where they end."""
    environment = DrivingEnv(
        make_scenes(
            3,
            num_vehicles=vehicles,
            red_light_x=60.0,
        ),
        SimSettings(),
        batch,
        hold=hold,
    )
    torch.manual_seed(0), environment.set_seed(0)
    with switched_off():
        fused.switch(compiled)
        return environment.rollout(30, break_when_any_done=False)


@pytest.fixture(scope="module")
def features_graph():
    """The observation's graph, which fits every size."""
    return traced(features, set())


@pytest.mark.slow
@pytest.mark.skipif(not has_compiler(), reason="needs a C++ compiler")
@pytest.mark.parametrize(
    ("batch", "vehicles", "hold"), [(1, 2, 1), (3, 9, 2), (5, 20, 1)]
)
def test_a_compiled_step_is_the_eager_one(
    batch,
    vehicles,
    hold,
    features_graph,
    monkeypatch,
):
    called = set()
    for function, run in ((drive, drive._run), (features, features_graph)):

        def counted(flat, name=function.name, run=run):
            called.add(name)
            return run(flat)

        monkeypatch.setitem(vars(function), "_run", counted)
    eager, other = (
        outcomes(
            batch,
            vehicles,
            hold=hold,
            compiled=compiled,
        )
        for compiled in (False, True)
    )
    assert called == {features.name, drive.name}, "they never ran compiled"
    for key in eager.keys(True, True):
        assert torch.allclose(
            eager[key].float(),
            other[key].float(),
            rtol=1e-6,
            atol=1e-5,
        ), key
