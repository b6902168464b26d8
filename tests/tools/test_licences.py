"""The list of licences names every dependency."""

import re
import tomllib
from pathlib import Path

import pytest

pytest.importorskip("packaging")

from packaging.requirements import Requirement  # noqa: E402
from packaging.utils import canonicalize_name  # noqa: E402

ROOT = Path(__file__).parents[2]


def test_the_document_names_every_dependency():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    groups = {"": project["dependencies"], **project["optional-dependencies"]}
    text = (ROOT / "docs" / "reference" / "licences.md").read_text()
    for group, requirements in groups.items():
        names = {canonicalize_name(Requirement(item).name) for item in requirements} - {
            "e2rl"
        }
        missing = {
            name
            for name in names
            if not re.search(rf"(?<![\w-]){re.escape(name)}(?![\w-])", text)
        }
        assert not missing, (
            f"docs/reference/licences.md lacks {missing} of {group or 'the package'}"
        )
    always = text.split("## Extra")[0]
    assert "not named" not in always
    assert "GPL" not in re.sub("LGPL", "", always)
