"""What a release needs: one version, and a workflow whose commands are there."""

import re
import tomllib
from importlib.metadata import version
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[2]
WORKFLOW = ROOT / ".github" / "workflows" / "release.yml"


def test_one_version_stands_everywhere():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    cited = re.search(r"version = \{(.*?)\}", (ROOT / "README.md").read_text())
    newest = re.search(r"^## (.*)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert project["version"] == cited[1] == newest[1] == version("e2rl")


def test_only_what_was_checked_is_published_and_only_that_job_may():
    workflow = yaml.safe_load(WORKFLOW.read_text())
    build, publish = workflow["jobs"]["build"], workflow["jobs"]["publish"]
    assert publish["needs"] == "build"
    assert workflow["permissions"] == {"contents": "read"}
    assert publish["permissions"] == {"id-token": "write"}
    commands = [step["run"] for step in build["steps"] if "run" in step]
    assert (ROOT / commands[-1]).stat().st_mode & 0o111
