"""The comparison's page and tables: every pair once, with both replays, one clock;
nothing from elsewhere."""

import csv
import json
import re
import shutil

import pytest

from e2rl.commands.compare import main
from e2rl.evaluation.comparison import CHANGES, Driven
from e2rl.report.compare import PAGE, compare
from e2rl.sim.rollout_file import ROLLOUTS, Rollout
from tests.evaluation.constructed_runs import run_of
from tests.metrics.random_rollouts import random_rollouts
from tests.report.failed_run import SCENE, planned, write_run
from tests.report.test_html_browser import CHROMIUM, DRIVER, chromium, wait_for  # noqa: F401 - a fixture

STEP = "return comparison.player.time"


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two runs of the same scenes: one failure is gone, one new, two are the same."""
    folder = tmp_path_factory.mktemp("runs")
    first = planned(random_rollouts(12, seed=20))
    second = planned(random_rollouts(12, seed=20))
    other = random_rollouts(12, seed=21).states.nan_to_num()
    for rollouts, index in (
        (first, 10),
        (second, 6),
    ):  # a failure that the other run keeps
        rollouts.states[index] = other[index].where(
            rollouts.valid[index][..., None], rollouts.states[index]
        )
    result = []
    for name, rollouts in (("one", first), ("two", second)):
        rollouts.seed[:] = 0
        rollouts.ego_policy = [name] * len(rollouts)
        write_run(folder / name, {"e2": rollouts})
        rest = (folder / name / "rollouts.csv").read_text()
        run_of(folder / name, [])
        (folder / name / "rollouts.csv").write_text(rest)
        result.append(folder / name)
    return result


@pytest.fixture(scope="module")
def made(runs):
    """The page, and what is said."""
    path = runs[1] / PAGE
    return path, compare(*map(Driven.read, runs), path)


def data_of(path) -> dict:
    page = path.read_text()
    return json.loads(
        re.search(
            r'<script type="application/json" id="report">(.*?)</script>',
            page,
            re.DOTALL,
        )[1]
    )


def test_page_json_and_csv_tell_the_same_pairs(made):
    path, said = made
    whole = json.loads(path.with_suffix(".json").read_text())
    page = data_of(path)
    with path.with_suffix(".csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    (group,) = whole["groups"]
    keys = [
        (pair["change"], pair["scene_id"], str(pair["seed"])) for pair in whole["pairs"]
    ]
    assert keys == [(row["change"], row["scene_id"], row["seed"]) for row in rows]
    assert len(set(keys)) == len(keys)
    assert [sum(key[0] == change for key in keys) for change in CHANGES] == [
        group[change] for change in CHANGES
    ]
    assert (group["new"], group["gone"], group["moved"], group["same"]) == (1, 1, 0, 2)
    changed = [pair for pair in whole["pairs"] if pair["change"] != "same"]
    assert page["pairs"] == changed
    assert len(page["replays"]) == 2 * len(changed)
    text = " ".join(said)
    assert f"{group['new']} failures are new" in text
    assert f"{group['gone']} gone" in text
    assert str(path) in text


def test_who_has_no_contact_is_shown_as_long_as_the_other_with_its_partner(runs, made):
    page = data_of(made[0])
    for number, pair in enumerate(page["pairs"]):
        replays = page["replays"][2 * number : 2 * number + 2]
        for side, run, replay, other in zip(
            ("first", "second"), runs, replays, replays[::-1], strict=True
        ):
            steps = len(Rollout.read(run / ROLLOUTS / pair[side]["file"]).states)
            if pair[side]["contact"]:
                assert replay["contact"] == round(10 * pair[side]["contact_time"])
                assert replay["point"]
            else:
                assert replay["point"] is None
                assert replay["contact"] == min(other["contact"] + 30, steps - 1)


def test_the_page_loads_nothing_and_files_cannot_add_markup(made):
    page = made[0].read_text()
    assert page.count("</script") == 2
    assert SCENE not in page
    assert "<img" not in page
    outside = re.sub(r"http://www\.w3\.org/2000/svg", "", page)
    assert not re.search(r"https?://|@import|url\(|\bsrc=(?!x onerror)|<link", outside)


def test_without_rollout_files_the_pairs_are_still_told(runs, tmp_path):
    copies = [
        shutil.copytree(
            run, tmp_path / run.name, ignore=shutil.ignore_patterns(ROLLOUTS)
        )
        for run in runs
    ]
    compare(*map(Driven.read, copies), tmp_path / PAGE)
    page = data_of(tmp_path / PAGE)
    assert page["pairs"]
    assert not page["replays"]


def test_the_command_needs_two_and_a_page(runs, capsys):
    first, two = map(str, runs)
    for inputs, said in (
        ([first], "give two runs, or one with"),
        ([first, two, "--out", "x.json"], "ends in .html"),
    ):
        with pytest.raises(SystemExit) as end:
            main(inputs)
        assert end.value.code == 2
        assert said in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.skipif(
    not (CHROMIUM and DRIVER), reason="no chromium and chromedriver on the path"
)
@pytest.mark.parametrize(("width", "height"), [(1366, 768), (390, 844)])
def test_one_clock_moves_both_replays(made, chromium, width, height):  # noqa: F811
    size = {
        "width": width,
        "height": height,
        "deviceScaleFactor": 1,
        "mobile": width < 500,
    }
    chromium.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    chromium.get_log("browser")  # what earlier tests left
    chromium.get("about:blank")
    chromium.get(made[0].as_uri())
    wait_for(chromium, "return comparison.player.replay !== null")
    assert (
        chromium.execute_script("return document.documentElement.scrollWidth") <= width
    )
    pictures = "return comparison.player.views.map(({ scene }) => scene.toDataURL())"
    begin = chromium.execute_script(pictures)
    chromium.find_element("id", "play").click()
    wait_for(chromium, f"{STEP} > 1")
    chromium.find_element("id", "play").click()
    time = chromium.execute_script(STEP)
    assert all(
        first != other
        for first, other in zip(begin, chromium.execute_script(pictures), strict=True)
    )
    clocks = [
        node.text.split()[0]
        for node in chromium.find_elements("css selector", ".clock")
    ]
    assert clocks == [f"{time / 10:.1f}"] * 2
    last = chromium.execute_script("return comparison.player.replay.steps - 1")
    chromium.execute_script("comparison.player.seek(arguments[0])", last)
    badges = [
        node.get_attribute("textContent")
        for node in chromium.find_elements("css selector", ".badge")
    ]
    pair = data_of(made[0])["pairs"][0]
    assert [badge == "no contact" for badge in badges] == [
        not pair[side]["contact"] for side in ("first", "second")
    ]
    chromium.find_element("id", "next").click()
    assert (
        chromium.execute_script(
            "return comparison.pairs.indexOf(comparison.player.pair)"
        )
        == 1
    )
    select = chromium.find_element("css selector", "#filters select")
    chromium.execute_script(
        "arguments[0].value = 'gone'; arguments[0].dispatchEvent(new Event('change'))",
        select,
    )
    shown = [
        node.text for node in chromium.find_elements("css selector", "#pairs strong")
    ]
    assert shown
    assert all(text.startswith("Gone") for text in shown)
    assert chromium.get_log("browser") == []
