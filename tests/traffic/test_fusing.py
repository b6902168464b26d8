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
from e2rl.planners.sampling import SamplingEgo
from e2rl.prior.free_space import decode_plans
from e2rl.prior.lane_relative import SIZE, LaneState
from e2rl.run import fused
from e2rl.run.errors import InputError
from e2rl.run.fused import FUSED, Fused, has_compiler, is_on, switch, switched_off
from e2rl.scenes.route import SPACING
from e2rl.sim.observation import OBSERVATION_SIZE
from e2rl.traffic.fusing import EARNED, fused_functions, prepare_fused
from tests.planners.planners import worlds
from tests.traffic.e2.traffic_scenes import drive, scenes, synthesizer


@pytest.fixture(autouse=True)
def restored():
    with switched_off():
        yield


def prepared(compile, device="cpu", rollouts=0):
    config = OmegaConf.create({"compile": compile, "device": device})
    prepare_fused(config, rollouts)
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


def traced(function, names):
    """Runs a fused function by its graph, and adds its name to those that ran. A guard
    would refuse sizes of 1, which compiled code takes."""
    graphs = []

    def run(flat):
        if function.name not in names:
            names.add(function.name)
            graphs.append(function.traced().module(check_guards=False))
        return list(graphs[0](*flat))

    return run


@pytest.fixture(scope="module")
def compared():
    """Eager rollouts, those of the graphs that would be compiled, the names of the
    functions that ran as graphs, and a network that learned from one of them."""
    scene_set = scenes(steps=20)
    method = synthesizer()
    names = set()
    with pytest.MonkeyPatch.context() as patch, switched_off():
        eager = drive(scene_set, method, 2.0, ego=LaneGraphEgo())
        for function in fused_functions():
            patch.setitem(vars(function), "_run", traced(function, names))
        switch(True)
        graphs = drive(scene_set, method, 2.0, ego=LaneGraphEgo())
        actor = ActorEgo()
        drive(scenes(1, steps=5), method, 2.0, ego=actor)
        drive(scenes(1, steps=5), method, 2.0, ego=SamplingEgo())
        trunk = actor.network.network.trunk
        trunk(torch.zeros(2, OBSERVATION_SIZE)).sum().backward()
        yield eager, graphs, names, trunk


@pytest.mark.slow
def test_the_graphs_of_fused_functions_drive_as_they_do_to_millimetres(compared):
    eager, graphs, _, _ = compared
    assert torch.equal(eager.valid, graphs.valid)
    assert torch.equal(eager.adversaries, graphs.adversaries)
    assert (eager.states[..., :2] - graphs.states[..., :2]).abs().max() < 2e-3
    torch.testing.assert_close(
        eager.transport_adversary, graphs.transport_adversary, rtol=1e-3, atol=1e-3
    )


@pytest.mark.slow
def test_the_graph_of_a_plan_is_the_plan(compared):
    """In free space, which no rollout needs."""
    torch.manual_seed(0)
    points = SPACING * torch.arange(40.0)
    arguments = (
        torch.rand(1, 2, SIZE),
        LaneState(*torch.rand(10, 1, 2)),
        torch.stack([points, 0 * points], -1).expand(1, 2, -1, -1),
        torch.tensor([[True, False]]),
    )
    switch(True)
    values = vars(decode_plans(*arguments))
    expected = vars(decode_plans.function(*arguments))
    for name, value in values.items():
        torch.testing.assert_close(value, expected[name], rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_candidates_cost_in_graphs_what_they_cost(compared):
    """Costs are of contact, 200, down to metres beside the mission, 2 each."""
    _, world = worlds(scenes(2))
    ego = SamplingEgo()
    expected = ego.candidates(world)
    costs = ego.costs(world, expected)
    switch(True)
    candidates = ego.candidates(world)
    torch.testing.assert_close(candidates.states, expected.states, rtol=0, atol=1e-3)
    torch.testing.assert_close(ego.costs(world, expected), costs, rtol=0, atol=1e-2)


@pytest.mark.slow
def test_no_fused_function_is_left_out(compared):
    registered = {
        name for name in FUSED if name.startswith("e2rl.") and "<locals>" not in name
    }
    assert registered - compared[2] == set(), "they never ran as graphs"


@pytest.mark.slow
def test_a_fused_network_still_learns(compared):
    weights = list(compared[3].parameters())
    assert any(bool(weight.grad.any()) for weight in weights if weight.grad is not None)


def test_functions_that_are_not_compiled_are_left_off_unless_they_are_asked_for(
    monkeypatch, tmp_path, capsys
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for function in list(FUSED.values()):
        monkeypatch.delitem(function.__dict__, "file", raising=False)
    assert prepared("auto") is False
    assert not is_on()
    message = capsys.readouterr().err
    assert ("compile=true" in message) == has_compiler()
    assert not list(tmp_path.rglob("*.so"))
    assert prepared(False) is False
    assert prepared("auto", "cuda") is False
    assert not is_on()
    monkeypatch.setattr(Fused, "compile", lambda self: None)
    monkeypatch.setattr(fused.shutil, "which", lambda name: "/usr/bin/c++")
    assert prepared(True) is True
    assert is_on()
    switch(False)
    for function in fused_functions():
        monkeypatch.setitem(vars(function), "file", Path(__file__))
    assert prepared("auto") is True
    assert is_on(), "all are there now"


def test_a_long_run_compiles_first_where_it_can(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for function in fused_functions():
        monkeypatch.delitem(function.__dict__, "file", raising=False)
    monkeypatch.setattr(Fused, "compile", lambda self: None)
    monkeypatch.setattr(fused.shutil, "which", lambda name: None)
    assert prepared("auto", rollouts=EARNED) is False
    monkeypatch.setattr(fused.shutil, "which", lambda name: "/usr/bin/c++")
    assert prepared("auto", rollouts=EARNED - 1) is False
    assert prepared("auto", rollouts=EARNED) is True
    assert "compiled first" in capsys.readouterr().err
    assert prepared(False, rollouts=EARNED) is False


def test_other_values_of_compile_are_refused():
    with pytest.raises(
        InputError, match="compile=maybe: choose one of auto, true, false"
    ):
        prepared("maybe")
