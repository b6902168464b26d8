"""A default stands once, in conf/: neither a class nor a settings dataclass repeats a
key of its YAML file."""

import inspect
from dataclasses import MISSING, fields, is_dataclass
from importlib import import_module
from pathlib import Path

import pytest
from omegaconf import OmegaConf

import e2rl
from e2rl.run.config import CONF, file_values

FILES = sorted(CONF.glob("*/*.yaml"))
OPTIONAL = {
    "commonroad_writer",
    "openscenario",
    "opendrive",
    "mcap_writer",
    "rerun_writer",
    "sumo_writer",
    "gym_env",
    "sb3",
}  # they need libraries of extras
BASES = {
    "path",
    "split",
    "replan_every",
}  # what a source or ego from outside, without a YAML file, inherits


def defaults_of(kind: type) -> set[str]:
    """The names of the arguments that have a default in Python."""
    parameters = inspect.signature(inspect.unwrap(kind.__init__)).parameters.values()
    return {item.name for item in parameters if item.default is not item.empty}


@pytest.mark.parametrize(
    "file", FILES, ids=lambda file: f"{file.parent.name}={file.stem}"
)
def test_what_a_file_builds_has_no_default_for_its_keys(file):
    target = OmegaConf.load(file).get("_target_")
    if target is None:
        pytest.skip("builds nothing itself")
    module, _, name = target.rpartition(".")
    keys = set(file_values(f"{file.parent.name}/{file.stem}")) - BASES
    assert not defaults_of(getattr(import_module(module), name)) & keys


def test_settings_dataclasses_have_no_defaults():
    root = Path(e2rl.__file__).parent
    result = 0
    for path in root.rglob("*.py"):
        if path.parent.name in ("scripts", "commands") or path.stem.startswith("__"):
            continue
        try:
            module = import_module(
                ".".join(("e2rl", *path.relative_to(root).with_suffix("").parts))
            )
        except ModuleNotFoundError:
            assert path.stem in OPTIONAL, f"{path}: it needs the library of an extra"
            continue
        ours = [
            kind
            for kind in vars(module).values()
            if isinstance(kind, type) and kind.__module__ == module.__name__
        ]
        for kind in (
            kind
            for kind in ours
            if "__configured__" in vars(kind) and is_dataclass(kind)
        ):
            certain = file_values(*kind.__configured__).keys() - BASES
            twice = {
                item.name
                for item in fields(kind)
                if item.name in certain and item.default is not MISSING
            }
            assert not twice, f"{kind.__name__}: {', '.join(sorted(twice))}"
            result += 1
    assert result > 20
