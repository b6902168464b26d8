"""The list of licences names every dependency, and reads what packages say of theirs."""

import re
import tomllib
from email.message import Message
from pathlib import Path

import pytest

pytest.importorskip("packaging")

from packaging.requirements import Requirement  # noqa: E402
from packaging.utils import canonicalize_name  # noqa: E402

from tools.licences import licence_of  # noqa: E402

ROOT = Path(__file__).parents[2]


def test_the_document_names_every_dependency():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    groups = {"": project["dependencies"], **project["optional-dependencies"]}
    text = (ROOT / "docs" / "licences.md").read_text()
    for group, requirements in groups.items():
        names = {canonicalize_name(Requirement(each).name) for each in requirements} - {"e2rl"}
        missing = {name for name in names if not re.search(rf"(?<![\w-]){re.escape(name)}(?![\w-])", text)}
        assert not missing, f"docs/licences.md lacks {missing} of {group or 'the package'}; python tools/licences.py"
    always = text.split("## Extra")[0]
    assert "not named" not in always and "GPL" not in re.sub("LGPL", "", always)


class Package:
    version = "1"

    def read_text(self, name):
        return "\nMIT License\n\nText" if name == "licenses/LICENSE" else None

    def __init__(self, **fields):
        self.metadata = Message()
        for key, values in fields.items():
            for value in values if isinstance(values, list) else [values]:
                self.metadata[key.replace("_", "-")] = value


@pytest.mark.parametrize(
    ("fields", "licence"),
    [
        ({"License_Expression": "MIT", "License": "other"}, "MIT"),
        ({"License": "Copyright 2020\n" + 80 * "x", "Classifier": ["License :: OSI Approved :: ISC", "X"]}, "ISC"),
        ({"License_File": ["LICENSE"]}, "MIT License"),
        ({}, "not named"),
    ],
)
def test_a_licence_is_the_shortest_that_the_metadata_says(fields, licence):
    assert licence_of(Package(**fields)) == licence
