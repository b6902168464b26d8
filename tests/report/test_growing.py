"""The failure report of a run that goes on."""

from types import SimpleNamespace

import pytest

from e2rl.commands import report
from e2rl.driving.scored import Scored
from e2rl.evaluation.rollout_files import TABLE, read_rows
from e2rl.metrics.failure_modes import is_failure
from e2rl.report import growing
from e2rl.report.growing import GrowingReport
from e2rl.run.parts import Parts
from e2rl.run.trust import CONFIG
from tests.metrics.random_rollouts import random_rollouts
from tests.report.failed_run import write_run
from tests.report.test_html import data_of


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run that is not finished: its rows are in parts, and not in a table."""
    driven = {"e2": random_rollouts(12, seed=21)}
    folder = write_run(tmp_path_factory.mktemp("run"), driven)
    rows = read_rows(folder / TABLE)
    (folder / TABLE).unlink()
    parts = Parts(folder)
    for number, part in enumerate((rows[:5], rows[5:])):
        parts.save(f"rollouts-{number:06}", identity=[], value=(part, [], []))
    (folder / CONFIG).parent.mkdir()
    (folder / CONFIG).write_text("{}")
    return folder, rows


@pytest.fixture
def growing_report(run):
    plan = SimpleNamespace(
        run=SimpleNamespace(folder=run[0], config=None),
        settings=SimpleNamespace(budget=None),
        driven=lambda rows: f"{len(rows)} of 12",
    )
    return GrowingReport(plan)


def page_of(folder):
    return data_of((folder / "failures.html").read_text())


def test_the_page_grows_and_says_where_the_run_stopped(run, growing_report, capsys):
    folder, rows = run
    (folder / "failures.html").unlink(missing_ok=True)
    growing_report.add(Scored([row for row in rows if not is_failure(row)]))
    assert not (folder / "failures.html").exists()
    failures = [row for row in rows if is_failure(row)]
    growing_report.add(Scored(failures[:3]))
    page = page_of(folder)
    assert len(page["failures"]) == len(page["replays"]) == 3
    assert page["progress"]["every"] > 0
    growing_report.add(Scored(failures[3:]))  # too soon for another page
    assert page_of(folder) == page
    growing_report.stop()
    page = page_of(folder)
    assert page["progress"] == {"text": "Stopped at 12 of 12 rollouts.", "every": 0}
    assert len(page["failures"]) == len(failures)
    assert capsys.readouterr().err.count("first failures: ") == 1


def test_an_error_of_the_page_does_not_end_the_run(
    run, growing_report, capsys, monkeypatch
):
    def fail(*arguments, **options):
        raise OSError("full")

    monkeypatch.setattr(growing, "write_report", fail)
    monkeypatch.setattr(growing, "SHARE", float("inf"))
    growing_report.add(Scored(run[1]))
    growing_report.add(Scored([]))
    assert capsys.readouterr().err.count("no failure report yet (OSError: full)") == 1


def test_a_run_that_is_not_finished_has_its_page_so_far(run, tmp_path, capsys):
    folder, rows = run
    out = tmp_path / "failures.html"
    report.main([str(folder), "--out", str(out)])
    page = page_of(tmp_path)
    assert page["progress"]["text"].startswith("So far: 12 rollouts")
    assert len(page["failures"]) == sum(map(is_failure, rows))
    for part in (folder / "parts").glob("*.pt"):
        part.write_bytes(b"damaged")
    with pytest.raises(SystemExit):
        report.main([str(folder)])
    assert f"evaluate resume={folder}" in capsys.readouterr().err
