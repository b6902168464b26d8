"""The examples do what they say, beside the methods of the package, by the commands
that a user would run."""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import e2rl
from e2rl.scenes.recording import DT
from e2rl.traffic.potentials import SAMPLED_STEPS, PotentialSettings
from tests.scripts import SHORT
from tests.traffic.test_potentials import situation

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"


def run(script, folder, *overrides):
    """A script of the top level with the examples' configuration and modules, from an
    empty folder."""
    command = [
        sys.executable,
        str(ROOT / script),
        "--config-dir",
        str(EXAMPLES / "conf"),
        f"hydra.run.dir={folder}",
    ]
    path = os.pathsep.join([str(EXAMPLES), str(ROOT)])
    process = subprocess.run(
        [*command, *overrides],
        cwd=folder.parent,
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert process.returncode == 0, process.stderr
    return process.stdout


@pytest.mark.slow
def test_adversary_ego_source_and_metric_share_a_table_with_e2(tmp_path):
    run(
        "evaluate.py",
        tmp_path / "run",
        "data=csv_tracks",
        f"data.path={EXAMPLES / 'logs'}",
        "ego=cruise",
        "methods=[replay,braking_leader,e2]",
        "experiment=hard_braking",
        "seeds=[0]",
        "data.workers=1",
        "prior.sampler.steps=2",
    )
    rows = {
        row["method"]: row
        for row in json.loads((tmp_path / "run" / "metrics.json").read_text())
    }
    assert set(rows) == {"replay", "braking_leader", "e2"}
    assert rows["braking_leader"]["ego"] == "cruise"
    assert rows["braking_leader"]["eta"] == 2
    assert "hard_braking" in rows["e2"]["metrics"]
    with open(tmp_path / "run" / "rollouts.csv") as file:
        assert {row["hard_braking"] for row in csv.DictReader(file)} <= {
            "0.0",
            "1.0",
            "0",
            "1",
        }


@pytest.mark.slow
def test_somebody_else_s_optimiser_spends_the_tries(tmp_path):
    pytest.importorskip("cma")
    run(
        "evaluate.py",
        tmp_path / "run",
        *SHORT,
        "search=evolution",
        "methods=[search]",
        "budget=8",
        "budget_unit=tries",
        "seeds=[0]",
        "report=false",
        "save_rollouts=false",
    )
    with open(tmp_path / "run" / "tries.csv") as file:
        tries = list(csv.DictReader(file))
    assert len(tries) == 16
    assert len({row["family"] for row in tries}) > 4


@pytest.mark.slow
def test_the_curriculum_runs_a_round(tmp_path):
    out = run(
        "train.py",
        tmp_path / "run",
        *SHORT,
        "curriculum=staircase",
        "curriculum.stairs=[1.5]",
        "rounds=1",
        "learner.round.scenes=1",
        "learner.collect.batch=2",
        "learner.collect.iterations=1",
        "measure.scenes=1",
        "measure.seeds=[0]",
        "measure.budget=0",
    )
    assert "(eta 1.50)" in out


@pytest.fixture
def braking_leader(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    from my_stack.braking_leader import BrakingLeader
    from my_stack.csv_tracks import CsvTracks

    scenes = CsvTracks(path=str(EXAMPLES / "logs"), workers=1).load()
    return scenes, BrakingLeader(None, reach=40.0, braking=1.0)


def test_the_leader_brakes_by_eta_on_its_path_and_nobody_else_does(braking_leader):
    scenes, traffic = braking_leader
    out = e2rl.roll_out(scenes, e2rl.make_ego("idm"), traffic=traffic, eta=2.0)
    logged = scenes.scenes["logged"]
    braked = out.adversaries.nonzero()
    assert len(braked) == 2, "one in each log"
    for scene, agent in braked.tolist():
        speed = out.states[scene, :, agent, 3]
        moving = speed[1:] > 0
        assert torch.allclose(
            (speed.diff() / DT)[moving], torch.tensor(-2.0), atol=0.02
        )
        assert speed[-1] == 0
        xy = out.states[scene, :, agent, :2]
        path = logged[scene, :, agent, :2]
        assert torch.cdist(xy, path).amin(1).max() < 0.8, (
            "on its path, between recorded points"
        )
    others = out.valid & ~out.adversaries[:, None]
    others[:, :, 0] = False
    assert torch.equal(out.states[others], logged[others])
    calm = e2rl.roll_out(scenes, e2rl.make_ego("idm"), traffic=traffic, eta=0.0)
    assert not calm.adversaries.any()


def test_the_objective_is_least_in_front_of_the_target(monkeypatch):
    """The gradient moves the adversary alone, and vanishes where it wants to be."""
    monkeypatch.syspath_prepend(EXAMPLES)
    from my_stack.cut_in_front import CutInFront

    objective = CutInFront(**vars(PotentialSettings()), ahead=6.0)
    values = []
    for x in (6.0, 10.0, 20.0):
        states, context = situation((x, 0.0, 0.0, 10.0), targets=[(1, 0)])
        sampled = states[:, :, SAMPLED_STEPS].clone().requires_grad_()
        value = objective.adversarial(sampled, context, 0.5)
        (gradient,) = torch.autograd.grad(value.sum(), sampled)
        assert gradient[0, 0].abs().sum() == 0
        assert value[0, 0] == 0
        values.append(value[0, 1].item())
    assert values == pytest.approx([0.0, 2.0, 7.0], abs=2e-3)  # in units of 2 m


@pytest.mark.slow
def test_an_objective_of_one_s_own_steers_e2_elsewhere(tmp_path):
    """The same coalition and noise, and other paths of its members."""
    run(
        "evaluate.py",
        tmp_path / "run",
        *SHORT,
        "methods=[e2,cut_in_front]",
        "seeds=[0]",
        "processes=1",
        "report=false",
    )
    with open(tmp_path / "run" / "rollouts.csv") as file:
        rows = list(csv.DictReader(file))
    assert {row["method"] for row in rows} == {"e2", "cut_in_front"}
    assert {row["errored"] for row in rows} <= {
        "0",
        "0.0",
    }
    by_method = [
        [row["transport"] for row in rows if row["method"] == name]
        for name in ("e2", "cut_in_front")
    ]
    assert by_method[0] != by_method[1]
