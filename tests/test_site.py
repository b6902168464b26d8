"""The documentation site: it builds without a warning, its links lead somewhere, it
loads nothing from elsewhere."""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

for module in ("mkdocs", "material", "mkdocstrings_handlers.python", "latex2mathml"):
    pytest.importorskip(module, reason="needs the extra docs")

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[1]
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")
PHONE = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}
LOADED = {
    "script": "src",
    "img": "src",
    "link": "href",
    "iframe": "src",
    "source": "src",
}


class Page(HTMLParser):
    """What a page links to, what it loads, its anchors and its tags."""

    def __init__(self, path: Path):
        super().__init__()
        self.links = []
        self.loads = []
        self.anchors = set()
        self.tags = set()
        self.feed(path.read_text())

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.tags.add(tag)
        self.anchors |= {values[name] for name in ("id", "name") if values.get(name)}
        if tag == "a" and values.get("href"):
            self.links.append(values["href"])
        if values.get(LOADED.get(tag)):
            self.loads.append(values[LOADED[tag]])


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The pages of the site by path, and its folder."""
    folder = tmp_path_factory.mktemp("site")
    return built(ROOT, folder, execute="")


def built(source, folder, execute):
    """The pages by path, and the folder, of the site of the mkdocs.yml in a folder."""
    command = [
        sys.executable,
        "-m",
        "mkdocs",
        "build",
        "--strict",
        "--quiet",
        "--site-dir",
        str(folder),
    ]
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    variables = os.environ | {
        "E2RL_EXECUTE": execute,
        "NO_MKDOCS_2_WARNING": "1",
        "PYTHONPATH": paths,
    }
    process = subprocess.run(
        command, cwd=source, env=variables, capture_output=True, text=True, timeout=600
    )
    assert process.returncode == 0, process.stdout + process.stderr
    return {
        path.relative_to(folder).as_posix(): Page(path)
        for path in folder.rglob("*.html")
    }, folder


def broken_links(pages, folder):
    """Links and loads of all pages that lead to no file, or to no anchor of it."""
    broken = []
    for name, page in pages.items():
        for link in page.links + page.loads:
            where = urlsplit(link)
            if where.scheme in ("http", "https", "mailto", "data"):
                continue
            # 404.html links from the root.
            here = folder if where.path.startswith("/") else (folder / name).parent
            path = unquote(where.path).lstrip("/")
            target = here / path if path else folder / name
            if not target.is_file():
                broken.append(f"{name}: {link}")
            elif where.fragment and target.suffix == ".html":
                key = target.resolve().relative_to(folder.resolve()).as_posix()
                if unquote(where.fragment) not in pages[key].anchors | {"__skip"}:
                    broken.append(f"{name}: {link}")
    return broken


def test_the_site_has_the_pages_of_the_folder(site):
    pages, _ = site
    sources = [*(ROOT / "docs").rglob("*.md"), *(ROOT / "docs").rglob("*.ipynb")]
    expected = {
        path.relative_to(ROOT / "docs").with_suffix(".html").as_posix()
        for path in sources
    }
    assert set(pages) - {"404.html"} == expected


def test_every_link_leads_to_a_file_and_an_anchor(site):
    assert broken_links(*site) == []


def test_the_pages_have_links(site):
    pages, _ = site
    assert sum(len(page.links) for page in pages.values()) > 1000


def test_pages_load_nothing_from_elsewhere(site):
    pages, _ = site
    loads = [load for page in pages.values() for load in page.loads]
    assert [load for load in loads if "//" in load] == []


def test_styles_load_nothing_from_elsewhere(site):
    _, folder = site
    styles = "\n".join(path.read_text() for path in folder.rglob("*.css"))
    assert styles
    assert not re.search(r"(@import|url\()\s*[\"']?(https?:)?//", styles)


@pytest.mark.parametrize("page", ["scenes", "prior", "attack", "learning", "metrics"])
def test_the_method_has_formulas(site, page):
    pages, _ = site
    assert "math" in pages[f"reference/{page}.html"].tags


def test_formulas_are_shown_without_a_script(site):
    pages, folder = site
    for name in pages:
        text = (folder / name).read_text()
        assert not re.search(r"arithmatex|<merror|\\\(", text), name


@pytest.mark.parametrize(
    ("page", "words"),
    [
        ("reference/attack.html", "maximal cliques"),
        ("tutorial.html", "which duty did the other vehicle break"),
    ],
)
def test_the_search_finds_pages_and_the_notebook(site, page, words):
    entries = json.loads((site[1] / "search" / "search_index.json").read_text())["docs"]
    result = [entry for entry in entries if words in entry["text"].lower()]
    assert any(entry["location"].startswith(page) for entry in result)


@pytest.mark.parametrize(
    ("page", "name"), [("api", "e2rl.api.find_failures"), ("api-rooms", "e2rl.metrics")]
)
def test_the_api_pages_have_docstrings(site, page, name):
    pages, _ = site
    assert name in pages[f"reference/{page}.html"].anchors


def test_a_link_to_the_notebook_leads_to_its_page(site):
    pages, _ = site
    assert "tutorial.html" in pages["index.html"].links


def test_without_execution_the_report_s_page_says_how_it_is_made(site):
    pages, folder = site
    text = (folder / "guide" / "report.html").read_text()
    assert "E2RL_EXECUTE=true mkdocs build" in text
    assert "iframe" not in pages["guide/report.html"].tags
    assert not (folder / "assets" / "gallery.html").exists()


def test_the_report_is_made_by_the_commands_on_its_page(tmp_path):
    """Of six scenes, once each, in a site of this section alone."""
    text = (ROOT / "docs" / "guide" / "report.md").read_text()
    section = text[text.index("## A report to look at") :]
    small = section.replace(
        "num_scenes=16", "num_scenes=6 tries=1 prior.sampler.steps=2"
    )
    (tmp_path / "docs" / "guide").mkdir(parents=True)
    (tmp_path / "docs" / "guide" / "report.md").write_text(small)
    (tmp_path / "docs" / "index.md").write_text("# Home")
    lines = (ROOT / "mkdocs.yml").read_text().splitlines()
    execute = next(line for line in lines if line.startswith("  execute:"))
    hooks = f"hooks: [{ROOT / 'tools' / 'site' / 'gallery.py'}]"
    (tmp_path / "mkdocs.yml").write_text(
        f"site_name: report\nuse_directory_urls: false\n{hooks}\nextra:\n{execute}\n"
    )
    pages, folder = built(tmp_path, tmp_path / "site", execute="true")
    assert "../assets/gallery.html" in pages["guide/report.html"].links
    assert "../assets/gallery.html" in pages["guide/report.html"].loads
    report = (folder / "assets" / "gallery.html").read_text()
    assert '"n_scenes":6' in report
    assert '"replay":0' in report
    assert tempfile.gettempdir() not in report


@pytest.fixture(scope="module")
def phone():
    """Chromium with a phone's screen, 390 px wide."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="needs browser")
    if not (CHROMIUM and DRIVER):
        pytest.skip("no chromium and chromedriver on the path")
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for flag in ("--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"):
        options.add_argument(flag)
    driver = webdriver.Chrome(options, webdriver.ChromeService(DRIVER))
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", PHONE)
    yield driver
    driver.quit()


def test_no_page_scrolls_sideways_on_a_phone(site, phone):
    """Tables, code and formulas scroll within themselves."""
    pages, folder = site
    width = "return document.scrollingElement.scrollWidth"
    widths = {}
    for name in pages:
        phone.get((folder / name).as_uri())
        widths[name] = phone.execute_script(width)
    assert {name for name in widths if widths[name] > PHONE["width"]} == set()
