"""Bad input through train.py and evaluate.py: one line names what is wrong and how to mend it, nothing half-written.

Most cases run the scripts in this process, which spares seconds of imports each; one of each script is a real process.
"""

import subprocess
import sys

import pytest
import torch

from e2rl.evaluation.rollout_files import read_metrics
from e2rl.report.curriculum_figure import read_choices
from e2rl.traffic.traffic import TEMPLATES
from tests.scripts import ROOT, arguments, call, error_line, left_behind

DATA = [
    ("nowhere", "nowhere: no such file or folder"),
    ("empty", "holds no .pkl"),
    ("forbidden", "sd_01.pkl: cannot be read: names the forbidden class posix.system"),
    ("damaged", "sd_01.pkl: cannot be read"),
    ("nan", "sd_01.pkl: track 7 is NaN or infinite at frame 40"),
]
CHECKPOINTS = [
    ("none", "none.safetensors: no such file"),
    ("format", "format.safetensors: format 'e2rl-prior/9'"),
    ("other", "other.safetensors: another architecture"),
    ("cut", "cut.safetensors: not a readable"),
]


@pytest.mark.parametrize(
    ("script", "data", "what"), [*(("evaluate.py", *case) for case in DATA), ("train.py", *DATA[2])]
)
def test_bad_scenes(world, tmp_path, monkeypatch, capsys, script, data, what):
    status, said = call(script, arguments(world, tmp_path, data), monkeypatch, capsys)
    assert status == 2 and what in error_line(said)
    assert not left_behind(tmp_path) and not (world / "ran").exists()


@pytest.mark.parametrize(
    ("script", "name", "what"), [*(("evaluate.py", *case) for case in CHECKPOINTS), ("train.py", *CHECKPOINTS[2])]
)
def test_bad_checkpoints(world, tmp_path, monkeypatch, capsys, script, name, what):
    overrides = arguments(world, tmp_path, "good", f"prior.checkpoint={world / name}.safetensors")
    status, said = call(script, overrides, monkeypatch, capsys)
    assert status == 2 and what in error_line(said)
    assert not left_behind(tmp_path), "a wrong path shows before scenes are built"


@pytest.mark.parametrize(
    ("script", "overrides", "what"),
    [
        # of each kind one
        ("evaluate.py", ["data.pth=x"], "data.pth: there is no such option"),
        ("evaluate.py", ["eta"], "eta"),
        ("train.py", ["stage=sleep"], "stage=sleep: there is no such option"),
        ("evaluate.py", ["data._target_=torch.nn.ReLU"], "data=torch.nn.ReLU: is no"),
        ("evaluate.py", ["ego._target_=no.such.Driver"], "ego=no.such.Driver"),
        ("evaluate.py", ["+synthesizer.control.depth=3"], "depth"),
        ("evaluate.py", ["+sim.gravity=3"], "gravity"),
        ("evaluate.py", ["device=tpu9"], "device=tpu9"),
        ("evaluate.py", ["plugins=[no.such]"], "plugins: no.such: "),
        ("evaluate.py", ["scene=9"], "scene=9"),
        ("evaluate.py", ["+variants.x={synthesizer.support: best}"], "synthesizer.support=best: choose one of"),
        ("evaluate.py", ["batch=0"], "batch=0"),
        ("train.py", ["rounds=abc"], "rounds=abc"),
        ("train.py", ["resume=nowhere"], "resume=nowhere"),
        ("train.py", ["sim.max_braking=-1"], "sim.max_braking=-1.0: expected a number of at least 0.1"),
        ("train.py", ["curriculum=bandit", "synthesizer=idm"], "synthesizer=idm has none; set synthesizer=e2"),
    ],
)
def test_impossible_settings(world, tmp_path, monkeypatch, capsys, script, overrides, what):
    status, said = call(script, arguments(world, tmp_path, "good", *overrides), monkeypatch, capsys)
    assert status == 2 and what in error_line(said)
    assert all(path.startswith("cache/scenes-") for path in left_behind(tmp_path))


@pytest.mark.slow
@pytest.mark.skipif(torch.cuda.is_available(), reason="has CUDA")
def test_a_device_that_is_not_there(world, tmp_path):
    done = subprocess.run(
        [sys.executable, str(ROOT / "train.py"), *arguments(world, tmp_path, "good", "device=cuda")],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=tmp_path,
    )
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "error: device=cuda: " in error_line(done.stderr) and "use device=cpu" in done.stderr
    assert not left_behind(tmp_path)


@pytest.mark.slow
def test_skipped_scenes_are_counted_in_the_table(world, tmp_path, monkeypatch, capsys):
    options = ["data.skip_invalid=true", "synthesizer=nominal", "seeds=[0]", "save_rollouts=false"]
    overrides = arguments(world, tmp_path, "nan", *options, "prior.sampler.steps=2")
    status, said = call("evaluate.py", overrides, monkeypatch, capsys)
    assert status == 0 and "left out sd_01.pkl: sd_01.pkl: track 7 is NaN" in said
    assert "left out: 1 scenes (invalid)" in " ".join((tmp_path / "run" / "tables.md").read_text().split())
    assert not list(tmp_path.rglob("*.npz"))


ROUND = [
    *("data.build.steps=20", "prior.sampler.steps=2", "rounds=1", "batch=2", "curriculum=bandit"),
    *("learner.collect.batch=2", "learner.collect.steps=20", "learner.collect.iterations=1"),
    *("learner.round.scenes=4", "measure.scenes=2", "measure.seeds=[0]"),
]


def test_rounds_of_evolution_from_the_first_command_to_tables_and_a_resume(world, tmp_path, monkeypatch, capsys):
    run = tmp_path / "run"
    status, said = call("train.py", arguments(world, tmp_path, "good", *ROUND), monkeypatch, capsys)
    assert status == 0, said
    rows = read_metrics(run / "metrics.json")
    assert {(row["stage"], row["method"], row["eta"]) for row in rows} == {
        (stage, *row) for stage in ("before", "after") for row in (("nominal", 0), ("e2", 1), ("e2", 2))
    }
    tables = (run / "tables.md").read_text()
    assert "cfr [%]" in tables and "cfr [points]" in tables and "after" in tables
    again = [f"resume={run}", "rounds=2", f"hydra.run.dir={tmp_path / 'again'}"]
    status, said = call("train.py", again, monkeypatch, capsys)
    assert status == 0, said
    rows = read_choices(run / "curriculum.csv")
    assert [row["round"] for row in rows] == [0] * 24 + [1] * 24, "an arm for each template and intensity"
    assert [sum(row["draws"] for row in rows if row["round"] == number) for number in (0, 1)] == [4, 4]
    assert {row["template"] for row in rows} == set(TEMPLATES) and all(row["value"] > 0 for row in rows)
    assert (run / "curriculum.png").exists() and len(list((run / "checkpoints").iterdir())) == 2
