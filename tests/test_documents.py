"""What documents and docstrings name is there: paths, pages, anchors, commands and
their options. Documents keep within their limits."""

import ast
import importlib
import json
import re
import shlex
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from e2rl.commands.cli import COMMANDS as CLI_COMMANDS
from e2rl.run.config import load_config

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
FOLDERS = "benchmarks|conf|docs|e2rl|examples|tests|tools"
PATH = re.compile(rf"(?<![\w./<>-])(?:{FOLDERS})/[\w./<>*{{}}\[\]-]*")
# <name>, *, {a,b}, ..., NAME
PLACEHOLDER = re.compile(r"[<>*{}\[\]]|\.\.\.|(?<![a-zA-Z])[A-Z]{3,}(?![a-zA-Z])")
DOCUMENT = re.compile(r"(?<![\w/-])[\w-]+\.md\b")
WRITTEN = {"tables.md", "methods.md", "egos.md", "rates.md", "cross.md"}  # by a run
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
BARE = re.compile(r"`(\w+\.py)\b")
YOURS = {"my_planner.py", "FILE.py"}  # a reader's files
FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
PYTHON = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)
# The commands of e2rl that have a configuration.
HYDRA = "evaluate|train|tune|cross"
COMMAND = re.compile(
    rf"(python (?:evaluate|train)\.py|e2rl (?:{HYDRA}))(?![\w-])"
    r"((?:\\\n|[^`\n])*)"
)
CODE = re.compile(r"^```.*?^```$|`[^`\n]+`|^ {4}.+$", re.MULTILINE | re.DOTALL)
SUBCOMMAND = re.compile(r"^(?:`| *)e2rl ([a-z][\w-]*)", re.MULTILINE)
EXTENDED = "--config-dir"


def pages() -> list[Path]:
    """The pages of the site: Markdown and the notebook."""
    return sorted([*DOCS.rglob("*.md"), *DOCS.rglob("*.ipynb")])


def documents() -> list[Path]:
    """The repository's texts: README and the like, and the pages."""
    return [*sorted(ROOT.glob("*.md")), ROOT / "examples" / "README.md", *pages()]


def markdown() -> list[Path]:
    """The documents in Markdown."""
    return [path for path in documents() if path.suffix == ".md"]


def docstrings(path: Path) -> Iterator[str]:
    """The docstrings of a file's module, classes and functions."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(
            node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
        ):
            yield ast.get_docstring(node) or ""


def text_files() -> list[str]:
    """Documents, modules and configuration files."""
    files = [
        *documents(),
        *(ROOT / "conf").rglob("*.yaml"),
        *(ROOT / "e2rl").rglob("*.py"),
    ]
    return sorted(str(path.relative_to(ROOT)) for path in files)


def text_of(path: Path) -> str:
    """What a file says: of a module its docstrings."""
    return "\n".join(docstrings(path)) if path.suffix == ".py" else path.read_text()


def named_paths(text: str) -> set[str]:
    """Paths in a text that stand for one file or folder; the full stop of a sentence is
    not theirs."""
    result = (match.group().rstrip(".") for match in PATH.finditer(text))
    return {path for path in result if not PLACEHOLDER.search(path)}


@cache
def python_files() -> set[str]:
    """Names of the repository's Python files."""
    folders = [ROOT / name for name in FOLDERS.split("|")]
    inside = [path for folder in folders for path in folder.rglob("*.py")]
    return {path.name for path in [*ROOT.glob("*.py"), *inside]}


def anchors(path: Path) -> set[str]:
    """The anchors of a document's headings, as code hosts and the site make them."""
    text = FENCE.sub("", path.read_text())
    return {
        re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-")
        for heading in HEADING.findall(text)
    }


def test_placeholders_are_no_paths_and_full_stops_end_sentences():
    text = (
        "See docs/a.md. Or (conf/ego/NAME.yaml; e2rl/x_y.py), "
        "conf/<group>/<name>.yaml, conf/data/*.yaml, `tests/b`."
    )
    assert named_paths(text) == {"docs/a.md", "e2rl/x_y.py", "tests/b"}
    elsewhere = "e2rl-rollout/1, runs/evaluate/docs/a, https://x.org/docs/a.md"
    assert named_paths(elsewhere) == set()


def test_there_are_at_most_35_pages():
    assert len(pages()) <= 35


def test_the_pages_have_at_most_200_kilobytes():
    assert sum(path.stat().st_size for path in pages()) <= 200_000


def test_the_pages_lie_in_three_folders():
    folders = {path.parent.name for path in pages() if path.parent != DOCS}
    assert folders == {"guide", "results", "reference"}


def test_beside_the_folders_lie_the_first_page_and_the_notebook():
    beside = {path.name for path in pages() if path.parent == DOCS}
    assert beside == {"index.md", "tutorial.ipynb"}


def test_the_readme_has_at_most_120_lines():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 120


def test_the_readme_has_at_most_120_columns():
    assert max(map(len, (ROOT / "README.md").read_text().splitlines())) <= 120


def test_the_changelog_has_at_most_40_lines():
    assert len((ROOT / "CHANGELOG.md").read_text().splitlines()) <= 40


def test_notes_of_what_did_not_help_have_at_most_12_kilobytes():
    assert (DOCS / "results" / "did-not-help.md").stat().st_size <= 12_000


ROOMS = sorted(
    path.parent.name
    for path in (ROOT / "e2rl").glob("*/__init__.py")
    if path.parent.name != "scripts"
)


@pytest.mark.parametrize("room", ROOMS)
def test_every_room_is_on_an_api_page(room):
    text = "".join(path.read_text() for path in (DOCS / "reference").glob("api*.md"))
    assert f"\n::: e2rl.{room}\n" in text


@pytest.mark.parametrize("room", ROOMS)
def test_every_room_is_on_the_map(room):
    assert f"| `{room}` |" in (ROOT / "CONTRIBUTING.md").read_text()


@pytest.mark.parametrize("path", markdown(), ids=lambda path: path.name)
def test_relative_links_lead_to_a_file_and_a_heading(path):
    broken = []
    for link in LINK.findall(FENCE.sub("", path.read_text())):
        if "://" in link:
            continue
        name, _, anchor = link.partition("#")
        target = (path.parent / name).resolve() if name else path
        if not target.exists() or anchor and anchor not in anchors(target):
            broken.append(link)
    assert not broken, f"{path.relative_to(ROOT)}: {', '.join(broken)}"


@pytest.mark.parametrize("name", text_files())
def test_what_is_named_exists(name):
    text = text_of(ROOT / name)
    missing = {path for path in named_paths(text) if not (ROOT / path).exists()}
    certain = {path.name for path in documents()} | WRITTEN
    missing |= set(DOCUMENT.findall(text)) - certain
    assert not missing, f"{name} names what is not there: {', '.join(sorted(missing))}"


@pytest.mark.parametrize("path", markdown(), ids=lambda path: path.name)
def test_a_python_file_that_is_named_without_its_folder_exists(path):
    names = set(BARE.findall(FENCE.sub("", path.read_text())))
    assert names <= python_files() | YOURS


@pytest.mark.parametrize("path", markdown(), ids=lambda path: path.name)
def test_python_of_a_document_imports_what_exists(path):
    for block in PYTHON.findall(path.read_text()):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and node.module.startswith("e2rl"):
                module = importlib.import_module(node.module)
                absent = [
                    item.name for item in node.names if not hasattr(module, item.name)
                ]
                assert not absent, f"{node.module} has no {absent}"


@pytest.mark.parametrize("path", markdown(), ids=lambda path: path.name)
def test_commands_of_a_document_exist(path):
    assert subcommands(path.read_text()) <= set(CLI_COMMANDS)


def subcommands(text: str) -> set[str]:
    """The commands of e2rl in a text's code."""
    code = [match.group() for match in CODE.finditer(text)]
    return {name for piece in code for name in SUBCOMMAND.findall(piece)}


def is_choice(override: str) -> bool:
    """Whether an override chooses a file of a group of the configuration."""
    return (ROOT / "conf" / override.split("=")[0]).is_dir()


def commands() -> list[tuple[str, tuple[str, ...]]]:
    """The commands of the documents, each a configuration and its overrides; of those
    that differ in values, one."""
    result = {}
    for path in markdown():
        for command, rest in COMMAND.findall(path.read_text()):
            name = command.split()[-1].removesuffix(".py").replace("-", "_")
            parts = shlex.split(rest.replace("\\\n", " "), comments=True)
            if any(is_choice(part) and part.endswith("=NAME") for part in parts):
                continue
            parts = [part for part in parts if "..." not in part]
            kinds = frozenset(
                part if is_choice(part) else part.split("=")[0] for part in parts
            )
            result.setdefault((name, kinds), (name, tuple(parts)))
    return sorted(result.values())


@pytest.mark.parametrize(("name", "overrides"), commands())
def test_the_options_of_a_command_exist(name, overrides):
    """Hydra composes them: groups, files and keys are there, in conf/ or where
    --config-dir says."""
    options = list(overrides)
    if EXTENDED in options:
        folder = options.pop(options.index(EXTENDED) + 1)
        options.append(f"hydra.searchpath=[file://{ROOT / folder}]")
    options = [option for option in options if not option.startswith("-")]
    assert load_config(name, options).synthesizer._target_


def test_the_notebook_names_commands_that_exist():
    cells = json.loads((DOCS / "tutorial.ipynb").read_text())["cells"]
    text = "\n".join("".join(cell["source"]) for cell in cells)
    assert subcommands(text) <= set(CLI_COMMANDS)
