"""The console commands find their modules and configuration from any folder."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]


@pytest.mark.parametrize("name", sorted(SCRIPTS))
def test_a_console_command_shows_its_configuration_in_an_empty_folder(name, tmp_path):
    module, function = SCRIPTS[name].split(":")
    code = f"import sys; sys.path.insert(0, {str(ROOT)!r}); from {module} import {function}; {function}()"
    done = subprocess.run(
        [sys.executable, "-c", code, "--cfg", "job"], cwd=tmp_path, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0 and "_target_: e2rl.traffic.e2.e2.E2" in done.stdout, done.stderr
