"""The history's page: every scene and version, links to failures, one sentence."""

import csv
import io
from contextlib import redirect_stdout

import pytest

from e2rl.commands.report import main
from e2rl.report.history import HISTORY
from e2rl.report.html import PAGE
from tests.evaluation.constructed_runs import row_of, run_of
from tests.report.test_compare import data_of
from tests.report.test_html_browser import CHROMIUM, DRIVER, chromium  # noqa: F401 - a fixture

FAILING = ({0, 1, 2}, {0, 1}, {0, 1, 3, 4})  # of 14 scenes, by version


def write_versions(folder, **settings):
    """Three runs, the second of which has a failure report."""
    runs = []
    for number, hits in enumerate(FAILING):
        rows = [row_of(scene, hit=scene in hits) for scene in range(14)]
        rows += [row_of(scene, method="nominal", eta=0.0) for scene in range(14)]
        runs.append(run_of(folder / f"v{number}", rows, settings=settings))
    (runs[1] / PAGE).write_text("")
    return [str(run) for run in runs]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The page, and what the command says."""
    folder = tmp_path_factory.mktemp("runs")
    said = io.StringIO()
    with redirect_stdout(said):
        main(write_versions(folder))
    return folder / "v2" / HISTORY, said.getvalue()


def test_the_first_sentence_says_what_broke_and_what_was_mended(made):
    path, said = made
    sentence = "new in v2: 2 scenes; mended in v2: 0; fails in all: 2."
    attack, nominal = data_of(path)["traffics"]
    assert attack["lines"][0] == sentence
    assert attack["lines"][1] == "Mended before: 1; never fails: 9 of 14."
    assert "new in v2: 0 scenes" in nominal["lines"][0]
    assert sentence in " ".join(said.split())
    assert str(path) in said
    assert "η" not in said
    assert "no change beyond chance (21% to 29% of rollouts" in attack["lines"][2]


def test_grid_and_list_have_the_scenes_and_link_to_their_failures(made):
    path, _ = made
    data = data_of(path)
    section = data["traffics"][0]
    groups = {
        group["title"]: [scene for scene, _ in group["rows"]]
        for group in section["groups"]
    }
    assert groups == {
        "New in v2": ["scene_3", "scene_4"],
        "Mended in v1": ["scene_2"],
        "Fail in all": ["scene_0", "scene_1"],
    }
    assert section["clear"] == 9
    assert [version["page"] for version in data["versions"]] == [
        None,
        f"../v1/{PAGE}",
        None,
    ]
    cells = dict(section["groups"][2]["rows"])["scene_1"]
    keys = [
        prefix + cell[3]
        for prefix, cell in zip(section["prefixes"], cells, strict=True)
    ]
    assert keys == ["e2__a__2__scene_1__0"] * 3
    with path.with_suffix(".csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    listed = [row for row in rows if row["method"] == "e2"]
    assert [row["v2"] for row in listed] == [*"PP·PP", *"·" * 9]
    assert len(rows) == 28


def test_rates_have_the_intervals_of_the_tables(made):
    rates = data_of(made[0])["traffics"][0]["rates"]
    assert [round(14 * rate["preventable"]["mean"]) for rate in rates] == [3, 2, 4]
    assert all(
        rate["preventable"]["low"] < rate["preventable"]["mean"] for rate in rates
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--replays", "3"], "--replays: for one run"),
        (["--out", "x.json"], "ends in .html"),
        (["--method", "dense"], "choose among e2, nominal"),
        (["--ego", "b"], "has the egos a"),
    ],
)
def test_wrong_options_are_named(tmp_path, capsys, options, message):
    runs = write_versions(tmp_path)
    with pytest.raises(SystemExit) as end:
        main([*runs, *options])
    assert end.value.code == 2
    assert message in capsys.readouterr().err


def test_what_cannot_be_compared_is_refused(tmp_path, capsys):
    runs = write_versions(tmp_path / "one")
    others = write_versions(tmp_path / "two", seeds=[4])
    for inputs, message in (
        ([*runs, others[0]], "seeds ([0, 1] and [4])"),
        ([*runs, runs[0]], "named twice"),
    ):
        with pytest.raises(SystemExit) as end:
            main(inputs)
        assert end.value.code == 2
        assert message in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.skipif(
    not (CHROMIUM and DRIVER), reason="no chromium and chromedriver on the path"
)
@pytest.mark.parametrize("width", [1366, 390])
def test_the_page_opens_and_shows_every_cell(made, chromium, width):  # noqa: F811
    size = {
        "width": width,
        "height": 800,
        "deviceScaleFactor": 1,
        "mobile": width < 500,
    }
    chromium.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    chromium.get_log("browser")  # what earlier tests left
    chromium.get(made[0].as_uri())
    script = "return document.documentElement.scrollWidth"
    assert chromium.execute_script(script) <= width
    cells = chromium.find_elements("css selector", "#scenes td")
    assert "".join(cell.text for cell in cells) == "··P··PP··PPPPPP"
    links = chromium.find_elements("css selector", "#scenes td a")
    assert [link.get_attribute("href") for link in links] == [
        f"{(made[0].parents[1] / 'v1' / PAGE).as_uri()}#failure=e2__a__2__scene_{k}__0"
        for k in (0, 1)
    ]
    assert len(chromium.find_elements("css selector", "#chart circle")) == 3
    assert chromium.get_log("browser") == []
