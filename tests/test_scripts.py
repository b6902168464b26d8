"""Bad input through train.py and evaluate.py: one line names what is wrong and how to mend it, nothing half-written.

Most cases run the scripts in this process, which spares seconds of imports each; one of each script is a real process.
"""

import subprocess
import sys

import pytest
import torch
from PIL import Image

from e2rl.evaluation.rollout_files import read_metrics
from e2rl.report.curriculum_figure import read_choices
from e2rl.traffic.traffic import TEMPLATES
from tests.scripts import ROOT, arguments, call, error_line, left_behind

DATA = [
    ("nowhere", "nowhere: no such file or folder", "pass one that holds"),
    ("empty", "holds no .pkl", "convert the logs"),
    ("forbidden", "sd_01.pkl: cannot be read: names the forbidden class posix.system", "data.skip_invalid=true"),
    ("damaged", "sd_01.pkl: cannot be read", "data.skip_invalid=true"),
    ("no_ego", "sd_01.pkl: no ego", "leave it out"),
    ("no_lanes", "sd_01.pkl: scene 'fork': no lanes", "leave the scene"),
    ("nan", "sd_01.pkl: track 7 is NaN or infinite at frame 40", "data.skip_invalid=true"),
]
CHECKPOINTS = [
    ("none", "none.safetensors: no such file", "train one"),
    ("plain", "plain.safetensors: format None", "prior"),
    ("format", "format.safetensors: format 'e2rl-prior/9'", "expected"),
    ("other", "other.safetensors: another architecture", "train the prior again"),
    ("unknown", "unknown.safetensors: ", "train the prior again"),
    ("cut", "cut.safetensors: not a readable", "train the prior again"),
    ("text", "text.safetensors: not a readable", "train the prior again"),
]


@pytest.mark.parametrize(
    ("script", "data", "what", "remedy"), [*(("evaluate.py", *case) for case in DATA), ("train.py", *DATA[2])]
)
def test_bad_scenes(world, tmp_path, monkeypatch, capsys, script, data, what, remedy):
    status, said = call(script, arguments(world, tmp_path, data), monkeypatch, capsys)
    assert status == 2 and what in error_line(said) and remedy in error_line(said)
    assert not left_behind(tmp_path) and not (world / "ran").exists()


@pytest.mark.parametrize(
    ("script", "name", "what", "remedy"),
    [*(("evaluate.py", *case) for case in CHECKPOINTS), ("train.py", *CHECKPOINTS[3])],
)
def test_bad_checkpoints(world, tmp_path, monkeypatch, capsys, script, name, what, remedy):
    overrides = arguments(world, tmp_path, "good", f"prior.checkpoint={world / name}.safetensors")
    status, said = call(script, overrides, monkeypatch, capsys)
    assert status == 2 and what in error_line(said) and remedy in error_line(said)
    assert not left_behind(tmp_path), "a wrong path shows before scenes are built"


@pytest.mark.parametrize(
    ("script", "override", "what"),
    [
        ("evaluate.py", "data.pth=x", "pth"),
        ("train.py", "round=3", "round"),
        ("evaluate.py", "ego=taxi", "taxi"),
        ("train.py", "prior.sampler.step=3", "step"),
        ("train.py", "synthesizer=e3", "e3"),
        ("evaluate.py", "eta", "eta"),
    ],
)
def test_unknown_keys_and_choices(world, tmp_path, monkeypatch, capsys, script, override, what):
    status, said = call(script, [*arguments(world, tmp_path, "good"), override], monkeypatch, capsys)
    assert status == 2 and what in said and not left_behind(tmp_path)


@pytest.mark.parametrize(
    ("script", "overrides", "what"),
    [
        ("train.py", ["stage=sleep"], "stage=sleep: there is no such option"),
        ("evaluate.py", ["data._target_=e2rl.scenes.bundled.BundledSource", "data.split=best"], "split 'best'"),
        ("evaluate.py", ["data._target_=no.such.Source"], "data=no.such.Source: cannot be built: "),
        ("evaluate.py", ["data._target_=torch.nn.ReLU"], "data=torch.nn.ReLU: is no"),
        ("evaluate.py", ["+prior.sampler.speed=3"], "speed"),
        ("evaluate.py", ["+data.build.depth=3"], "depth"),
        ("evaluate.py", ["+synthesizer.control.depth=3"], "depth"),
        ("evaluate.py", ["+sim.gravity=3"], "gravity"),
        ("evaluate.py", ["ego._target_=torch.nn.ReLU"], "ego=torch.nn.ReLU"),
        ("evaluate.py", ["ego._target_=no.such.Driver"], "ego=no.such.Driver"),
        ("evaluate.py", ["seeds=[]"], "seeds"),
        ("evaluate.py", ["methods=[e3]"], "e3"),
        ("evaluate.py", ["device=tpu9"], "device=tpu9"),
        ("train.py", ["resume=nowhere"], "resume=nowhere"),
        ("evaluate.py", ["scene=9"], "scene=9"),
        ("evaluate.py", ["scene=nowhere"], "scene=nowhere"),
        ("evaluate.py", ["figure=pie"], "figure=pie"),
        ("evaluate.py", ["+variants.x={synthesizer.control.depth: 3}"], "depth"),
        ("evaluate.py", ["+variants.x={synthesizer.support: best}"], "synthesizer.support=best: choose one of"),
        ("evaluate.py", ["eta=-1"], "eta"),
        ("evaluate.py", ["eta=abc"], "abc"),
        ("evaluate.py", ["batch=0"], "batch=0"),
        ("evaluate.py", ["batch=a"], "batch=a: expected a whole number of at least 1"),
        ("evaluate.py", ["sim.max_braking=-1"], "sim.max_braking=-1.0: expected a number of at least 0.1"),
        ("evaluate.py", ["data.build.vehicles=1"], "data.build.vehicles=1: expected a number of at least 2"),
        ("train.py", ["rounds=abc"], "rounds=abc: expected a whole number of at least 1"),
        ("train.py", ["sim.max_braking=-1"], "sim.max_braking=-1.0"),
        ("train.py", ["stage=imitation", "num_scenes=1"], "of one scene none can be held out"),
        ("evaluate.py", ["plugins=[no.such]"], "plugins: no.such: "),
        ("train.py", ["curriculum._target_=torch.nn.ReLU"], "curriculum=torch.nn.ReLU: cannot be built: "),
        ("train.py", ["+learner.depth=3"], "depth"),
        ("train.py", ["curriculum=bandit", "synthesizer=idm"], "synthesizer=idm has none; set synthesizer=e2"),
        ("train.py", ["curriculum=bandit", "curriculum.templates=[trio]"], "curriculum.templates=trio: choose one of"),
        ("evaluate.py", ["ego=actor", "ego.checkpoint=none.safetensors"], "none.safetensors"),
    ],
)
def test_impossible_settings(world, tmp_path, monkeypatch, capsys, script, overrides, what):
    status, said = call(script, arguments(world, tmp_path, "good", *overrides), monkeypatch, capsys)
    assert status == 2 and what in error_line(said)
    assert all(path.startswith("cache/scenes-") for path in left_behind(tmp_path))


@pytest.mark.slow
@pytest.mark.skipif(torch.cuda.is_available(), reason="has CUDA")
@pytest.mark.parametrize("script", ["evaluate.py", "train.py"])
def test_a_device_that_is_not_there(world, tmp_path, script):
    done = subprocess.run(
        [sys.executable, str(ROOT / script), *arguments(world, tmp_path, "good", "device=cuda")],
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
    overrides = arguments(
        world,
        tmp_path,
        "nan",
        "data.skip_invalid=true",
        "synthesizer=nominal",
        "seeds=[0]",
        "save_rollouts=false",
        "prior.sampler.steps=2",
    )
    status, said = call("evaluate.py", overrides, monkeypatch, capsys)
    assert status == 0 and "left out sd_01.pkl: sd_01.pkl: track 7 is NaN" in said
    assert "left out: 1 scenes (invalid)" in " ".join((tmp_path / "run" / "tables.md").read_text().split())
    assert not list(tmp_path.rglob("*.npz"))


TINY_ROUND = [
    *("data.build.steps=20", "prior.sampler.steps=2", "rounds=1", "batch=2"),
    *("learner.collect.batch=2", "learner.collect.steps=20", "learner.collect.iterations=1"),
]


def test_a_round_of_evolution_from_the_first_command_to_its_tables(world, tmp_path, monkeypatch, capsys):
    overrides = arguments(
        world, tmp_path, "good", *TINY_ROUND, "learner.round.scenes=2", "measure.scenes=2", "measure.seeds=[0]"
    )
    status, said = call("train.py", overrides, monkeypatch, capsys)
    assert status == 0, said
    rows = read_metrics(tmp_path / "run" / "metrics.json")
    assert {(row["stage"], row["method"], row["eta"]) for row in rows} == {
        (stage, *row) for stage in ("before", "after") for row in (("nominal", 0), ("e2", 1), ("e2", 2))
    }
    tables = (tmp_path / "run" / "tables.md").read_text()
    assert "cfr [%]" in tables and "cfr [points]" in tables and "after" in tables
    assert list((tmp_path / "run" / "checkpoints").iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("curriculum", ["bandit", "constant"])
def test_every_choice_of_a_curriculum_is_logged_and_drawn(world, tmp_path, monkeypatch, capsys, curriculum):
    """Also those of rounds after a resume."""
    overrides = arguments(
        world,
        tmp_path,
        "good",
        *TINY_ROUND,
        f"curriculum={curriculum}",
        "learner.round.scenes=4",
        "measure.scenes=1",
        "measure.seeds=[0]",
        "measure.eta=1",
    )
    run = tmp_path / "run"
    status, said = call("train.py", overrides, monkeypatch, capsys)
    assert status == 0, said
    again = [f"resume={run}", "rounds=2", f"hydra.run.dir={tmp_path / 'again'}"]
    status, said = call("train.py", again, monkeypatch, capsys)
    assert status == 0, said
    rows = read_choices(run / "curriculum.csv")
    arms = 24 if curriculum == "bandit" else 1
    assert [row["round"] for row in rows] == [0] * arms + [1] * arms
    assert [sum(row["draws"] for row in rows if row["round"] == number) for number in (0, 1)] == [4, 4]
    if curriculum == "constant":
        assert all((row["eta"], row["template"]) == (2.0, "full") for row in rows)
    else:
        assert {row["template"] for row in rows} == set(TEMPLATES) and all(row["value"] > 0 for row in rows)
    with Image.open(run / "curriculum.png") as picture:
        assert picture.width > picture.height
