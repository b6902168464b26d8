"""A hint names an installation that works where it is read: e2rl is in no registry."""

import tomllib
from pathlib import Path

import pytest

from e2rl.run import extras
from e2rl.run.config import library
from e2rl.run.errors import InputError
from e2rl.run.extras import how_to_install

ROOT = Path(__file__).parents[2]


def test_a_checkout_is_installed_from_where_it_is(monkeypatch, tmp_path):
    monkeypatch.chdir(ROOT)
    assert how_to_install("commonroad").endswith("pip install -e '.[commonroad]'")
    monkeypatch.chdir(tmp_path)
    assert how_to_install("commonroad").endswith(f"pip install -e '{ROOT}[commonroad]'")


def test_elsewhere_the_libraries_are_named(monkeypatch, tmp_path):
    monkeypatch.setattr(extras, "CHECKOUT", tmp_path)
    metadata = [
        "torch>=2.7",
        'commonroad-io>=1.2; extra == "commonroad"',
        "x<2,>=1 ; extra == 'commonroad'",
        'cma>=4; extra == "optimisers"',
    ]
    monkeypatch.setattr(extras, "requires", lambda name: metadata)
    assert how_to_install("commonroad").endswith(
        "pip install 'commonroad-io>=1.2' 'x<2,>=1'"
    )


def test_a_library_that_is_missing_is_told_with_its_extra(monkeypatch):
    monkeypatch.chdir(ROOT)
    with pytest.raises(
        InputError,
        match=r"--to x: no_such cannot be imported .* pip install -e '\.\[commonroad\]'",
    ):
        library("no_such", "--to x", extra="commonroad")


def test_every_extra_that_the_code_names_is_one():
    certain = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    assert all(how_to_install(extra) for extra in certain)
    for path in (ROOT / "e2rl").rglob("*.py"):
        assert "e2rl[" not in path.read_text(), (
            f"{path}: names an installation that only some have"
        )
