"""Bad input through train.py and evaluate.py: one line names what is wrong and how to
mend it, nothing half-written.

The scripts run in this process, which spares seconds of imports each.
"""

import pytest

from e2rl.evaluation.rollout_files import read_metrics
from e2rl.run.files import CsvReader
from tests.scripts import arguments, call, error_line, left_behind


@pytest.mark.parametrize(
    ("script", "data", "options", "what"),
    [
        ("evaluate.py", "nowhere", [], "nowhere: no such file or folder"),
        ("evaluate.py", "empty", [], "holds no .pkl"),
        (
            "evaluate.py",
            "forbidden",
            [],
            "sd_01.pkl: cannot be read: names the forbidden class posix.system",
        ),
        ("evaluate.py", "damaged", [], "sd_01.pkl: cannot be read"),
        ("train.py", "nan", [], "sd_01.pkl: track 7 is NaN or infinite at frame 40"),
        (
            "evaluate.py",
            "good",
            ["prior.checkpoint=IN/none.safetensors"],
            "none.safetensors: no such file",
        ),
        (
            "train.py",
            "good",
            ["prior.checkpoint=IN/format.safetensors"],
            "format.safetensors: of format e2rl-prior/9",
        ),
        (
            "evaluate.py",
            "good",
            ["prior.checkpoint=IN/other.safetensors"],
            "other.safetensors: another architecture",
        ),
        (
            "evaluate.py",
            "good",
            ["prior.checkpoint=IN/cut.safetensors"],
            "cut.safetensors: not a readable",
        ),
        # of each kind of impossible setting one
        ("evaluate.py", "good", ["data.pth=x"], "data.pth: there is no such option"),
        ("evaluate.py", "good", ["eta"], "eta"),
        ("train.py", "good", ["stage=sleep"], "stage=sleep: there is no such option"),
        (
            "evaluate.py",
            "good",
            ["data._target_=torch.nn.ReLU"],
            "data=torch.nn.ReLU: is no",
        ),
        ("evaluate.py", "good", ["ego._target_=no.such.Driver"], "ego=no.such.Driver"),
        ("evaluate.py", "good", ["+synthesizer.control.depth=3"], "depth"),
        ("evaluate.py", "good", ["+sim.gravity=3"], "gravity"),
        ("evaluate.py", "good", ["device=tpu9"], "device=tpu9"),
        ("evaluate.py", "good", ["plugins=[no.such]"], "plugins: no.such: "),
        ("evaluate.py", "good", ["scene=9"], "scene=9"),
        (
            "evaluate.py",
            "good",
            ["+variants.x={synthesizer.support: best}"],
            "synthesizer.support=best: choose one of",
        ),
        ("evaluate.py", "good", ["batch=0"], "batch=0"),
        ("train.py", "good", ["rounds=abc"], "rounds=abc"),
        ("train.py", "good", ["resume=nowhere"], "resume=nowhere"),
        (
            "train.py",
            "good",
            ["stage=imitation", "ego.evades=true"],
            "stage=imitation ego.evades=true: recordings do not say",
        ),
        (
            "train.py",
            "good",
            ["sim.max_braking=-1"],
            "sim.max_braking=-1.0: expected a number of at least 0.1",
        ),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing_but_scenes(
    world, tmp_path, monkeypatch, capsys, script, data, options, what
):
    overrides = arguments(
        world,
        tmp_path,
        data,
        *(option.replace("=IN/", f"={world}/") for option in options),
    )
    if script == "evaluate.py" and "synthesizer" not in str(options):
        overrides.append("methods=[nominal]")  # those of the search take long to build
    status, said = call(script, overrides, monkeypatch=monkeypatch, capsys=capsys)
    assert status == 2
    assert what in error_line(said)
    assert all(
        path.startswith("cache/scenes-") and data == "good"
        for path in left_behind(tmp_path)
    )
    assert not (world / "ran").exists()


ROUND = [
    *(
        "data.build.steps=20",
        "prior.sampler.steps=2",
        "rounds=1",
        "batch=2",
    ),
    *(
        "learner.collect.batch=2",
        "learner.collect.steps=20",
        "learner.collect.iterations=1",
    ),
    *(
        "learner.round.scenes=4",
        "measure.scenes=2",
        "measure.seeds=[0]",
        "measure.budget=100",
    ),
]


@pytest.mark.slow
def test_rounds_of_evolution_from_the_first_command_to_tables_and_a_resume(
    world, tmp_path, monkeypatch, capsys
):
    run = tmp_path / "run"
    status, said = call(
        "train.py",
        arguments(world, tmp_path, "good", *ROUND),
        monkeypatch=monkeypatch,
        capsys=capsys,
    )
    assert status == 0, said
    rows = read_metrics(run / "metrics.json")
    assert {(row["stage"], row["method"], row["eta"]) for row in rows} == {
        (stage, *row)
        for stage in ("before", "after")
        for row in (("nominal", 0), ("e2", 2))
    }
    tables = (run / "tables.md").read_text()
    assert "cfr [%]" in tables
    assert "cfr [points]" in tables
    assert "after" in tables
    tries = [
        len((run / stage / "search" / "tries.csv").read_text().splitlines())
        for stage in ("before", "after")
    ]
    assert min(tries) > 2, "a header, and a try of each scene at least"
    again = [
        f"resume={run}",
        "rounds=2",
        f"data.cache={tmp_path / 'cache'}",
        f"hydra.run.dir={tmp_path / 'again'}",
    ]
    status, said = call("train.py", again, monkeypatch=monkeypatch, capsys=capsys)
    assert status == 0, said
    with open(run / "curriculum.csv", newline="") as file:
        choices = list(CsvReader(file))
    for number in ("0", "1"):
        draws = [int(row["draws"]) for row in choices if row["round"] == number]
        assert sum(draws) == 4
    assert len(list((run / "checkpoints").iterdir())) == 2
