"""One command `e2rl`: it lists what there is, knows its version, and finds its modules
from any folder."""

import subprocess
import sys
import tomllib
from importlib.util import find_spec
from pathlib import Path

import pytest

from e2rl.commands import cli
from e2rl.commands.cli import COMMANDS, EXAMPLES, main

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def said(monkeypatch, capsys, *arguments):
    monkeypatch.setattr(sys, "argv", ["e2rl", *arguments])
    main()
    return capsys.readouterr().out


def test_help_version_and_the_nearest_command(monkeypatch, capsys):
    text = said(monkeypatch, capsys, "--help")
    assert text == said(monkeypatch, capsys)
    assert all(name in text for name in COMMANDS)
    assert {
        line.split()[1] for line in EXAMPLES.splitlines() if line.startswith("  e2rl ")
    } <= set(COMMANDS)
    assert (
        said(monkeypatch, capsys, "--version").strip() == f"e2rl {PROJECT['version']}"
    )
    with pytest.raises(SystemExit) as stopped:
        said(monkeypatch, capsys, "evalute")
    assert stopped.value.code == 2
    assert "did you mean evaluate?" in capsys.readouterr().err


def test_every_command_is_a_module_with_a_main():
    for module, _ in COMMANDS.values():
        spec = find_spec(module)
        assert spec is not None
        assert "def main(" in Path(spec.origin).read_text(), module
    assert PROJECT["scripts"] == {"e2rl": f"{cli.__name__}:main"}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["evaluate", "train", "tune"])
def test_a_command_shows_its_configuration_in_an_empty_folder(name, tmp_path):
    code = f"import sys; sys.path.insert(0, {str(ROOT)!r})\n"
    code += "from e2rl.commands.cli import main; main()"
    command = [sys.executable, "-c", code, name, "--cfg", "job"]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0
    assert "_target_: e2rl.traffic.e2.e2.E2" in done.stdout, done.stderr
