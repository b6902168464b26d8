"""The example workflow's commands run as they stand, on fewer scenes, and write what it
keeps."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_the_workflow_drives_and_gates(tmp_path):
    text = (
        (ROOT / "examples" / "ci" / "github-workflow.yml")
        .read_text()
        .replace("runs/gate", str(tmp_path))
    )
    steps = {
        step["name"]: step
        for step in yaml.safe_load(text)["jobs"]["gate"]["steps"]
        if "name" in step
    }
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    processes = [
        subprocess.run(
            ["bash", "-ec", steps[name]["run"] + overrides],
            cwd=ROOT,
            env=os.environ | {"PATH": path, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            timeout=600,
        )
        for name, overrides in (
            ("drive", " num_scenes=3 processes=1 prior.sampler.steps=2"),
            ("gate", ""),
        )
    ]
    assert [process.returncode for process in processes] == [0, 3], (
        processes[-1].stderr + processes[0].stderr
    )
    assert "an interval needs 10" in processes[1].stdout
    paths = steps["keep what was found"]["with"]["path"].split()
    assert len(paths) == 3
    assert all(Path(path).is_file() for path in paths if not path.endswith(".html"))
