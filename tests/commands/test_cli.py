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


CONFIGURED = ["evaluate", "train", "tune"]
SHOW = f"""
import sys
sys.path.insert(0, {str(ROOT)!r})
from hydra.core.global_hydra import GlobalHydra
from e2rl.commands.cli import main
for name in {CONFIGURED}:
    print("COMMAND")
    sys.argv = ["e2rl", name, "--cfg", "job"]
    main()
    GlobalHydra.instance().clear()
"""


@pytest.mark.slow
def test_commands_show_their_configuration_in_an_empty_folder(tmp_path):
    """One after the other in one process."""
    process = subprocess.run(
        [sys.executable, "-c", SHOW],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert process.returncode == 0, process.stderr
    shown = process.stdout.split("COMMAND\n")[1:]
    without = [
        name
        for name, text in zip(CONFIGURED, shown, strict=True)
        if "_target_: e2rl.traffic.e2.e2.E2" not in text
    ]
    assert without == []
