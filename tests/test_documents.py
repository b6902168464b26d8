"""What documents and docstrings name is in the repository: paths, other documents, sections of docs/method.md."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = "benchmarks|conf|docs|e2rl|examples|tests|tools"
PATH = re.compile(rf"(?<![\w./<>-])(?:{FOLDERS})/[\w./<>*{{}}\[\]-]*")
PLACEHOLDER = re.compile(r"[<>*{}\[\]]|\.\.\.|(?<![a-zA-Z])[A-Z]{3,}(?![a-zA-Z])")  # <name>, *, {a,b}, ..., NAME
DOCUMENT = re.compile(r"(?<![\w/])[\w-]+\.md\b")
SECTION = re.compile(r"docs/method\.md, sections? (\d+)(?: to (\d+))?")
WRITTEN = {"tables.md", "methods.md", "egos.md"}  # documents that a run writes


def docstrings(path: Path) -> Iterator[str]:
    """The docstrings of a file's module, classes and functions."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield ast.get_docstring(node) or ""


def texts() -> dict[str, str]:
    """Documents, docstrings and configuration files, by path."""
    documents = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")]
    found = {path: path.read_text() for path in documents if path.exists()}
    found |= {path: path.read_text() for path in (ROOT / "conf").rglob("*.yaml")}
    found |= {path: "\n".join(docstrings(path)) for path in (ROOT / "e2rl").rglob("*.py")}
    return {str(path.relative_to(ROOT)): text for path, text in found.items()}


def named_paths(text: str) -> set[str]:
    """Paths in a text that stand for one file or folder; the full stop of a sentence is not theirs."""
    found = (match.group().rstrip(".") for match in PATH.finditer(text))
    return {path for path in found if not PLACEHOLDER.search(path)}


def test_placeholders_are_no_paths_and_full_stops_end_sentences():
    text = "See docs/a.md. Or (conf/ego/NAME.yaml; e2rl/x_y.py), conf/<group>/<name>.yaml, conf/data/*.yaml, `tests/b`."
    assert named_paths(text) == {"docs/a.md", "e2rl/x_y.py", "tests/b"}
    assert named_paths("e2rl-rollout/1, runs/evaluate/docs/a, https://x.org/docs/a.md") == set()


@pytest.mark.parametrize("name", sorted(texts()))
def test_what_is_named_exists(name):
    text = texts()[name]
    missing = {path for path in named_paths(text) if not (ROOT / path).exists()}
    known = {path.name for folder in (ROOT, ROOT / "docs") for path in folder.glob("*.md")} | WRITTEN
    missing |= set(DOCUMENT.findall(text)) - known
    assert not missing, f"{name} names what is not there: {', '.join(sorted(missing))}"


def test_sections_of_the_method_are_numbered_and_those_cited_exist():
    headings = re.findall(r"^## (\d+)\. ", (ROOT / "docs" / "method.md").read_text(), re.MULTILINE)
    assert headings == [str(number + 1) for number in range(len(headings))]
    cited = {number for text in texts().values() for pair in SECTION.findall(text) for number in pair if number}
    assert cited and cited <= set(headings)
