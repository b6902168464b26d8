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
MAX_BYTES, MAX_NODES, MAX_DEPTH, MAX_TEXT = (
    1 << 18,
    20_000,
    50,
    1024,
)  # of it; the last of a text that others refer to
REFERENCES = re.compile(
    r"([^$\\]|\$\{[A-Za-z_][\w.]*\})*"
)  # a text that refers to other values and does nothing else
ENDPOINT = "synthesizer.reasoner.base_url"
ALWAYS = (
    "resume",
    "plugins",
    ENDPOINT,
)  # keys that a command line may hold although a run's configuration has them
WRITTEN = (
    "data.cache",
    "data.cache_gb",
    "tuning.study",
    "synthesizer.reasoner.cache",
)  # paths to write, and how much
STARTING = {
    "command": "e2rl.planners.external",
    "address": "e2rl.planners.external",
}  # by a part of the key
PROGRAM, ARITHMETIC = (
    "e2rl.planners.policy_file",
    ".onnx",
)  # other files of policies are programs


def saved_configuration(config: DictConfig, folder: Path, where: str) -> DictConfig:
    """Returns the configuration that the run in `folder` was begun with, checked.
    Raises InputError where it is none, or names what the command line does not.

    Args:
        config: that of the command line: its keys must be there, unless they are null,
            as new options are that an
            earlier version did not have; its plugins and endpoint are trusted.
        where: the option that names the folder, for messages.
    """
    file = folder / CONFIG
    if not file.is_file():
        raise InputError(
            f"{where}: no run found ({file} is missing); give the folder that the run printed"
        )
    check_folder(folder)
    saved = read_yaml(file)
    absent = [str(key) for key in config if key not in saved]
    if missing := sorted(key for key in absent if config[key] is not None):
        reason = "of the other command, of another version, or cut off"
        raise InputError(
            f"{file}: {reason} ({', '.join(missing)}: missing); give another run, or begin a new one"
        )
    saved.update(dict.fromkeys(absent))
    check_code(saved, [str(name) for name in config.plugins], where=where)
    named = {
        str(value)
        for key, value in leaves(OmegaConf.to_container(saved))
        if key.endswith("base_url") and value
    }
    if unknown := sorted(named - {str(OmegaConf.select(config, ENDPOINT))}):
        raise InputError(
            f"{where}: its reasoner sends your API key to {', '.join(unknown)}; if that is right, add "
            f"{ENDPOINT}={unknown[0]}"
        )
    return saved


def read_yaml(file: Path) -> DictConfig:
    """Returns the configuration in CONFIG of a run's folder; InputError where it is
    none, or takes much to read."""
    try:
        text = read_regular(file, MAX_BYTES, within=file.parents[1]).decode()
        _check_size(text)
        saved = OmegaConf.load(io.StringIO(text))
        if not isinstance(saved, DictConfig):
            raise ValueError("no configuration of a run")
        _check_values(OmegaConf.to_container(saved))
        return saved
    except (
        OSError,
        ValueError,
        RecursionError,
        yaml.YAMLError,
        OmegaConfBaseException,
    ) as error:
        said = (
            str(isinstance(error, OSError) and error.strerror or error)
            or type(error).__name__
        )
        reason = said.splitlines()[0]
        raise InputError(
            f"{file}: damaged ({reason}); restore it, or begin a new run"
        ) from error


def _check_size(text: str) -> None:
    """Raises ValueError for YAML that grows as it is read, by aliases, and for what has
    too many or too deep nodes."""
    depth = 0
    for number, event in enumerate(yaml.parse(text, yaml.SafeLoader)):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(
            event, yaml.CollectionEndEvent
        )
        if (
            isinstance(event, yaml.AliasEvent)
            or number > MAX_NODES
            or depth > MAX_DEPTH
        ):
            raise ValueError("aliases, or more than a run's configuration holds")


def _check_values(plain: Any) -> None:
    """Raises ValueError for an endless number, and where a text refers to others by
    more than ${KEY}, or to one that itself refers to others: as few lines as one wants
    grow as they are resolved, and a resolver runs code."""
    for key, value in leaves(plain):
        if isinstance(value, int) and value.bit_length() > 64:
            raise ValueError(f"{key} is an endless number")
        if not isinstance(value, str) or "${" not in value:
            continue
        names = (
            re.findall(r"\$\{(.*?)\}", value) if REFERENCES.fullmatch(value) else [""]
        )
        known = [str(_of(plain, name.split("."))) for name in names]
        if any(len(text) > MAX_TEXT or "$" in text for text in known):
            raise ValueError(f"{key} refers to what refers to others")


def _of(plain: Any, parts: Sequence[str]) -> Any:
    """The value of a dotted key in nested containers; ValueError where it is not there,
    or a container."""
    for part in parts:
        if not isinstance(plain, dict) or part not in plain:
            raise ValueError(
                f"it refers to {'.'.join(parts) or 'more than a key'}, which is not there"
            )
        plain = plain[part]
    if isinstance(plain, dict | list):
        raise ValueError(f"it refers to {'.'.join(parts)}, which is no plain value")
    return plain


def check_written(
    saved: DictConfig, folder: Path, where: str, *trusted: DictConfig
) -> None:
    """Raises InputError where a saved configuration writes outside of its run's folder
    (`written_outside`)."""
    if added := written_outside(saved, folder, *trusted):
        raise InputError(
            f"{where}: its configuration writes outside of its folder; if that is right, add {' '.join(added)}"
        )


def written_outside(saved: DictConfig, folder: Path, *trusted: DictConfig) -> list[str]:
    """Returns the options for Hydra that name where `saved` writes outside of the
    folder, links followed, and how much, other than the trusted configurations."""
    mine = {
        (key.rpartition(".")[2], _place(value))
        for config in trusted
        for key, value in _written(config)
    }
    added = []
    for key, value in _written(saved):
        place = _place(value)
        inside = isinstance(value, str) and leads_into(Path(value), folder)
        if (
            value is not None
            and not inside
            and (key.rpartition(".")[2], place) not in mine
        ):
            added.append(
                assigned(
                    next((name for name in WRITTEN if key.endswith(name)), key), value
                )
            )
    return list(dict.fromkeys(added))


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


def check_code(config: DictConfig, allowed: Sequence[str], where: str) -> None:
    """Raises InputError where a configuration names code: a `_target_` that is no
    extension in e2rl, a plugin, or a command or an address for an extension, other than
    of the modules `allowed`; or another of Hydra's keys."""
    plain = OmegaConf.to_container(config)
    assert isinstance(plain, dict)
    found = list(nodes(plain))
    keys = {part for key, _ in found for part in re.split(r"[.\[\]]", key)}
    if hidden := sorted(
        key for key in keys if key.startswith("_") and key != "_target_"
    ):
        raise InputError(
            f"{where}: its configuration has {', '.join(hidden)}, which no run of e2rl needs; take it out"
        )
    plugins = plain.get("plugins") or []
    if not isinstance(plugins, list):
        raise InputError(
            f"{where}: its configuration is damaged (plugins: {str(plugins)[:40]}); restore it"
        )
    named = [str(name) for name in plugins]
    named += [
        str(target)
        for key, target in found
        if "_target_" in key and not _is_extension(str(target))
    ]
    named += starting_modules(plain)
    outside = [
        name
        for name in named
        if not any(name == own or name.startswith(f"{own}.") for own in allowed)
    ]
    if outside:
        raise InputError(
            f"{where}: its configuration runs code that is no extension of e2rl: {', '.join(sorted(set(outside)))}; if "
            "you trust that code, name its modules: 'plugins=[MODULE]'"
        )


def outside_modules(config: DictConfig) -> set[str]:
    """Returns the modules outside of e2rl that a configuration names, plugins and those
    of `_target_`s, and `starting_modules`."""
    plain = OmegaConf.to_container(config)
    named = {
        str(value).rpartition(".")[0]
        for key, value in leaves(plain)
        if key.endswith("_target_")
    }
    outside = {name for name in named if not name.startswith("e2rl.")} - {""}
    return {str(name) for name in config.plugins} | outside | starting_modules(plain)


def starting_modules(plain: Any) -> set[str]:
    """Returns the modules of e2rl that run a program or connect to an address that
    plain containers name."""
    named = [(key, str(value)) for key, value in leaves(plain) if value]
    found = {
        module for key, _ in named for part, module in STARTING.items() if part in key
    }
    return found | {
        PROGRAM
        for key, value in named
        if "file" in key and not value.endswith(ARITHMETIC)
    }


def leaves(value: Any) -> Iterator[tuple[str, Any]]:
    """(dotted key, value) of every value in nested containers that is no container."""
    return (
        (key, part) for key, part in nodes(value) if not isinstance(part, dict | list)
    )


def nodes(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted key, value) of every value in nested containers, containers included."""
    if isinstance(value, dict | list):
        for name, part in (
            value.items() if isinstance(value, dict) else enumerate(value)
        ):
            below = f"{key}.{name}" if key else str(name)
            yield below, part
            yield from nodes(part, below)


def _is_extension(target: str) -> bool:
    """Whether a class path is that of an Extension where e2rl defines it, not of a name
    that e2rl imports."""
    module, _, name = target.rpartition(".")
    if not module.startswith("e2rl.") or module.startswith(
        "e2rl.scripts"
    ):  # which reaches outside of the package
        return False
    try:
        found = getattr(import_module(module), name)
    except (ImportError, AttributeError, ValueError):
        return False
    return (
        isinstance(found, type)
        and found.__module__ == module
        and issubclass(found, Extension)
    )
