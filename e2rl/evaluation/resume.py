"""`resume=RUN_DIR`: an interrupted run continues in its own folder with its own configuration.

The folder may be a stranger's. So its configuration may name extensions of e2rl's own only; code from elsewhere, a
command to start, an address to connect to, and an endpoint that would be sent the user's key, take part if the command
line names them, too.
"""

import re
import shlex
import sys
from collections.abc import Collection, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from e2rl.evaluation.provenance import leaves, outside_modules, starting_modules
from e2rl.run.config import Extension
from e2rl.run.errors import InputError

ALWAYS = ("resume", "plugins", ENDPOINT := "synthesizer.reasoner.base_url")  # keys that a command line may hold anyway
CHOICE = re.compile(r"\$\{hydra:runtime\.choices\.(\w+)\}")


class Run(NamedTuple):
    """What a command does: its configuration, its folder, and the file of each group {group: name}."""

    config: DictConfig
    folder: Path
    choices: dict[str, str]


def run_of(config: DictConfig, may_change: Collection[str]) -> Run:
    """The run that the command line asks for: a new one, or `config.resume`, in which may_change are the keys that the
    command line may set anew.

    Raises InputError where there is no run, where its configuration names code that is neither e2rl's nor of the
    modules in the command line's `plugins`, and for settings that cannot change.
    """
    hydra = HydraConfig.get()
    if not config.resume:
        return Run(config, Path(hydra.runtime.output_dir), dict(hydra.runtime.choices))
    folder, where = Path(config.resume).resolve(), f"resume={config.resume}"
    choices = saved_choices(where, folder)
    saved = saved_configuration(config, folder, choices, where)
    given = {item.split("=", 1)[0].lstrip("+~") for item in hydra.overrides.task}
    if wrong := sorted(given - {*may_change, *ALWAYS}):
        free = ", ".join(may_change)
        raise InputError(f"{where}: goes on as it was begun; leave out {', '.join(wrong)} (only {free} can change)")
    for key in given.intersection(may_change):
        saved[key] = config[key]
    saved.plugins, saved.resume = config.plugins, str(folder)
    for left in folder.rglob(".*.part"):  # of a file that was being written at the end
        left.unlink(missing_ok=True)
    return Run(saved, folder, choices)


def saved_configuration(config: DictConfig, folder: Path, choices: dict[str, str], where: str) -> DictConfig:
    """The configuration that the run in `folder` was begun with, checked; config: that of the command line; where: the
    key that names the folder, for messages."""
    saved = read_configuration(config, folder / ".hydra" / "config.yaml", where)
    saved = OmegaConf.create(_with_choices(OmegaConf.to_container(saved), choices))
    check_code(saved, [str(name) for name in config.plugins], where)
    named = {str(value) for key, value in leaves(OmegaConf.to_container(saved)) if key.endswith("base_url") and value}
    if unknown := sorted(named - {str(OmegaConf.select(config, ENDPOINT))}):
        raise InputError(
            f"{where}: its reasoner sends your API key to {', '.join(unknown)}; if that is right, add "
            f"{ENDPOINT}={unknown[0]}"
        )
    return saved


def read_configuration(config: DictConfig, file: Path, where: str) -> DictConfig:
    """The saved configuration of a run, with every key of this version's `config`; InputError for anything else."""
    if not file.is_file():
        raise InputError(f"{where}: no run found ({file} is missing); give the folder that the run printed")
    saved = _yaml(file)
    plain = OmegaConf.to_container(saved)
    if not isinstance(saved, DictConfig) or not isinstance(plain, dict):
        raise InputError(f"{file}: no configuration of a run; give the folder of a run of train.py or evaluate.py")
    if missing := sorted({str(key) for key in config} - set(map(str, plain))):
        reason = "of the other command, of another version, or cut off"
        raise InputError(f"{file}: {reason} ({', '.join(missing)}: missing); give another run, or begin a new one")
    return saved


def saved_choices(where: str, folder: Path) -> dict[str, str]:
    """The file of each group {group: name} that the run in `folder` was begun with."""
    file = folder / ".hydra" / "hydra.yaml"
    if not file.is_file():
        raise InputError(f"{where}: no run found ({file} is missing); give the folder that the run printed")
    plain = OmegaConf.to_container(_yaml(file))
    try:
        assert isinstance(plain, dict)
        return {str(group): str(name) for group, name in plain["hydra"]["runtime"]["choices"].items()}
    except (AssertionError, LookupError, TypeError, AttributeError) as error:
        raise InputError(f"{file}: damaged ({type(error).__name__}); restore it, or begin a new run") from error


def _yaml(file: Path) -> Any:
    try:
        saved = OmegaConf.load(file)
        OmegaConf.to_container(saved)
        return saved
    except (OSError, ValueError, RecursionError, YAMLError, OmegaConfBaseException) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{file}: damaged ({reason}); restore it, or begin a new run") from error


def _with_choices(value: Any, choices: dict[str, str]) -> Any:
    """Nested containers in which references to the file of a group are the names of the run's own files."""
    if isinstance(value, dict):
        return {key: _with_choices(part, choices) for key, part in value.items()}
    if isinstance(value, list):
        return [_with_choices(part, choices) for part in value]
    if not isinstance(value, str):
        return value
    return CHOICE.sub(lambda found: choices.get(found[1], found[0]), value)


def resume_command(config: DictConfig) -> str:
    """The command that goes on with this run, for a shell."""
    script, *arguments = sys.argv
    command = ["python", script] if script.endswith(".py") else [Path(script).name]
    for position, argument in enumerate(arguments):  # further folders of configuration
        if argument.split("=")[0] in ("--config-dir", "-cd"):
            command += [argument] if "=" in argument else arguments[position : position + 2]
    command.append(f"resume={config.resume or HydraConfig.get().runtime.output_dir}")
    if modules := sorted(outside_modules(config)):
        command.append(f"plugins=[{','.join(modules)}]")
    return shlex.join(command)


# --- code that a configuration names


def check_code(config: DictConfig, allowed: list[str], where: str) -> None:
    """InputError where a configuration names code: a `_target_` that is no extension in e2rl, a plugin, or a command or
    an address for an extension, other than of the modules `allowed`."""
    plain = OmegaConf.to_container(config)
    assert isinstance(plain, dict)
    plugins = plain.get("plugins") or []
    if not isinstance(plugins, list):
        raise InputError(f"{where}: its configuration is damaged (plugins: {str(plugins)[:40]}); restore it")
    named = [str(name) for name in plugins]
    named += [target for target in _targets(plain) if not _is_extension(target)]
    named += [text for text in _texts(plain) if "${" in text and ":" in text]  # a resolver: what it makes is unknown
    named += starting_modules(plain)
    outside = [name for name in named if not any(name == own or name.startswith(f"{own}.") for own in allowed)]
    if outside:
        raise InputError(
            f"{where}: its configuration runs code that is no extension of e2rl: {', '.join(sorted(set(outside)))}; if "
            "you trust that code, name its modules: 'plugins=[MODULE]'"
        )


def _targets(value: Any) -> Iterator[str]:
    """Every `_target_` in nested containers, as written; also of changes, whose keys are paths (`ego._target_`)."""
    if isinstance(value, dict):
        yield from (str(part) for key, part in value.items() if "_target_" in str(key))
    for part in _parts(value):
        yield from _targets(part)


def _texts(value: Any) -> Iterator[str]:
    """Every string in nested containers, as written."""
    if isinstance(value, str):
        yield value
    for part in _parts(value):
        yield from _texts(part)


def _parts(value: Any) -> list:
    return [*value, *value.values()] if isinstance(value, dict) else value if isinstance(value, list) else []


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
