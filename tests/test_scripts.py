"""Bad input through train.py and evaluate.py: one line names what is wrong and how to mend it, nothing half-written.

Most cases run the scripts in this process, which spares seconds of imports each; one of each script is a real process.
"""

import json
import os
import pickle
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra.core.global_hydra import GlobalHydra
from PIL import Image
from safetensors import safe_open
from safetensors.torch import save_file

from e2rl.build import load_choice
from e2rl.evaluation.files import read_metrics
from e2rl.learning.logging import read_choices
from e2rl.metrics.catalogue import META_STAGE, OPEN_LOOP_STAGE, STAGES
from e2rl.prior.checkpoint import save_prior
from e2rl.prior.denoiser import DenoiserSettings
from e2rl.prior.prior import Prior
from e2rl.traffic.template import TEMPLATES
from tests.scene.descriptions import Malicious, description, lane, numbered, straight, write_folder

ROOT = Path(__file__).parents[1]
SMALL = ["data.build.field_cells=64", "data.build.vehicles=4", "data.build.others=2", "data.workers=1"]


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """Folders of good and bad scenes, checkpoints of several kinds."""
    root = tmp_path_factory.mktemp("input")
    good = numbered([description({"ego": straight(20 + k, 0, 8), "7": straight(50, 3.5, 6)}) for k in range(2)])
    nan = description()
    nan["tracks"]["7"]["state"]["position"][40] = np.nan
    bad = {
        "forbidden": pickle.dumps({"x": Malicious(os.system, f"touch {root / 'ran'}")}),
        "no_ego": description(sdc_id="nobody"),
        "no_lanes": description(lanes={"b": lane([[0, 0]])}),
        "nan": nan,
        "damaged": b"nonsense",
    }
    write_folder(root / "good", good)
    for name, scene in bad.items():
        write_folder(root / name, [good[0], scene])
    (root / "empty").mkdir()
    torch.manual_seed(0)
    path = save_prior(Prior(DenoiserSettings(width=16, heads=2, blocks=1, pair=8)), root, {"data": "made"})
    path.rename(root / "prior.safetensors")
    _variants(root)
    return root


def _variants(root: Path) -> None:
    """Checkpoints that are none: of another architecture, another format, cut off, not safetensors."""
    with safe_open(root / "prior.safetensors", "pt") as file:
        metadata, tensors = file.metadata(), {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    save_file(tensors, root / "plain.safetensors")
    save_file(dict(list(tensors.items())[1:]), root / "other.safetensors", metadata)
    save_file(tensors, root / "unknown.safetensors", metadata | {"architecture": '{"denoiser": {"depth": 3}}'})
    save_file(tensors, root / "format.safetensors", metadata | {"format": "e2rl-prior/9"})
    content = (root / "prior.safetensors").read_bytes()
    (root / "cut.safetensors").write_bytes(content[: len(content) // 2])
    (root / "text.safetensors").write_text("no checkpoint")


def arguments(world: Path, folder: Path, data: str, *more: str) -> list[str]:
    """Overrides for scenes `data` with everything that is written below `folder`."""
    return [
        "data=scenarionet",
        f"data.path={world / data}",
        f"data.cache={folder / 'cache'}",
        *SMALL,
        f"prior.checkpoint={world / 'prior.safetensors'}",
        f"hydra.run.dir={folder / 'run'}",
        *more,
    ]


def left_behind(folder: Path) -> list[str]:
    """Files below a folder other than Hydra's record of the configuration and the log."""
    return [
        str(path.relative_to(folder))
        for path in folder.rglob("*")
        if path.is_file() and ".hydra" not in path.parts and path.suffix != ".log"
    ]


def call(script: str, overrides: list[str], monkeypatch, capsys) -> tuple[int, str]:
    """Exit status and what stderr says of a script run in this process, progress bars apart."""
    monkeypatch.setattr(sys, "argv", [str(ROOT / script), *overrides])
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    threads = torch.get_num_threads()
    try:
        runpy.run_path(str(ROOT / script), run_name="__main__")
        status = 0
    except SystemExit as stop:
        status = stop.code
    finally:
        GlobalHydra.instance().clear()
        torch.set_num_threads(threads)
    said = capsys.readouterr()
    assert "Traceback" not in said.err + said.out
    return status, said.err


def error_line(said: str) -> str:
    """The one line that begins with error:."""
    lines = [line for line in said.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1, said
    return lines[0]


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
    assert status == 1 and what in said and not left_behind(tmp_path)  # Hydra's own message


@pytest.mark.parametrize(
    ("script", "overrides", "what"),
    [
        ("train.py", ["stage=sleep"], "stage=sleep: choose one of"),
        ("evaluate.py", ["num_scenes=0"], "num_scenes=0"),
        ("evaluate.py", ["data._target_=e2rl.scene.bundled.BundledSource", "data.split=best"], "split 'best'"),
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
        ("evaluate.py", ["eta=abc"], "eta=abc"),
        ("evaluate.py", ["num_scenes=0"], "num_scenes=0"),
        ("evaluate.py", ["batch=0"], "batch=0"),
        ("evaluate.py", ["batch=a"], "batch=a: expected a whole number of at least 1"),
        ("evaluate.py", ["threads=abc"], "threads=abc: expected a whole number"),
        ("evaluate.py", ["seeds=3"], "seeds=3: expected a list of whole numbers"),
        ("evaluate.py", ["methods=e2"], "methods=e2: expected a list"),
        ("evaluate.py", ["sim.max_braking=-1"], "sim.max_braking=-1.0: expected a number of at least 0.1"),
        ("evaluate.py", ["data.build.vehicles=1"], "data.build.vehicles=1: expected a number of at least 2"),
        ("train.py", ["rounds=abc"], "rounds=abc: expected a whole number of at least 1"),
        ("train.py", ["rounds=0"], "rounds=0: expected a whole number of at least 1"),
        ("train.py", ["measure.seeds=3"], "measure.seeds=3: expected a list"),
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
    assert error_line(done.stderr) == "error: device=cuda: no CUDA device is available; use device=cpu"
    assert not left_behind(tmp_path)


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


SHORT = [
    "data.split=tune",
    "num_scenes=2",
    "data.workers=1",
    "data.build.steps=20",
    "data.build.vehicles=8",
    "data.build.others=2",
    "data.build.field_cells=128",
    "prior.sampler.steps=2",
]  # of the bundled scenes
EXPERIMENTS = [
    ("table2", [("random_k", 2), ("topology", 2), ("e2", 2), ("e2_unbound", 2), ("nominal", 0)], None),
    (
        "table3",
        [
            ("e2", 2),
            ("e2_unbound", 2),
            ("nominal", 0),
            ("told the plan", 2),
            ("duty behind only", 2),
            ("no duty", 2),
            ("no patience", 2),
            ("with V_adv", 2),
            ("no V_feas", 2),
            ("no anchoring", 2),
            ("literal anchoring", 2),
            ("no interception", 2),
            ("no proposal", 2),
            ("no bounds", 2),
            ("no bounds, no V_feas", 2),
        ],
        None,
    ),
    ("intensity", [("e2", 0), ("e2", 1), ("e2", 2), ("e2", 3)], "intensity.png"),
    ("skeleton", [("e2", 2)], "skeleton.png"),
]


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


@pytest.mark.parametrize(("experiment", "methods", "figure"), EXPERIMENTS)
def test_the_adversaries_experiments_have_their_rows_and_figures(
    world, tmp_path, monkeypatch, capsys, experiment, methods, figure
):
    """Two of the bundled scenes with the bundled prior; the paper's tables 2 and 3 and its figures."""
    overrides = [
        f"experiment={experiment}",
        *SHORT,
        f"data.cache={world / 'bundled'}",
        "seeds=[0]",
        f"hydra.run.dir={tmp_path / 'run'}",
    ]
    status, said = call("evaluate.py", overrides, monkeypatch, capsys)
    assert status == 0, said
    rows = read_metrics(tmp_path / "run" / "metrics.json")
    assert [(row["method"], row["eta"]) for row in rows] == methods
    assert all((row["n_scenes"], row["n_rollouts"]) == (2, 2) for row in rows)
    assert all(len(row["paired"]) == len(methods) - 1 for row in rows)
    for row in rows:
        known = row["metrics"]["real_adv"]["n"]
        assert known > 0 if row["eta"] else known == 0
    assert len(list((tmp_path / "run" / "rollouts").glob("*.npz"))) == 2 * len(methods)
    assert [path.name for path in (tmp_path / "run").glob("*.png")] == ([figure] if figure else [])


def test_table_1_is_written_in_three_formats(world, tmp_path, monkeypatch, capsys):
    overrides = [
        "experiment=table1",
        *SHORT,
        "methods=[e2,nominal,ctg_adv,cat]",
        f"data.cache={world / 'bundled'}",
        "seeds=[0]",
        f"hydra.run.dir={tmp_path / 'run'}",
    ]
    status, said = call("evaluate.py", overrides, monkeypatch, capsys)
    assert status == 0, said
    head, *rows = (tmp_path / "run" / "methods.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows] == ["e2 η=2", "nominal", "ctg_adv η=2", "cat η=2"]
    assert head.startswith("method,knowledge,duty,cfr [%]") and head.endswith("passes")
    assert "Difference of each method to e2" in (tmp_path / "run" / "methods.md").read_text()
    assert "Difference of each method to e2" in (tmp_path / "run" / "methods.tex").read_text()
    assert len((tmp_path / "run" / "methods_differences.csv").read_text().splitlines()) == 4


def test_egos_before_and_after_are_rated_in_one_run(world, tmp_path, monkeypatch, capsys):
    """An untrained actor and a planner in its place, with learning curves of a made run."""
    logs = tmp_path / "trained" / "logs" / "scalars"
    for name, value in (("train/frames", "100"), ("synthesizer/contact", "0.5")):
        (logs / name).parent.mkdir(parents=True)
        (logs / f"{name}.csv").write_text(f"0,{value}\n")
    roles = f"{{before: before, after: after, planner: before, runs: ['{tmp_path / 'trained'}']}}"
    overrides = [
        *SHORT,
        f"data.cache={world / 'bundled'}",
        "seeds=[0]",
        "+egos.before={ego: actor}",
        "+egos.after={ego: lane_graph}",
        f"policy_learning={roles}",
        f"hydra.run.dir={tmp_path / 'run'}",
    ]
    status, said = call("evaluate.py", overrides, monkeypatch, capsys)
    assert status == 0, said
    rows = read_metrics(tmp_path / "run" / "metrics.json")
    assert [(row["ego"], row["method"]) for row in rows] == [
        (ego, method) for ego in ("before", "after") for method in ("nominal", "e2")
    ]
    assert {key for row in rows[2:] for key in row["paired"]} == {"e2", "nominal", "ego before"}
    text = (tmp_path / "run" / "tables.md").read_text()
    assert "## Policy learning" in text and "after − before [points]" in text and "Guards of after" in text
    assert {path.name for path in (tmp_path / "run").glob("*.png")} == {"policy_learning.png", "curves.png"}


def test_a_planner_is_tuned_and_the_study_goes_on(world, tmp_path, monkeypatch, capsys):
    for trials in (1, 2):
        overrides = [
            "experiment=tune_planner",
            "ego=sampling",
            *SHORT,
            f"data.cache={world / 'bundled'}",
            f"tuning.trials={trials}",
            f"tuning.study={tmp_path / 'study'}",
            f"hydra.run.dir={tmp_path / 'run'}",
        ]
        status, said = call("evaluate.py", overrides, monkeypatch, capsys)
        assert status == 0, said
    result = json.loads((tmp_path / "run" / "tuning.json").read_text())
    assert len(result["trials"]) == 2 and set(result["best"]) <= set(load_choice("ego", "sampling"))
    assert {"collision nominal@0", "collision e2@2"} <= set(result["trials"][0]["metrics"])
    assert "margin: " in (tmp_path / "run" / "tuned.yaml").read_text()
    overrides += ["tuning.spaces.sampling.margin=[2,3]", "tuning.study=null"]
    status, said = call("evaluate.py", overrides, monkeypatch, capsys)
    assert status == 2 and "tuning.space.margin=[2, 3]: leaves out the present value" in error_line(said)
    overrides = [each for each in overrides if "margin" not in each and not each.startswith("ego=")]
    status, said = call("evaluate.py", [*overrides, "ego=idm"], monkeypatch, capsys)
    assert status == 2 and "tuning.spaces: no ranges for this ego" in error_line(said)


def test_a_folder_of_somebody_else_adds_methods_to_the_table(world, tmp_path, monkeypatch, capsys):
    (tmp_path / "conf" / "synthesizer").mkdir(parents=True)
    text = "_target_: e2rl.traffic.constant_velocity.ConstantVelocity\nname: straight\n"
    (tmp_path / "conf" / "synthesizer" / "straight.yaml").write_text(text)
    overrides = [
        f"--config-dir={tmp_path / 'conf'}",
        *arguments(world, tmp_path, "good", "data.build.steps=20", "methods=[replay,straight]", "seeds=[0]"),
    ]
    status, said = call("evaluate.py", overrides, monkeypatch, capsys)
    assert status == 0, said
    rows = read_metrics(tmp_path / "run" / "metrics.json")
    assert [(row["method"], row["eta"]) for row in rows] == [("replay", 0), ("straight", 0)]


def test_one_scene_is_driven_as_among_all(world, tmp_path, monkeypatch, capsys):
    found = []
    for which in ("scene=null", "scene=1"):
        folder = tmp_path / which
        status, said = call(
            "evaluate.py",
            [
                *SHORT,
                f"data.cache={world / 'bundled'}",
                "seeds=[1]",
                "methods=[e2]",
                which,
                "batch=1",
                f"hydra.run.dir='{folder}'",
            ],
            monkeypatch,
            capsys,
        )
        assert status == 0, said
        found.append({path.name: path.read_bytes() for path in (folder / "rollouts").glob("*.npz")})
    assert len(found[0]) == 2 and len(found[1]) == 1 and found[1].items() <= found[0].items()


def test_the_prior_s_experiment_has_rows_of_all_stages(world, tmp_path, monkeypatch, capsys):
    """Open loop, closed loop and meta-metric of three procedural scenes with an untrained prior."""
    overrides = [
        "experiment=prior",
        "data=procedural",
        "data.count=3",
        f"data.cache={tmp_path / 'cache'}",
        "data.workers=1",
        "data.build.vehicles=8",
        "data.build.field_cells=128",
        "seeds=[0]",
        "open_loop_samples=2",
        "meta_rollouts=2",
        "prior.sampler.steps=2",
        f"hydra.run.dir={tmp_path / 'run'}",
        f"prior.checkpoint={world / 'prior.safetensors'}",
    ]
    status, said = call("evaluate.py", overrides, monkeypatch, capsys)
    assert status == 0, said
    rows = read_metrics(tmp_path / "run" / "metrics.json")
    found = {stage: [row for row in rows if row.get("stage") == stage] for stage in (*STAGES, None)}
    assert sum(map(len, found.values())) == len(rows)
    methods = ["replay", "constant_velocity", "idm", "nominal"]
    assert {stage: [row["method"] for row in part] for stage, part in found.items()} == {
        OPEN_LOOP_STAGE: methods[1:],
        META_STAGE: methods,
        None: methods,
    }
    for stage, metrics in STAGES.items():
        known = [metric.name for metric in metrics if metric.name != "real_split_half"]
        assert all(set(known) <= set(row["metrics"]) for row in found[stage])
        assert all(row["metrics"][known[0]]["mean"] > 0 and row["n_scenes"] == 3 for row in found[stage])
    meta = {row["method"]: row["metrics"]["meta_metric"]["mean"] for row in found[META_STAGE]}
    assert max(meta, key=meta.get) == "replay" and "real_split_half" in found[META_STAGE][0]["metrics"]
    assert found[None][0]["metrics"]["real"]["mean"] == 1, "the replayed log is wholly like itself"
    text = (tmp_path / "run" / "tables.md").read_text()
    assert all(word in text for word in ("min_ade_5", "meta_metric", "cfr_bg", "nominal", "constant_velocity"))
    assert len(list((tmp_path / "run" / "rollouts").glob("*.npz"))) == 3 * len(methods)
