"""The configuration that a run was begun with, read from its folder, which may be a stranger's.

It may name extensions of e2rl's own only. Code from elsewhere, a command to start, an address to connect to, and an
endpoint that would be sent the user's key take part if the command line names them, too.
"""

import re
from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from e2rl.run.config import Extension
from e2rl.run.errors import InputError

CONFIG = Path(".hydra", "config.yaml")  # of a run's folder
ENDPOINT = "synthesizer.reasoner.base_url"
STARTING = {"command": "e2rl.planners.external", "address": "e2rl.planners.external"}  # by a part of the key
PROGRAM, ARITHMETIC = "e2rl.planners.policy_file", ".onnx"  # other files of policies are programs


def saved_configuration(config: DictConfig, folder: Path, where: str) -> DictConfig:
    """Returns the configuration that the run in `folder` was begun with, checked.

    Args:
        config: that of the command line: its keys must be there; its plugins and endpoint are trusted.
        where: the option that names the folder, for messages.

    Raises:
        InputError: where it is none, or names what the command line does not.
    """
    file = folder / CONFIG
    if not file.is_file():
        raise InputError(f"{where}: no run found ({file} is missing); give the folder that the run printed")
    saved = read_yaml(file)
    plain = OmegaConf.to_container(saved)
    if not isinstance(saved, DictConfig) or not isinstance(plain, dict):
        raise InputError(f"{file}: no configuration of a run; give the folder of a run")
    if missing := sorted({str(key) for key in config} - set(map(str, plain))):
        reason = "of the other command, of another version, or cut off"
        raise InputError(f"{file}: {reason} ({', '.join(missing)}: missing); give another run, or begin a new one")
    check_code(saved, [str(name) for name in config.plugins], where)
    named = {str(value) for key, value in leaves(plain) if key.endswith("base_url") and value}
    if unknown := sorted(named - {str(OmegaConf.select(config, ENDPOINT))}):
        raise InputError(
            f"{where}: its reasoner sends your API key to {', '.join(unknown)}; if that is right, add "
            f"{ENDPOINT}={unknown[0]}"
        )
    return saved


def read_yaml(file: Path) -> Any:
    """Returns the configuration in a file of a run; InputError where it cannot be read."""
    try:
        saved = OmegaConf.load(file)
        OmegaConf.to_container(saved)
        return saved
    except (OSError, ValueError, RecursionError, YAMLError, OmegaConfBaseException) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{file}: damaged ({reason}); restore it, or begin a new run") from error


def check_code(config: DictConfig, allowed: Sequence[str], where: str) -> None:
    """Raises InputError where a configuration names code: a `_target_` that is no extension in e2rl, a plugin, or a
    command or an address for an extension, other than of the modules `allowed`; or another of Hydra's keys."""
    plain = OmegaConf.to_container(config)
    assert isinstance(plain, dict)
    nodes = list(_nodes(plain))
    keys = {part for key, _ in nodes for part in re.split(r"[.\[\]]", key)}
    if hidden := sorted(key for key in keys if key.startswith("_") and key != "_target_"):
        raise InputError(f"{where}: its configuration has {', '.join(hidden)}, which no run of e2rl needs; take it out")
    plugins = plain.get("plugins") or []
    if not isinstance(plugins, list):
        raise InputError(f"{where}: its configuration is damaged (plugins: {str(plugins)[:40]}); restore it")
    named = [str(name) for name in plugins]
    named += [str(target) for key, target in nodes if "_target_" in key and not _is_extension(str(target))]
    texts = [text for node in nodes for text in node if isinstance(text, str)]
    named += [text for text in texts if "${" in text and ":" in text]  # a resolver: what it makes is unknown
    named += starting_modules(plain)
    outside = [name for name in named if not any(name == own or name.startswith(f"{own}.") for own in allowed)]
    if outside:
        raise InputError(
            f"{where}: its configuration runs code that is no extension of e2rl: {', '.join(sorted(set(outside)))}; if "
            "you trust that code, name its modules: 'plugins=[MODULE]'"
        )


def outside_modules(config: DictConfig) -> set[str]:
    """Returns the modules outside of e2rl that a configuration names, plugins and those of `_target_`s, and
    `starting_modules`."""
    plain = OmegaConf.to_container(config)
    named = {str(value).rpartition(".")[0] for key, value in leaves(plain) if key.endswith("_target_")}
    outside = {name for name in named if not name.startswith("e2rl.")} - {""}
    return {str(name) for name in config.plugins} | outside | starting_modules(plain)


def starting_modules(plain: Any) -> set[str]:
    """Returns the modules of e2rl that run a program or connect to an address that plain containers name."""
    named = [(key, str(value)) for key, value in leaves(plain) if value]
    found = {module for key, _ in named for part, module in STARTING.items() if part in key}
    return found | {PROGRAM for key, value in named if "file" in key and not value.endswith(ARITHMETIC)}


def leaves(value: Any) -> Iterator[tuple[str, Any]]:
    """(dotted key, value) of every value in nested containers that is no container."""
    return ((key, part) for key, part in _nodes(value) if not isinstance(part, dict | list))


def _nodes(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted key, value) of every value in nested containers, containers included."""
    if isinstance(value, dict | list):
        for name, part in value.items() if isinstance(value, dict) else enumerate(value):
            below = f"{key}.{name}" if key else str(name)
            yield below, part
            yield from _nodes(part, below)


def _is_extension(target: str) -> bool:
    """Whether a class path is that of an Extension where e2rl defines it, not of a name that e2rl imports."""
    module, _, name = target.rpartition(".")
    if not module.startswith("e2rl.") or module.startswith("e2rl.scripts"):  # which reaches outside of the package
        return False
    try:
        found = getattr(import_module(module), name)
    except (ImportError, AttributeError, ValueError):
        return False
    return isinstance(found, type) and found.__module__ == module and issubclass(found, Extension)
