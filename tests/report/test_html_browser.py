"""The failure report in Chromium: it loads without a complaint, shows what the files
hold, and obeys."""

import base64
import shutil
import threading
import zlib
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest

from e2rl.evaluation.rollout_files import TABLE, read_rows
from e2rl.metrics.atlas import atlas_of
from e2rl.metrics.failure_modes import is_failure
from e2rl.report.attachments import Attached
from e2rl.report.html import PAGE, write_report
from e2rl.sim.rollout_file import ROLLOUTS, Rollout, rollout_key, rollout_name
from tests.report.failed_run import SCENE, failed_run, preventable_run

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")
FLAGS = (
    *(
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-background-networking",
        "--disable-sync",
    ),
    *("--no-first-run", "--window-size=1440,900"),
)
webdriver = pytest.importorskip("selenium.webdriver", reason="needs the extra browser")
support = pytest.importorskip("selenium.webdriver.support.ui")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not (CHROMIUM and DRIVER), reason="no chromium and chromedriver on the path"
    ),
]
DECODE = """const done = arguments[1];
page.store.replay(arguments[0]).then(({ replay }) => done(replay.tracks.map((track) =>
  Object.fromEntries(Object.keys(page.report.channels).map(
    (name) => [name, Array.from(track[name])])))));"""
COLOUR_AT = """const { player } = page;
player.shown.clear();
player.draw();
const { replay, time, metres, node: { scene } } = player;
const [x, y] = cameraAt(replay, time);
const scale = Math.min(scene.width, scene.height) / metres;
const at = [scene.width / 2 + (arguments[0] - x) * scale,
            scene.height / 2 - (arguments[1] - y) * scale];
return Array.from(scene.getContext("2d").getImageData(...at, 1, 1).data.slice(0, 3));"""
EGO = [0x15, 0x65, 0xD8]  # page.css


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return failed_run(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def chromium(tmp_path_factory):
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    browser = webdriver.Chrome(options, webdriver.ChromeService(DRIVER))
    yield browser
    browser.quit()


@pytest.fixture
def page(run, chromium):
    """A browser with the report freshly open."""
    write_report(run)
    chromium.get("about:blank")
    chromium.get((run / PAGE).as_uri())
    wait_for(chromium, "return page.player.replay !== null")
    return chromium


def wait_for(browser, condition):
    support.WebDriverWait(browser, 20, 0.05).until(
        lambda _: browser.execute_script(condition)
    )


def rows_of(browser) -> list[list[str]]:
    """The cells of the index."""
    return browser.execute_script(
        """const rows = document.querySelectorAll("#index tbody tr:not(.scene)");
        return [...rows].map((row) => [...row.cells].map((cell) => cell.textContent));"""
    )


def heads_of(browser) -> list[str]:
    return [
        node.text.split(" ▲")[0].strip()
        for node in browser.find_elements("css selector", "#index thead th")
    ]


def failures_of(run) -> list[dict]:
    return [row for row in read_rows(run / TABLE) if is_failure(row)]


def shown_in(browser, run) -> dict:
    """The row of the failure that is shown."""
    key = browser.execute_script("return page.player.failure.key")
    return next(row for row in failures_of(run) if rollout_key(row) == key)


def choose(browser, label: str, starts: str) -> None:
    """Choose, in the select of this label, what begins so."""
    labels = browser.find_elements("css selector", "#scope label, #filters label")
    node = next(
        item
        for item in labels
        if item.text.splitlines() and item.text.splitlines()[0].strip() == label
    )
    select = support.Select(node.find_element("tag name", "select"))
    select.select_by_visible_text(
        next(item.text for item in select.options if item.text.startswith(starts))
    )


def test_it_opens_without_a_complaint(run, page):
    assert page.get_log("browser") == []
    assert len(rows_of(page)) == len(failures_of(run))
    assert (
        len(page.find_elements("css selector", "#curves svg polyline")) >= 5
    )  # ego, partner, driver; gaps of two


def test_the_browser_decodes_what_the_files_hold(run, page):
    numbers = page.execute_script(
        "return page.report.failures.map((failure) => failure.replay)"
    )
    for row, number in zip(failures_of(run), numbers, strict=True):
        rollout = Rollout.read(run / ROLLOUTS / rollout_name(row))
        tracks = page.execute_async_script(DECODE, number)
        steps = len(tracks[0]["x"])
        agents = np.flatnonzero(rollout.valid[:steps].any(0))
        for track, agent in zip(tracks, agents, strict=False):
            present = np.array(track["present"]) == 1
            assert (present == rollout.valid[:steps, agent]).all()
            for name, index, quantum in (
                ("x", 0, 0.01),
                ("y", 1, 0.01),
                ("speed", 3, 0.01),
            ):
                result = np.array(track[name])[present]
                assert (
                    np.abs(result - rollout.states[:steps, agent, index][present]).max()
                    < 0.51 * quantum + 1e-5
                )


def test_scrubbing_moves_the_ego_on_the_canvas(run, page):
    row = shown_in(page, run)
    states = Rollout.read(run / ROLLOUTS / rollout_name(row)).states[:, 0]
    for step in (0, 4, 8):
        page.execute_script("page.player.seek(arguments[0])", step)
        x, y, heading, _ = states[step].tolist()
        assert (
            page.execute_script(COLOUR_AT, x - np.cos(heading), y - np.sin(heading))
            == EGO
        )  # 1 m behind its middle


def test_filters_keep_what_they_say_and_names_from_files_are_text(run, page):
    heads = heads_of(page)
    side = [row for row in failures_of(run) if row["contact_type"] == "side"]
    choose(page, "Contact", starts="side")
    shown = rows_of(page)
    assert 0 < len(shown) == len(side)
    assert {row[heads.index("Contact")] for row in shown} == {"side"}
    page.find_element("css selector", "#filters button").click()  # reset
    assert len(rows_of(page)) == len(failures_of(run))
    scenes = [row[heads.index("Scene")] for row in rows_of(page)]
    assert scenes
    assert all(name.startswith(SCENE) for name in scenes)
    assert not page.find_elements("tag name", "img")
    assert not page.find_elements("css selector", ".caption b")


def test_the_atlas_shows_the_likeliest_failure_of_a_cell_in_its_scope(
    chromium, tmp_path
):
    run = preventable_run(tmp_path)
    chromium.get_log("browser")  # what earlier tests left
    chromium.get(write_report(run).as_uri())
    wait_for(chromium, "return page.player.replay !== null")
    for method in ("e2", "planned"):
        choose(chromium, "Traffic", starts=method)
        atlas = atlas_of([row for row in failures_of(run) if row["method"] == method])
        buttons = chromium.find_elements("css selector", "#atlas button")
        assert len(buttons) == len(atlas) == 3
        for button in buttons:  # in the order of the grid
            approach = button.find_element("xpath", "./ancestor::tr/th").text
            light = "light" in button.get_attribute("title")
            failures = atlas[
                approach, "brakes", "light" if light else "none", "5 to 10 m/s", "front"
            ]
            nats = (
                "nats unknown"
                if approach == "ahead"
                else f"{failures[0]['transport']:.0f} nats"
            )
            assert f"{len(failures)} failure" in button.text
            assert nats in button.text
            button.send_keys("\n")
            shown = shown_in(chromium, run)
            assert shown["transport"] == failures[0]["transport"] or approach == "ahead"
            assert (shown["scene_id"], shown["seed"]) == (
                failures[0]["scene_id"],
                failures[0]["seed"],
            )
            pressed = [item.get_attribute("aria-pressed") for item in buttons]
            assert pressed == [str(item == button).lower() for item in buttons]
    assert chromium.get_log("browser") == []


def test_a_link_opens_at_its_failure_from_a_folder_and_from_a_server(run, page):
    handler = partial(SimpleHTTPRequestHandler, directory=run)
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        rows = failures_of(run)
        for base in (
            (run / PAGE).as_uri(),
            f"http://127.0.0.1:{server.server_port}/{PAGE}",
        ):
            for number, row in enumerate(rows):
                if number % 2:  # else only the end of the address changes
                    page.get("about:blank")
                page.get(f"{base}#failure={rollout_key(row)}")
                wait_for(
                    page,
                    f"return page.player.failure.key === {rollout_key(row)!r} && "
                    "page.player.replay !== null",
                )
                assert page.current_url == page.find_element(
                    "css selector", "#copies input"
                ).get_attribute("value")
                first = page.find_element("css selector", "#answer strong").text
                assert (
                    f"under {row['method']} at η=2: preventable" in first
                )  # the traffic of the failure
                assert not page.find_element("id", "lost").is_displayed()
        page.get(f"{base}#failure=none")
        wait_for(page, "return !document.getElementById('lost').hidden")
        server.shutdown()


def test_the_first_lines_are_of_one_traffic_and_others_can_be_chosen(run, page):
    for method in (None, "planned", "e2"):
        if method:
            choose(page, "Traffic", starts=method)
        rows = [
            row for row in read_rows(run / TABLE) if row["method"] == (method or "e2")
        ]
        certain = [row["cfr"] for row in rows if row["cfr"] == row["cfr"]]
        assert (
            f"hit in {sum(certain):.0f} of {len(certain)} rollouts"
            in page.find_element("id", "answer").text
        )
        assert len(rows_of(page)) == len(
            failures_of(run)
        )  # the index has those of all traffic


def test_failures_of_a_scene_stand_together_whatever_the_traffic(run, page):
    groups = page.execute_script(
        """return [...document.querySelectorAll("#index tbody tr")].map(
            (row) => [row.className, row.textContent]);"""
    )
    scenes = []
    under = {}
    for kind, text in groups:
        if kind == "scene":
            scenes.append(text)
        else:
            under.setdefault(scenes[-1], []).append(text)
    names = {row["scene_id"] for row in failures_of(run)}
    assert len(scenes) == len(names) == len(under)
    assert sum(map(len, under.values())) == len(failures_of(run))
    for name in names:
        ours = [row for row in failures_of(run) if row["scene_id"] == name]
        (head,) = [
            text for text in scenes if text.startswith(f"{name}: {len(ours)} failure")
        ]
        assert len(under[head]) == len(ours)
        assert all(row["method"] in head for row in ours)
    assert any("e2 η=2, planned η=2" in text for text in scenes)


def test_the_speed_that_is_shown_is_the_speed_driven(run, page):
    """At every moment, and at whatever rate the replay is played."""
    row = shown_in(page, run)
    states = Rollout.read(run / ROLLOUTS / rollout_name(row)).states[:, 0]
    for rate in ("1", "0.25"):
        page.execute_script(
            "document.getElementById('rate').value = arguments[0]", rate
        )
        for step in range(int(row["contact_step"]) + 1):
            page.execute_script("page.player.seek(arguments[0])", step)
            seconds, speed = page.find_element("id", "clock").text.split("\n")
            assert float(seconds.split()[0]) == pytest.approx(0.1 * step, abs=1e-6)
            assert float(speed.split()[1]) == pytest.approx(states[step, 3], abs=0.0551)
            assert speed.endswith(" m/s")
    assert page.find_element("css selector", ".controls label").text.startswith(
        "Playback"
    )


def test_what_is_copied_is_the_whole_field(page):
    for line in page.find_elements("css selector", "#copies div"):
        page.execute_script("arguments[0].scrollIntoView()", line)
        line.find_element("tag name", "button").click()
        field = line.find_element("tag name", "input")
        ends = page.execute_script(
            "return [arguments[0].selectionStart, arguments[0].selectionEnd]", field
        )
        assert ends == [0, len(field.get_attribute("value"))]
        assert "Copied" in line.text


@pytest.fixture
def summary(run, page):
    """The browser at the summary of the report."""
    page.get("about:blank")
    page.get_log("browser")
    page.get((run / PAGE).as_uri() + "#summary")
    wait_for(page, "return page.cases.every(({ found }) => found)")
    yield page
    page.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_the_summary_is_one_screen_of_words_and_leads_to_its_failures(run, summary):
    assert summary.current_url.endswith("#summary")
    assert not summary.find_element("tag name", "main").is_displayed()
    text = summary.find_element("id", "summary").text
    assert text.count("careful driver would have") >= 3
    assert "η" not in text
    assert SCENE not in text
    cases = summary.find_elements("css selector", "#plain-cases a")
    assert len(cases) == 3
    link = cases[1].get_attribute("href")
    cases[1].click()
    wait_for(summary, "return !document.body.classList.contains('brief')")
    assert summary.current_url == link
    key = summary.execute_script("return page.player.failure.key")
    assert link.endswith(f"#failure={key}")
    assert summary.execute_script("return document.getElementById('scene').width") > 0
    summary.find_element("css selector", ".masthead a").click()
    wait_for(summary, "return !document.getElementById('summary').hidden")
    assert summary.get_log("browser") == []


@pytest.mark.parametrize("paper", [(8.27, 11.69), (8.5, 11.0)], ids=["A4", "letter"])
def test_the_summary_prints_on_one_page(summary, paper):
    options = {"paperWidth": paper[0], "paperHeight": paper[1]}
    printed = summary.execute_cdp_cmd("Page.printToPDF", options)
    assert base64.b64decode(printed["data"]).count(b"/Type /Page\n") == 1


@pytest.mark.parametrize("end", ["#summary", "#details"])
def test_nothing_is_wider_than_a_phone(run, summary, end):
    size = {"width": 375, "height": 812, "deviceScaleFactor": 2, "mobile": True}
    summary.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    summary.get((run / PAGE).as_uri() + end)
    width = summary.execute_script("return document.documentElement.scrollWidth")
    assert width == 375


def test_a_button_saves_the_attached_file(run, chromium, tmp_path):
    attached = Attached(["npz"], scene=False)
    path = write_report(run, replays=3, path=tmp_path / "page.html", attached=attached)
    folder = tmp_path / "saved"
    folder.mkdir()
    where = {"behavior": "allow", "downloadPath": str(folder)}
    chromium.execute_cdp_cmd("Browser.setDownloadBehavior", where)
    chromium.get_log("browser")
    chromium.get(path.as_uri())
    wait_for(chromium, "return page.player.replay !== null")
    button = chromium.find_element("css selector", "#copies button")
    (file,) = chromium.execute_script(
        "return page.report.attached[page.player.failure.key]"
    )
    assert button.text.startswith("Download npz.zip (")
    chromium.execute_script("arguments[0].click()", button)
    saved = folder / file["name"]
    support.WebDriverWait(chromium, 20, 0.05).until(lambda _: saved.is_file())
    assert saved.read_bytes() == zlib.decompress(base64.b64decode(file["data"]))
    assert chromium.get_log("browser") == []


def cells_of(browser, place: str, column: int) -> list[str]:
    """The cells of a column of the first table at a place."""
    return browser.execute_script(
        """const table = document.querySelector(arguments[0]).querySelector("table");
        const rows = [...table.tBodies[0].rows];
        return rows.map((row) => row.cells[arguments[1]].textContent);""",
        place,
        column,
    )


def test_a_table_is_sorted_by_keys_and_goes_back_to_its_order(page):
    def number(text: str) -> float:
        return float(text.split(" ")[0].replace("−", "-").replace(",", ""))

    before = cells_of(page, "#tables", column=1)
    known = [text for text in before if text != "–"]
    unknown = ["–"] * (len(before) - len(known))
    heads = page.find_elements("css selector", "#tables th[aria-sort]")
    button = heads[1].find_element("tag name", "button")
    orders = {"ascending": False, "descending": True}
    for word, reverse in orders.items():
        button.send_keys("\n")
        assert heads[1].get_attribute("aria-sort") == word
        after = cells_of(page, "#tables", column=1)
        assert after[len(known) :] == unknown
        values = list(map(number, after[: len(known)]))
        assert values == sorted(values, reverse=reverse)
        assert button == page.switch_to.active_element
    button.send_keys("\n")
    assert heads[1].get_attribute("aria-sort") == "none"
    assert cells_of(page, "#tables", column=1) == before


def test_scenes_are_filtered_by_what_came_of_them(page):
    names = page.execute_script("return page.report.outcomes.names")
    before = cells_of(page, "#outcomes", column=0)
    assert len(names) > 1
    select = support.Select(page.find_element("css selector", "#outcomes select"))
    for name in names:
        select.select_by_visible_text(name)
        rows = page.find_elements("css selector", "#outcomes tbody tr")
        assert 0 < len(rows) < len(before)
        assert all(name in row.text for row in rows)
    select.select_by_visible_text("all")
    field = page.find_element("css selector", "#outcomes input")
    field.send_keys(before[0], "\n")
    assert before[0] in cells_of(page, "#outcomes", column=0)
    assert page.find_element("css selector", "#outcomes input") == field  # no reload
