"""Rollouts with fused functions are those without, to millimetres, and `compile` says
which are driven."""

import importlib
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

import e2rl
from e2rl.planners.actor import ActorEgo
from e2rl.planners.lane_graph_planner import LaneGraphEgo
from e2rl.prior.free_space import decode_plans
from e2rl.prior.lane_relative import SIZE, LaneState
from e2rl.run import fused
from e2rl.run.errors import InputError
from e2rl.run.fused import FUSED, Fused, has_compiler, is_on, switched_off
from e2rl.scenes.route import SPACING
from e2rl.sim.observation import OBSERVATION_SIZE
from e2rl.traffic.fusing import prepare_fused
from tests.traffic.e2.traffic_scenes import drive, scenes, synthesizer


@pytest.fixture(autouse=True)
def restored():
    with switched_off():
        yield


def prepared(compile, device="cpu"):
    config = OmegaConf.create({"compile": compile, "device": device})
    prepare_fused(config)
    return config.compile


def test_whatever_is_fused_is_prepared():
    """Else it would be compiled in the middle of a run."""
    root = Path(e2rl.__file__).parent
    for path in root.rglob("*.py"):
        if "@fused(" in path.read_text():
            parts = path.relative_to(root.parent).with_suffix("").parts
            importlib.import_module(".".join(parts))
    fused = {name for name in FUSED if name.startswith("e2rl.")}
    code = (
        "from e2rl.traffic.fusing import fused_functions; "
        "print(*(function.name for function in fused_functions()))"
    )
    command = [sys.executable, "-c", code]
    fresh = subprocess.run(command, capture_output=True, text=True, check=True)
    assert fused <= set(fresh.stdout.split())


@pytest.mark.slow
@pytest.mark.skipif(not has_compiler(), reason="needs a C++ compiler")
def test_compiled_rollouts_are_the_eager_ones_to_millimetres(capsys):
    scene_set = scenes(steps=40)
    on = synthesizer()
    called = set()
    ego = LaneGraphEgo()
    eager = drive(scene_set, on, 2.0, ego=ego)
    assert prepared(True)
    assert is_on()
    for each in FUSED.values():
        run = each._run
        each.__dict__["_run"] = lambda flat, run=run, name=each.name: (
            called.add(name) or run(flat)
        )
    fast = drive(scene_set, on, 2.0, ego=ego)
    torch.manual_seed(0)
    x = torch.rand(1, 2, SIZE)
    points = SPACING * torch.arange(40.0)
    moving = LaneState(*torch.rand(10, 1, 2))
    given = (
        x,
        moving,
        torch.stack([points, 0 * points], -1).expand(1, 2, -1, -1),
        torch.tensor([[True, False]]),
    )
    for one, other in zip(
        *(
            vars(decode(*given)).values()
            for decode in (decode_plans, decode_plans.function)
        ),
        strict=True,
    ):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)
    actor = ActorEgo()
    drive(scene_set, on, 2.0, ego=actor)
    actor.network.network.trunk(torch.zeros(2, OBSERVATION_SIZE)).sum().backward()
    assert torch.equal(eager.valid, fast.valid)
    assert torch.equal(eager.adversaries, fast.adversaries)
    assert (eager.states[..., :2] - fast.states[..., :2]).abs().max() < 2e-3
    torch.testing.assert_close(
        eager.transport_adversary, fast.transport_adversary, rtol=1e-3, atol=1e-3
    )
    missing = {
        name for name in FUSED if name.startswith("e2rl.") and "<locals>" not in name
    } - called
    assert not missing, "they never ran compiled"
    again = prepared("auto")
    assert again is True
    assert is_on(), "all are there now"
    capsys.readouterr()


def test_functions_that_are_not_compiled_are_left_off_unless_they_are_asked_for(
    monkeypatch, tmp_path, capsys
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for each in list(FUSED.values()):
        monkeypatch.delitem(each.__dict__, "file", raising=False)
    assert prepared("auto") is False
    assert not is_on()
    told = capsys.readouterr().err
    assert ("compile=true" in told) == has_compiler()
    assert not list(tmp_path.rglob("*.so"))
    assert prepared(False) is False
    assert prepared("auto", "cuda") is False
    assert not is_on()
    monkeypatch.setattr(Fused, "compile", lambda self: None)
    monkeypatch.setattr(fused.shutil, "which", lambda name: "/usr/bin/c++")
    assert prepared(True) is True
    assert is_on()
    with pytest.raises(
        InputError, match="compile=maybe: choose one of auto, true, false"
    ):
        prepared("maybe")
