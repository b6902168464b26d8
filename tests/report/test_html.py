"""The failure report: every failure once, what a run lacks is said, nothing from elsewhere, no markup from files."""

import json
import re

import pytest

from e2rl.evaluation.modes import read_modes
from e2rl.evaluation.rollout_files import read_rows
from e2rl.metrics.atlas import CELL, atlas_of
from e2rl.metrics.failure_modes import is_failure
from e2rl.report.html import replay_order, write_report
from tests.report.failed_run import SCENE, failed_run, preventable_run


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return failed_run(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def page(run):
    return write_report(run).read_text()


def data_of(page: str) -> dict:
    return json.loads(re.search(r'<script type="application/json" id="report">(.*?)</script>', page, re.DOTALL)[1])


def test_every_failure_is_in_the_index_with_its_replay(run, page):
    data = data_of(page)
    failures = [row for row in read_rows(run / "rollouts.csv") if is_failure(row)]
    assert len(data["failures"]) == len(failures) == read_modes(run / "modes.json")["failures"] > 5
    for entry, row in zip(data["failures"], failures, strict=True):
        assert (entry["scene_id"], entry["method"], entry["seed"]) == (row["scene_id"], row["method"], row["seed"])
        assert entry["ego_speed"] == pytest.approx(row["ego_speed"], abs=1e-4) and entry["avoidable"] is None
        replay = data["replays"][entry["replay"]]
        assert replay["contact"] == row["contact_step"] and 0 <= replay["map"] < len(data["maps"])
    assert sum(group["failures"] for group in data["groups"]) == len(failures)
    assert data["tables"][0]["head"] == ["", "e2 η=2", "planned η=2"]


def test_a_limit_and_a_method_keep_their_own(run, tmp_path):
    one = data_of(write_report(run, replays=1, methods=["e2"], path=tmp_path / "one.html").read_text())
    assert {entry["method"] for entry in one["failures"]} == {group["method"] for group in one["groups"]} == {"e2"}
    assert len(one["replays"]) == 1


def test_the_page_knows_the_atlas_and_replays_its_likeliest_failures_first(tmp_path):
    run = preventable_run(tmp_path)
    rows = [row for row in read_rows(run / "rollouts.csv") if is_failure(row)]
    data = data_of(write_report(run).read_text())
    entries = data["failures"]
    typical = sum(entry["typical"] for entry in entries)
    for method in (None, "e2", "planned"):
        ours = [k for k, row in enumerate(rows) if method in (None, row["method"])]
        found = {}
        for k in sorted(ours, key=lambda k: entries[k]["rank"]):
            found.setdefault(tuple(data["cells"][entries[k]["cell"]][name] for name in CELL), k)
        atlas = atlas_of([rows[k] for k in ours])
        assert len(atlas) == 3 and list(found) == list(atlas)
        assert [rows[k] for k in found.values()] == [cell.likeliest for cell in atlas.values()]
        first = replay_order(entries)[: typical + (3 if method is None else 6)]
        assert all(entries[k]["typical"] for k in first[:typical]) and set(found.values()) <= set(first)


def test_the_page_loads_nothing_and_files_cannot_add_markup(page):
    assert page.count("</script") == 2 and SCENE not in page and "<img" not in page
    outside = re.sub(r"http://www\.w3\.org/2000/svg", "", page)
    assert not re.search(r"https?://|@import|url\(|\bsrc=(?!x onerror)|<link", outside)
