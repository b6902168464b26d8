"""Rollouts with kernels are those without, to millimetres, and `compile` says which are driven."""

import pytest
import torch
from omegaconf import OmegaConf

from e2rl.evaluation.methods import build_ego
from e2rl.run import kernels
from e2rl.run.config import load_config
from e2rl.run.errors import InputError
from e2rl.run.kernels import KERNELS, Kernel, has_compiler, is_on, switched_off
from e2rl.traffic.compiled import prepare_kernels
from tests.traffic.e2.traffic_scenes import drive, scenes, synthesizer


@pytest.fixture(autouse=True)
def restored():
    with switched_off():
        yield


def prepared(compile, device="cpu"):
    config = OmegaConf.create({"compile": compile, "device": device})
    prepare_kernels(config)
    return config.compile


@pytest.mark.slow
@pytest.mark.skipif(not has_compiler(), reason="needs a C++ compiler")
def test_compiled_rollouts_are_the_eager_ones_to_millimetres(capsys):
    scene_set, on, called, ego = scenes(steps=40), synthesizer(), set(), build_ego(load_config())
    eager = drive(scene_set, on, 2.0, ego=ego)
    assert prepared(True) and is_on()
    for each in KERNELS.values():
        run = each._run
        each.__dict__["_run"] = lambda flat, run=run, name=each.name: called.add(name) or run(flat)
    fast = drive(scene_set, on, 2.0, ego=ego)
    assert torch.equal(eager.valid, fast.valid) and torch.equal(eager.adversaries, fast.adversaries)
    assert (eager.states[..., :2] - fast.states[..., :2]).abs().max() < 2e-3
    torch.testing.assert_close(eager.transport_adversary, fast.transport_adversary, rtol=1e-3, atol=1e-3)
    missing = {name for name in KERNELS if name.startswith("e2rl.") and "<locals>" not in name} - called
    assert not missing, "they never ran compiled"
    again = prepared("auto")
    assert again is True and is_on(), "all are there now"
    capsys.readouterr()


def test_kernels_that_are_not_compiled_are_left_off_unless_they_are_asked_for(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for each in list(KERNELS.values()):
        monkeypatch.delitem(each.__dict__, "file", raising=False)
    assert prepared("auto") is False and not is_on()
    told = capsys.readouterr().err
    assert ("compile=true" in told) == has_compiler() and not list(tmp_path.rglob("*.so"))
    assert prepared(False) is False and prepared("auto", "cuda") is False and not is_on()
    monkeypatch.setattr(Kernel, "compile", lambda self: None)
    monkeypatch.setattr(kernels.shutil, "which", lambda name: "/usr/bin/c++")
    assert prepared(True) is True and is_on()
    with pytest.raises(InputError, match="compile=maybe: choose one of auto, true, false"):
        prepared("maybe")
