"""Shards of an evaluation, as jobs of a cluster: joined, they are the run that was not
split."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from e2rl.commands.merge import main, merge
from e2rl.run.errors import InputError
from tests.evaluation.test_protocol import same_runs
from tests.scripts import SHORT, call

ROOT = Path(__file__).parents[2]
OPTIONS = [
    *SHORT,
    "methods=[constant_velocity,idm]",
    "seeds=[0,1]",
    "batch=2",
    "processes=1",
]


@pytest.mark.slow
def test_jobs_of_submitit_give_the_run_of_one_machine(tmp_path, monkeypatch, capsys):
    """Two local jobs with two of four batches each. Then the tables, bit for bit; and a
    shard that another run's is added to is refused."""
    pytest.importorskip("submitit")
    options = [*OPTIONS, f"data.cache={tmp_path / 'cache'}"]
    assert (
        call(
            "evaluate.py",
            [*options, f"hydra.run.dir={tmp_path / 'one'}"],
            monkeypatch=monkeypatch,
            capsys=capsys,
        )[0]
        == 0
    )
    command = [
        sys.executable,
        str(ROOT / "examples" / "slurm.py"),
        "--cluster",
        "local",
        "--jobs",
        "2",
    ]
    process = subprocess.run(
        [*command, "--into", str(tmp_path / "jobs"), "--", *options],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert process.returncode == 0, process.stderr
    shards = [tmp_path / "jobs" / f"shard-{number}" for number in range(2)]
    assert [len(list((shard / "parts").iterdir())) for shard in shards] == [2, 2]
    assert not any((shard / "rollouts.csv").exists() for shard in shards)
    same_runs(tmp_path / "one", tmp_path / "jobs" / "whole")

    other = [*options, "eta=1", "shard=[1,2]", f"hydra.run.dir={tmp_path / 'other'}"]
    assert call("evaluate.py", other, monkeypatch=monkeypatch, capsys=capsys)[0] == 0
    with pytest.raises(InputError, match="began with another eta"):
        merge([shards[0], tmp_path / "other"], tmp_path / "mixed")
    assert not (tmp_path / "mixed").exists()


def test_what_cannot_be_merged_is_named(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main([str(tmp_path), "--into", str(tmp_path / "whole")])
    assert (
        "provenance.json: not there; give the folder of a run"
        in capsys.readouterr().err
    )
