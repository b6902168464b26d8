"""`e2rl tune` on two short bundled scenes: what it writes, and a study that goes on in
another run."""

import json

import pytest

from e2rl.run.config import load_choice
from tests.scripts import SHORT, call, error_line


@pytest.fixture
def tune(tmp_path, monkeypatch, capsys):
    """Runs the command in a folder of its own; returns it, or if `wrong` the error."""
    runs = []

    def run(options, wrong=False):
        folder = tmp_path / f"run-{len(runs)}"
        runs.append(folder)
        study = [
            f"tuning.study={tmp_path / 's'}",
            "data.build.steps=10",
            "processes=1",
        ]
        inputs = [*SHORT, *study, f"hydra.run.dir={folder}", *options]
        status, said = call(
            "e2rl/commands/cli.py",
            ["tune", *inputs],
            monkeypatch=monkeypatch,
            capsys=capsys,
        )
        assert status == (2 if wrong else 0), said
        return error_line(said) if wrong else folder

    return run


def test_an_adversary_is_tuned_and_the_study_goes_on(tune):
    """Rollouts are those of the method's own YAML; another budget or method is another
    study."""
    e2 = ["synthesizer=e2", "tuning.sweep=2"]
    tune([*e2, "tuning.trials=1"])
    run = tune([*e2, "tuning.trials=3"])
    result = json.loads((run / "tuning.json").read_text())
    tried = [trial["parameters"]["interception.lateral"] for trial in result["trials"]]
    assert tried == pytest.approx(
        [load_choice("synthesizer", "e2").interception.lateral, 0.5, 4.0]
    )
    assert {"cfr", "aor_step", "aor_step nominal", "real_adv"} <= set(
        result["trials"][0]["metrics"]
    )
    assert "interception:\n  lateral: " in (run / "tuned.yaml").read_text()
    assert "differs in objective; name another file" in tune(
        [*e2, "tuning.attack.off_road=0.1"], wrong=True
    )


@pytest.mark.parametrize(
    ("options", "what"),
    [
        (["synthesizer=idm"], "synthesizer=idm: no adversary"),
        (["tuning.attack.seek=speed"], "tuning.attack.seek=speed: choose one of"),
        (["tuning.group=ego", "ego=idm"], "no ranges"),
    ],
)
def test_what_cannot_be_tuned_is_told(tune, options, what):
    assert what in tune(options, wrong=True)


def test_a_planner_is_tuned_in_the_traffic_of_all_methods(tune):
    run = tune(
        ["tuning.group=ego", "ego=sampling", "tuning.trials=2", "tuning.sweep=0"]
    )
    result = json.loads((run / "tuning.json").read_text())
    assert len(result["trials"]) == 2
    assert set(result["best"]) <= set(load_choice("ego", "sampling"))
    assert {"collision nominal@0", "collision e2@2"} <= set(
        result["trials"][0]["metrics"]
    )
    assert "margin: " in (run / "tuned.yaml").read_text()
