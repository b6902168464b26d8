"""`e2rl try` drives a class of one's own by evaluate's protocol, and says what is wrong
with one that it cannot."""

import sys

import pytest

from e2rl.commands import try_planner
from e2rl.commands.try_planner import main
from e2rl.evaluation.rollout_files import read_rows

PLANNERS = """
from e2rl.planners.ego import Ego
from e2rl.planners.path import MissionPath

class Steady(Ego):
    def plan(self, world):
        return MissionPath(world).drive(world.states[:, 0, 3:].expand(-1, 51))

class Wide(Steady):
    def __init__(self, gap, replan_every=5):
        super().__init__(replan_every)

class Idle(Ego):
    pass

class Other:
    pass
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with a module of planners, in which the command starts."""
    name = f"planners_of_{tmp_path.name.replace('-', '_')}"
    (tmp_path / f"{name}.py").write_text(PLANNERS)
    (tmp_path / "broken.py").write_text("1 / 0")
    for taken in ("random.py", "sys.py"):
        (tmp_path / taken).write_text(PLANNERS)
    (tmp_path / "lacking.py").write_text("import no_such_library")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setenv("PYTHONPATH", "")
    monkeypatch.setattr(sys, "argv", ["e2rl try"])
    return tmp_path, name


@pytest.mark.parametrize(
    ("planner", "message"),
    [
        ("{name}:Stedy", "has no Stedy; it has Steady"),
        (
            "{name}:Other",
            "Other is no planner; make it a subclass of e2rl.planners.ego.Ego",
        ),
        ("{name}:Wide", "Wide needs gap; give defaults, or add --set gap=VALUE"),
        ("{name}", "name a class, as MODULE:CLASS or FILE.py:CLASS"),
        ("nowhere:Steady", "no module nowhere in"),
        ("nowhere.py:Steady", "no file nowhere.py"),
        (
            "broken:Steady",
            "broken cannot be imported: ZeroDivisionError: division by zero; mend that",
        ),
        ("lacking.py:Steady", "lacking needs no_such_library, which is not installed"),
        (
            "{name}:Ego",
            "Ego overrides neither plan nor act, so that it does not drive; name Steady, Wide",
        ),
        ("{name}:Idle", "Idle overrides neither plan nor act"),
        ("random.py:Steady", "rename random.py: a module random is loaded already"),
        ("random:Steady", "rename random.py: a module random is loaded already"),
        (
            "sys.py:Steady",
            "rename sys.py: a module sys is loaded already, a part of Python",
        ),
    ],
)
def test_a_planner_that_cannot_be_driven_is_one_line(folder, capsys, planner, message):
    with pytest.raises(SystemExit) as stopped:
        main(["--planner", planner.format(name=folder[1])])
    said = capsys.readouterr().err
    assert stopped.value.code == 2
    assert message in said
    assert said.strip().count("\n") == 0


def test_logs_that_nothing_reads_are_refused(folder, capsys):
    (folder[0] / "logs").mkdir()
    with pytest.raises(SystemExit) as stopped:
        main(["logs", "--planner", f"{folder[1]}:Steady"])
    assert stopped.value.code == 2
    assert "logs" in capsys.readouterr().err


@pytest.mark.parametrize("form", ["{name}:Steady", "{name}.py:Steady"])
def test_it_writes_a_command_line_of_evaluate(folder, monkeypatch, form):
    class Ran(Exception):
        pass

    def ran(name):
        assert name == "e2rl.scripts.evaluate"
        raise Ran

    planner = form.format(name=folder[1])
    real = try_planner.import_module
    monkeypatch.setattr(
        try_planner,
        "import_module",
        lambda name: ran(name) if "scripts" in name else real(name),
    )
    with pytest.raises(Ran):
        main(
            [
                "--planner",
                planner,
                "--scenes",
                "3",
                "eta=1.0",
                "--set",
                "replan_every=4",
                "--out",
                "a run",
            ]
        )
    assert sys.argv == [
        *(
            "e2rl evaluate",
            "ego=class",
            f"ego._target_={folder[1]}.Steady",
            "+ego.replan_every=4",
        ),
        *("num_scenes=3", "hydra.run.dir='a run'", "eta=1.0"),
    ]


@pytest.mark.slow
def test_it_drives_the_class_and_names_it(folder, capsys):
    small = [
        "data.split=tune",
        "tries=1",
        "seeds=[0]",
        "processes=1",
        "data.build.steps=20",
        "report=false",
    ]
    main(["--planner", f"{folder[1]}:Steady", "--scenes", "1", "--out", "run", *small])
    rows = read_rows(folder[0] / "run" / "rollouts.csv")
    assert {row["ego_policy"] for row in rows} == {"Steady"}
    assert {row["method"] for row in rows} == {"e2", "nominal"}
    assert capsys.readouterr().out.startswith(
        "Drives Steady in the first of bundled scenes against e2, nominal"
    )
