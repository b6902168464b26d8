"""The configuration that a run was begun with, read from its folder, which may be a
stranger's.

It may name extensions of e2rl's own only. Code from elsewhere, a command to start, an
address to connect to, an endpoint that would be sent the user's key, and a path outside
of the folder that would be written to take part if the command line names them, too.
"""

import io
import os
import re
from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from e2rl.run.config import Extension, assigned
from e2rl.run.errors import InputError
from e2rl.run.files import check_folder, leads_into, read_regular

CONFIG = Path(".hydra", "config.yaml")  # of a run's folder
MAX_BYTES = 1 << 18  # of it
MAX_NODES = 20_000
MAX_DEPTH = 50
MAX_TEXT = 1024  # characters of a text that others refer to
# a text that refers to other values and does nothing else
REFERENCES = re.compile(r"(?:[^$\\]|\$\{([A-Za-z_][\w.]*)\})*")
REFERENCE = re.compile(r"\$\{(.*?)\}")
ENDPOINT = "synthesizer.reasoner.base_url"
# keys that a command line may hold although a run's configuration has them
ALWAYS = ("resume", "plugins", ENDPOINT)
# paths to write, and how much
WRITTEN = (
    "data.cache",
    "data.cache_gb",
    "tuning.study",
    "synthesizer.reasoner.cache",
)
EXTERNAL = "e2rl.planners.external"  # starts a command or connects to an address
PROGRAM = "e2rl.planners.policy_file"  # runs files of policies, which are programs


def saved_configuration(config: DictConfig, folder: Path, where: str) -> DictConfig:
    """Returns the configuration that the run in `folder` was begun with, checked.

    Args:
        config: that of the command line: its keys must be there, unless they are null,
            as new options are; its plugins and endpoint are trusted.
        folder: of the run.
        where: the option that names the folder, for messages.

    Raises:
        InputError: where it is none, or names what the command line does not.
    """
    file = folder / CONFIG
    if not file.is_file():
        raise InputError(
            f"{where}: no run found ({file} is missing); give the folder that the run "
            "printed"
        )
    check_folder(folder)
    saved = read_yaml(file)
    absent = [str(key) for key in config if key not in saved]
    if missing := sorted(key for key in absent if config[key] is not None):
        raise InputError(
            f"{file}: of the other command, of another version, or cut off "
            f"({', '.join(missing)}: missing); give another run, or begin a new one"
        )
    saved.update(dict.fromkeys(absent))
    check_code(saved, [str(name) for name in config.plugins], where=where)
    trusted = OmegaConf.select(config, ENDPOINT)
    for key, value in leaves(OmegaConf.to_container(saved)):
        if key.endswith("base_url") and value and value != trusted:
            raise InputError(
                f"{where}: its reasoner sends your API key to {value}; if that is "
                f"right, add {ENDPOINT}={value}"
            )
    return saved


def read_yaml(file: Path) -> DictConfig:
    """Returns the configuration in CONFIG of a run's folder; InputError where it is
    none, or takes much to read."""
    try:
        text = read_regular(file, MAX_BYTES, within=file.parents[1]).decode()
        check_size(text)
        saved = OmegaConf.load(io.StringIO(text))
        if not isinstance(saved, DictConfig):
            raise ValueError("no configuration of a run")
        check_references(saved)
        return saved
    except (
        OSError,
        ValueError,
        RecursionError,
        yaml.YAMLError,
        OmegaConfBaseException,
    ) as error:
        text = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise InputError(
            f"{file}: damaged ({text.splitlines()[0]}); restore it, or begin a new run"
        ) from error


def check_size(text: str) -> None:
    """Raises ValueError for YAML that grows as it is read, by aliases, and for what is
    too long or too deep."""
    depth = 0
    for number, event in enumerate(yaml.parse(text, yaml.SafeLoader)):
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        large = number > MAX_NODES or depth > MAX_DEPTH
        if isinstance(event, yaml.AliasEvent) or large:
            raise ValueError("aliases, or more than a run's configuration holds")


def check_references(saved: DictConfig) -> None:
    """Raises ValueError for an endless number, and where a text refers to others by
    more than ${KEY}, or to one that itself refers to others or is long: a few such
    lines grow as they are resolved, and a resolver runs code."""
    values = dict(leaves(OmegaConf.to_container(saved)))
    for key, value in values.items():
        if isinstance(value, int) and value.bit_length() > 64:
            raise ValueError(f"{key} is an endless number")
        if not isinstance(value, str) or "${" not in value:
            continue
        if not REFERENCES.fullmatch(value):
            raise ValueError(f"{key} refers to more than a key")
        for name in REFERENCE.findall(value):
            if name not in values:
                raise ValueError(f"{key} refers to {name}, which is no plain value")
            text = str(values[name])
            if "$" in text or len(text) > MAX_TEXT:
                raise ValueError(f"{key} refers to what refers to others")


# --- paths that would be written


def check_written(
    saved: DictConfig, folder: Path, where: str, *trusted: DictConfig
) -> None:
    """Raises InputError where a saved configuration writes outside of its run's folder
    (`written_outside`)."""
    if added := written_outside(saved, folder, *trusted):
        raise InputError(
            f"{where}: its configuration writes outside of its folder; if that is "
            f"right, add {' '.join(added)}"
        )


def written_outside(saved: DictConfig, folder: Path, *trusted: DictConfig) -> list[str]:
    """Returns the options for Hydra that name where `saved` writes outside of the
    folder, links followed, and how much, other than the trusted configurations."""
    hashes = {
        (key.rpartition(".")[2], _place(value))
        for config in trusted
        for key, value in _written(config)
    }
    options = []
    for key, value in _written(saved):
        inside = isinstance(value, str) and leads_into(Path(value), folder)
        trusted_value = (key.rpartition(".")[2], _place(value)) in hashes
        if value is not None and not inside and not trusted_value:
            name = next((name for name in WRITTEN if key.endswith(name)), key)
            options.append(assigned(name, value))
    return list(dict.fromkeys(options))


def _place(value: Any) -> Any:
    return os.path.realpath(value) if isinstance(value, str) else value


def _written(config: DictConfig) -> Iterator[tuple[str, Any]]:
    """(dotted key, value) wherever a configuration has a key as WRITTEN has them,
    perhaps as a change of a variant."""
    names = {name.rpartition(".")[2] for name in WRITTEN}
    for key, value in leaves(OmegaConf.to_container(config, resolve=True)):
        parts = re.split(r"[.\[\]]+", key)
        if names.intersection(parts):
            yield ".".join(filter(None, parts)), value


# --- code


def check_code(config: DictConfig, allowed: Sequence[str], where: str) -> None:
    """Raises InputError where a configuration names code: a `_target_` that is no
    extension in e2rl, a plugin, or a command or an address for an extension, other than
    of the modules `allowed`; or another of Hydra's keys."""
    plain: Any = OmegaConf.to_container(config)
    parts = {part for key, _ in nodes(plain) for part in re.split(r"[.\[\]]", key)}
    hidden = [part for part in parts if part.startswith("_") and part != "_target_"]
    if hidden:
        raise InputError(
            f"{where}: its configuration has {', '.join(sorted(hidden))}, which no run "
            "of e2rl needs; take it out"
        )
    plugins = plain.get("plugins") or []
    if not isinstance(plugins, list):
        raise InputError(
            f"{where}: its configuration is damaged (plugins: {str(plugins)[:40]}); "
            "restore it"
        )
    named = set(map(str, plugins)) | starting_modules(plain)
    for key, target in nodes(plain):
        if "_target_" in key and not is_extension(str(target)):
            named.add(str(target))
    outside = [
        name
        for name in sorted(named)
        if not any(f"{name}.".startswith(f"{module}.") for module in allowed)
    ]
    if outside:
        raise InputError(
            f"{where}: its configuration runs code that is no extension of e2rl: "
            f"{', '.join(outside)}; if you trust that code, name its modules: "
            "'plugins=[MODULE]'"
        )


def outside_modules(config: DictConfig) -> set[str]:
    """Returns the modules outside of e2rl that a configuration names, plugins and those
    of `_target_`s, and `starting_modules`."""
    plain = OmegaConf.to_container(config)
    modules = set(map(str, config.plugins)) | starting_modules(plain)
    for key, value in leaves(plain):
        module = str(value).rpartition(".")[0]
        if key.endswith("_target_") and module and not module.startswith("e2rl."):
            modules.add(module)
    return modules


def starting_modules(plain: Any) -> set[str]:
    """Returns the modules of e2rl that run a program or connect to an address that
    plain containers name."""
    modules = set()
    for key, value in leaves(plain):
        if value and ("command" in key or "address" in key):
            modules.add(EXTERNAL)
        if value and "file" in key:
            modules.add(PROGRAM)
    return modules


def is_extension(target: str) -> bool:
    """Returns whether a class path is that of an Extension where e2rl defines it, not
    of a name that e2rl imports."""
    module, _, name = target.rpartition(".")
    # e2rl.scripts reaches outside of the package
    if not module.startswith("e2rl.") or module.startswith("e2rl.scripts"):
        return False
    try:
        kind = getattr(import_module(module), name)
    except (ImportError, AttributeError, ValueError):
        return False
    defined = isinstance(kind, type) and kind.__module__ == module
    return defined and issubclass(kind, Extension)


# --- nested containers


def leaves(value: Any) -> Iterator[tuple[str, Any]]:
    """Yields (dotted key, value) of every value in nested containers that is no
    container."""
    for key, part in nodes(value):
        if not isinstance(part, dict | list):
            yield key, part


def nodes(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Yields (dotted key, value) of every value in nested containers, containers
    included."""
    if isinstance(value, dict):
        parts = list(value.items())
    elif isinstance(value, list):
        parts = list(enumerate(value))
    else:
        return
    for name, part in parts:
        below = f"{key}.{name}" if key else str(name)
        yield below, part
        yield from nodes(part, below)
