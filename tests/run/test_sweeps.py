"""What a command line is told: lists, and jobs of a sweep that are refused."""

import sys

import pytest
from hydra.core.global_hydra import GlobalHydra

from e2rl.run.command import run_command
from e2rl.run.config import check_list, load_config
from e2rl.run.errors import InputError
from e2rl.run.machine import set_up
from e2rl.run.options import wrong_option


@pytest.mark.parametrize(
    ("key", "value", "mend"),
    [
        ("seeds", "0,1", "'seeds=[0,1]'"),
        ("methods", "no anchoring, e2", "'methods=[no anchoring,e2]'"),
    ],
)
def test_several_values_are_told_as_a_list(key, value, mend):
    said = f"Ambiguous value for argument '{key}={value}'\n1. To use it as a list, use key=[value1,value2]"
    assert mend in wrong_option("evaluate", [], said)
    with pytest.raises(InputError, match="several values are a list") as refused:
        check_list(key, value)
    assert mend in str(refused.value)


def test_a_name_with_spaces_is_no_list():
    check_list("compare", "no anchoring")
    check_list("seeds", 3)


@pytest.mark.parametrize("key", ["methods", "eta", "seeds", "compare", "shard"])
def test_a_text_with_commas_is_refused_for_every_list(key):
    with pytest.raises(
        InputError, match=rf"{key}=1,2: several values are a list, '{key}=\[1,2\]'"
    ):
        set_up(load_config("evaluate", [f"{key}='1,2'"]))


@pytest.fixture
def sweep(tmp_path, monkeypatch, capfd):
    """Runs a command that refuses batch=2; returns its status and what it said."""

    def work(run):
        if run.config.batch == 2:
            raise InputError("batch=2: refused")
        print("did", run.config.batch)

    def command(*options):
        monkeypatch.setattr(sys, "argv", ["evaluate.py", *options])
        monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
        monkeypatch.chdir(tmp_path)
        status = 0
        try:
            run_command("evaluate", work)
        except SystemExit as stop:
            status = stop.code
        finally:
            GlobalHydra.instance().clear()
        return status, *capfd.readouterr()

    return command


@pytest.mark.parametrize(("values", "status"), [("1,2,3", 2), ("1,3", 0)])
def test_a_sweep_goes_on_after_a_job_that_is_refused(sweep, values, status):
    ended, out, err = sweep("-m", f"batch={values}", "hydra.sweep.dir=sweep")
    names = values.split(",")
    assert ended == status, err
    did = [line for line in out.splitlines() if line.startswith("did")]
    assert did == [f"did {name}" for name in names if name != "2"]
    summary = f"error: 1 of {len(names)} jobs of the sweep were refused: batch=2"
    assert (err.strip().splitlines() or [""])[-1] == (summary if status else "")
    assert err.count("batch=2: refused") == (status > 0)


def test_a_job_alone_that_is_refused_says_so_once(sweep):
    status, _, err = sweep("batch=2", "hydra.run.dir=run")
    assert status == 2
    assert err == "error: batch=2: refused\n"
