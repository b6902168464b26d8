"""The documentation site: it builds without a warning, its links lead somewhere, it
loads nothing from elsewhere."""

import json
import os
import re
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
    done = subprocess.run(
        command, cwd=source, env=variables, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return {
        path.relative_to(folder).as_posix(): Page(path)
        for path in folder.rglob("*.html")
    }, folder


def test_every_link_leads_to_a_file_and_an_anchor(site):
    pages, folder = site
    broken = []
    for name, page in pages.items():
        for link in page.links + page.loads:
            where = urlsplit(link)
            if where.scheme in ("http", "https", "mailto", "data"):
                continue
            here = (
                folder if where.path.startswith("/") else (folder / name).parent
            )  # 404.html links from the root
            target = (
                here / unquote(where.path).lstrip("/") if where.path else folder / name
            )
            if not target.is_file():
                broken.append(f"{name}: {link}")
            elif where.fragment and target.suffix == ".html":
                anchors = pages[
                    target.resolve().relative_to(folder.resolve()).as_posix()
                ].anchors
                if unquote(where.fragment) not in anchors | {"__skip"}:
                    broken.append(f"{name}: {link}")
    assert sum(len(page.links) for page in pages.values()) > 1000 and not broken, (
        "\n".join(broken)
    )


def test_pages_load_nothing_from_elsewhere(site):
    pages, folder = site
    assert not [
        (name, address)
        for name, page in pages.items()
        for address in page.loads
        if "//" in address
    ]
    styles = [path.read_text() for path in folder.rglob("*.css")]
    assert styles and not any(
        re.search(r"(@import|url\()\s*[\"']?(https?:)?//", style) for style in styles
    )


def test_formulas_are_shown_without_a_script(site):
    pages, folder = site
    with_formulas = {name for name, page in pages.items() if "math" in page.tags}
    assert {
        "concepts/prior.html",
        "concepts/synthesizer.html",
        "concepts/learning.html",
    } <= with_formulas
    assert not [
        name
        for name in pages
        if re.search(r"arithmatex|<merror|\\\(", (folder / name).read_text())
    ]


def test_every_section_of_the_method_stands_on_one_page(site):
    _, folder = site
    text = "\n".join(path.read_text() for path in (folder / "concepts").glob("*.html"))
    headings = re.findall(
        r"^## (.+)$", (ROOT / "docs" / "method.md").read_text(), re.MULTILINE
    )
    found = re.findall(r"<h2 [^>]*>(.*?)<a ", text)
    assert headings and {
        heading: found.count(heading) for heading in headings
    } == dict.fromkeys(headings, 1)


def test_the_search_finds_pages_docstrings_and_the_notebook(site):
    entries = json.loads((site[1] / "search" / "search_index.json").read_text())["docs"]
    for page, words in (
        ("concepts/synthesizer.html", "maximal cliques"),
        ("tutorial.html", "which duty did the other vehicle break"),
    ):
        assert any(
            entry["location"].startswith(page) and words in entry["text"].lower()
            for entry in entries
        ), page


def test_the_gallery_is_made_by_the_commands_on_its_page(site, tmp_path):
    """Of six scenes, once each, in a site of this page alone; without E2RL_EXECUTE the
    page says how it is made."""
    pages, folder = site
    assert "E2RL_EXECUTE=true mkdocs build" in (folder / "gallery.html").read_text()
    assert (
        "iframe" not in pages["gallery.html"].tags
        and not (folder / "assets" / "gallery.html").exists()
    )
    text = (ROOT / "docs" / "gallery.md").read_text()
    small = text.split("[Watch the failures]")[0].replace(
        "num_scenes=16", "num_scenes=6 tries=1"
    )
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "gallery.md").write_text(small)
    lines = (ROOT / "mkdocs.yml").read_text().splitlines()
    execute = next(line for line in lines if line.startswith("  execute:"))
    hooks = f"hooks: [{ROOT / 'tools' / 'site' / 'gallery.py'}]"
    (tmp_path / "mkdocs.yml").write_text(
        f"site_name: gallery\nuse_directory_urls: false\n{hooks}\nextra:\n{execute}\n"
    )
    pages, folder = built(tmp_path, tmp_path / "site", execute="true")
    shown = [
        address
        for address in pages["gallery.html"].loads
        if address.endswith("gallery.html")
    ]
    assert (
        shown == ["assets/gallery.html"]
        and "assets/gallery.html" in pages["gallery.html"].links
    )
    report = (folder / "assets" / "gallery.html").read_text()
    assert (
        '"n_scenes":6' in report
        and '"replay":0' in report
        and tempfile.gettempdir() not in report
    )
