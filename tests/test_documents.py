"""What documents and docstrings name is there: paths, other documents, sections of
docs/method.md, options."""

import ast
import re
import shlex
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from e2rl.run.config import load_config

ROOT = Path(__file__).parents[1]
FOLDERS = "benchmarks|conf|docs|e2rl|examples|tests|tools"
PATH = re.compile(rf"(?<![\w./<>-])(?:{FOLDERS})/[\w./<>*{{}}\[\]-]*")
PLACEHOLDER = re.compile(
    r"[<>*{}\[\]]|\.\.\.|(?<![a-zA-Z])[A-Z]{3,}(?![a-zA-Z])"
)  # <name>, *, {a,b}, ..., NAME
DOCUMENT = re.compile(r"(?<![\w/-])[\w-]+\.md\b")
SECTION = re.compile(r"docs/method\.md, sections? (\d+)(?: to (\d+))?")
WRITTEN = {
    "tables.md",
    "methods.md",
    "egos.md",
    "budget.md",
    "tutorial.md",
}  # documents that a run writes, or the site's build
COMMANDS = r"(?:python|torchrun[^`\n]*?) (?:evaluate|train)\.py|e2rl (?:evaluate|train|tune|prior-tables|skeleton)"
COMMAND = re.compile(rf"({COMMANDS})(?![\w-])((?:\\\n|[^`\n])*)")
EXTENDED = "--config-dir"


def docstrings(path: Path) -> Iterator[str]:
    """The docstrings of a file's module, classes and functions."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(
            node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
        ):
            yield ast.get_docstring(node) or ""


@cache
def texts() -> dict[str, str]:
    """Documents, docstrings and configuration files, by path."""
    documents = [
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
        *(ROOT / "docs").rglob("*.md"),
    ]
    found = {path: path.read_text() for path in documents if path.exists()}
    found |= {path: path.read_text() for path in (ROOT / "conf").rglob("*.yaml")}
    found |= {
        path: "\n".join(docstrings(path)) for path in (ROOT / "e2rl").rglob("*.py")
    }
    return {str(path.relative_to(ROOT)): text for path, text in found.items()}


def named_paths(text: str) -> set[str]:
    """Paths in a text that stand for one file or folder; the full stop of a sentence is
    not theirs."""
    found = (match.group().rstrip(".") for match in PATH.finditer(text))
    return {path for path in found if not PLACEHOLDER.search(path)}


def test_placeholders_are_no_paths_and_full_stops_end_sentences():
    text = "See docs/a.md. Or (conf/ego/NAME.yaml; e2rl/x_y.py), conf/<group>/<name>.yaml, conf/data/*.yaml, `tests/b`."
    assert named_paths(text) == {"docs/a.md", "e2rl/x_y.py", "tests/b"}
    assert (
        named_paths("e2rl-rollout/1, runs/evaluate/docs/a, https://x.org/docs/a.md")
        == set()
    )


@pytest.mark.parametrize("name", sorted(texts()))
def test_what_is_named_exists(name):
    text = texts()[name]
    missing = {path for path in named_paths(text) if not (ROOT / path).exists()}
    known = {
        path.name for path in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"))
    } | WRITTEN
    missing |= set(DOCUMENT.findall(text)) - known
    assert not missing, f"{name} names what is not there: {', '.join(sorted(missing))}"


def test_sections_of_the_method_are_numbered_and_those_cited_exist():
    headings = re.findall(
        r"^## (\d+)\. ", (ROOT / "docs" / "method.md").read_text(), re.MULTILINE
    )
    assert headings == [str(number + 1) for number in range(len(headings))]
    cited = {
        number
        for text in texts().values()
        for pair in SECTION.findall(text)
        for number in pair
        if number
    }
    assert cited and cited <= set(headings)


def is_choice(override: str) -> bool:
    """Whether an override chooses a file of a group of the configuration."""
    return (ROOT / "conf" / override.split("=")[0]).is_dir()


def commands() -> list[tuple[str, tuple[str, ...]]]:
    """The commands of the documents, each a configuration and its overrides; of those
    that differ in values, one."""
    found = {}
    for text in (text for name, text in texts().items() if name.endswith(".md")):
        for command, rest in COMMAND.findall(text):
            name = command.split()[-1].removesuffix(".py").replace("-", "_")
            parts = shlex.split(rest.replace("\\\n", " "), comments=True)
            if any(is_choice(part) and part.endswith("=NAME") for part in parts):
                continue
            parts = [part for part in parts if "..." not in part]
            kinds = frozenset(
                part if is_choice(part) else part.split("=")[0] for part in parts
            )
            found.setdefault((name, kinds), (name, tuple(parts)))
    return sorted(found.values())


@pytest.mark.parametrize(("name", "overrides"), commands())
def test_the_options_of_a_command_exist(name, overrides):
    """Hydra composes them: groups, files and keys are there, in conf/ or where
    --config-dir says."""
    given = list(overrides)
    if EXTENDED in given:
        folder = given.pop(given.index(EXTENDED) + 1)
        given.append(f"hydra.searchpath=[file://{ROOT / folder}]")
    assert load_config(
        name, [part for part in given if not part.startswith("--")]
    ).synthesizer._target_
