"""The command: which rollouts it takes, from which scenes; a folder is whole or not
there."""

import csv
import shutil

import numpy as np
import pytest
from omegaconf import OmegaConf

from e2rl.commands.export import LIST, main
from e2rl.sim.rollout_file import Rollout
from tests.report.export.small_run import CUT_IN, rollout_of


def lines(folder):
    with (folder / LIST).open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def copy(run, tmp_path):
    """The run's folder, to change; its data stay where they are."""
    return shutil.copytree(run, tmp_path / "run")


def refused(capsys, arguments) -> str:
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    assert end.value.code == 2
    message = capsys.readouterr().err.strip().splitlines()[-1]
    assert message.startswith("error: ")
    return message


def test_npz_are_the_rollouts_and_their_scenes(run, tmp_path):
    main([str(run), "--to", "npz", "--all", "--out", str(tmp_path / "all")])
    for index, line in enumerate(lines(tmp_path / "all")):
        ours = rollout_of(run, index)
        theirs = Rollout.read(tmp_path / "all" / line["file"])
        assert all(
            np.array_equal(value, getattr(theirs, name))
            for name, value in vars(ours).items()
        )
        with np.load(tmp_path / "all" / "scenes" / f"scene-{index}.npz") as scene:
            np.testing.assert_allclose(
                scene["origin"] + ours.states[0, 0, :2], [28, 0], atol=1e-3
            )
            np.testing.assert_allclose(scene["logged"], ours.logged)


def test_some_failures_and_all_rollouts_exclude_each_other(copy, capsys):
    with pytest.raises(SystemExit) as end:
        main([str(copy), "--to", "npz", "--all", "--failures", "2"])
    assert end.value.code == 2
    assert "--failures: not allowed with argument --all" in capsys.readouterr().err


def test_of_a_run_with_a_damaged_rollout_nothing_is_left(copy, tmp_path, capsys):
    path = sorted((copy / "rollouts").iterdir())[
        1
    ]  # the second of two, when the first is written
    path.write_bytes(path.read_bytes()[:100])
    assert path.name in refused(
        capsys, [copy, "--to", "scenarionet", "--all", "--out", tmp_path / "out"]
    )
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def edit(copy, **changes):
    """Change keys of the `data` group that the run names."""
    config = OmegaConf.load(copy / ".hydra" / "config.yaml")
    config.data = OmegaConf.merge(config.data, changes)
    OmegaConf.save(config, copy / ".hydra" / "config.yaml")


def test_scenes_that_are_not_those_of_the_run_are_refused(copy, tmp_path, capsys):
    arguments = (copy, "--to", "npz", "--out", tmp_path / "out")
    edit(copy, starts=[15])
    assert "hold no scene 'scene-0'" in refused(capsys, arguments)
    edit(copy, starts=None, build={"steps": 60})
    assert "not driven in the scene 'scene-0'" in refused(capsys, arguments)
    shutil.rmtree(copy / ".hydra")
    assert "pass --no-scene" in refused(capsys, arguments)
    main([str(argument) for argument in (*arguments, "--no-scene")])
    (line,) = lines(tmp_path / "out")
    assert line["scene_id"] == "scene-0"
    assert line["partner"] == line["adversaries"] == str(CUT_IN)
    assert line["cfr"] == "1"
    assert line["duty"]
    assert line["contact_step"]
    assert not (tmp_path / "out" / "scenes").exists()


def test_a_stranger_s_folder_runs_no_code_but_that_which_the_command_names(
    copy, tmp_path, capsys, monkeypatch
):
    (tmp_path / "theirs.py").write_text(
        "from dataclasses import dataclass\nfrom e2rl.scenes.scenarionet import ScenarioNetSource\n"
        f"open({str(tmp_path / 'ran')!r}, 'w').close()\n"
        "@dataclass\nclass Theirs(ScenarioNetSource):\n    pass\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    edit(copy, _target_="theirs.Theirs")
    assert "runs code that is no extension" in refused(
        capsys, [copy, "--to", "npz", "--out", tmp_path / "out"]
    )
    assert not (tmp_path / "ran").exists()
    main(
        [str(copy), "--to", "npz", "--out", str(tmp_path / "out"), "--plugin", "theirs"]
    )
    assert (tmp_path / "ran").exists()
    assert len(lines(tmp_path / "out")) == 1
