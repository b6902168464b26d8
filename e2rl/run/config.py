"""The configuration: files of conf/, what they build, and a command line with `--help` and the nearest right name."""

import os
import random
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, InstantiationException
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from e2rl.run.endings import ending, program
from e2rl.run.errors import InputError
from e2rl.run.settings import conf_folder

CHOICE = re.compile(r"[\w+-][\w.+-]*(/[\w+-][\w.+-]*)*")  # a file's name in a group
OPTION = re.compile(r"(?P<added>\+{0,2})(?P<key>[\w./-]+)=(?P<value>.*)", re.DOTALL)
ALIKE = 0.8  # similarity from which an added key is taken for a mistyped one


@contextmanager
def _hydra() -> Iterator[GlobalHydra]:
    """Hydra of the running script, or else one that reads conf/."""
    if GlobalHydra.instance().is_initialized():
        yield GlobalHydra.instance()
        return
    with initialize_config_dir(str(conf_folder().resolve()), version_base="1.3"):
        yield GlobalHydra.instance()


def load_config(name: str = "evaluate", overrides: Sequence[str] = ()) -> DictConfig:
    """Returns the configuration conf/<name>.yaml with Hydra overrides, outside of the scripts."""
    with _hydra():
        return compose(name, list(overrides))


def load_choice(group: str, name: str) -> DictConfig:
    """Returns the file conf/<group>/<name>.yaml, of the running script's search path where there is one.

    Raises:
        InputError: where there is none of this name; it lists the choices.
    """
    if not CHOICE.fullmatch(name):  # a path could lead out of conf/, into a stranger's folder
        raise InputError(f"{group}={name}: no name of a file in conf/{group}")
    further = HydraConfig.get().overrides.hydra if HydraConfig.initialized() else ()
    changes = [f"+{group}={name}", *(each for each in further if each.startswith("hydra.searchpath"))]
    with _hydra() as hydra:
        try:
            loader = hydra.config_loader()
            return loader.load_configuration(None, changes, RunMode.RUN, validate_sweep_overrides=False)[group]
        except HydraException as error:
            known = ", ".join(choices(group))
            raise InputError(f"{group}={name}: none of {known}; add a file to the group in conf/") from error


def choices(group: str) -> list[str]:
    """Returns the names of the files in conf/<group>, as `load_choice` finds them."""
    with _hydra() as hydra:
        return hydra.config_loader().get_group_options(group)


def resolved(config: DictConfig) -> dict[str, Any]:
    """Returns the configuration as plain containers, for the files of a run."""
    plain = OmegaConf.to_container(config, resolve=True)
    assert isinstance(plain, dict)
    return {str(key): value for key, value in plain.items()}


class Extension:
    """What a configuration may name by `_target_`: sources, egos, traffic, curricula, learners."""


def built(config: DictConfig, where: str, kind: type, **given: Any) -> Any:
    """Returns what `_target_` of a group builds, outside code included.

    Raises:
        InputError: where it cannot be built or is no `kind`.
    """
    settings = {key: value for key, value in config.items() if key != "name"}
    target = settings.get("_target_")
    try:
        made = instantiate(settings, _partial_=True, _convert_="all")(**given)
    except InputError:
        raise
    except (InstantiationException, TypeError) as error:
        reason = f"{where}={target}: cannot be built: {error.__cause__ or error}"
        raise InputError(f"{reason}; check the class path and its arguments in conf/{where}") from error
    if not isinstance(made, kind):
        raise InputError(f"{where}={target}: is no {kind.__module__}.{kind.__name__}; subclass it")
    return made


def set_up(config: DictConfig) -> None:
    """Import the plugins; set the threads, the device and the seeds of torch, numpy and python.

    Raises:
        InputError: for a plugin or device that is not there, and a size that is impossible.
    """
    check_counts(config, threads=1, batch=1)
    import_plugins(config.plugins, "plugins: ")
    torch.set_num_threads(config.threads)
    try:
        torch.empty(1, device=config.device)
    except (RuntimeError, AssertionError) as error:
        raise InputError(f"device={config.device}: {str(error).splitlines()[0]}; use device=cpu or cuda") from error
    seed = config.get("seed", 0)  # first weights and exploration; evaluation's noise has seeds of its own
    torch.manual_seed(seed)
    np.random.seed(seed % 2**32)
    random.seed(seed)


def import_plugins(names: Sequence[str], option: str) -> None:
    """Import modules; InputError, beginning with `option`, where one is not there."""
    for name in names:
        try:
            import_module(name)
        except ImportError as error:
            raise InputError(f"{option}{name}: {error}; install it or put its folder on PYTHONPATH") from error


def check_counts(config: Mapping, **least: int) -> None:
    """Raises InputError for settings that are no whole numbers of at least these."""
    for key, low in least.items():
        if type(config[key]) is not int or config[key] < low:
            raise InputError(f"{key}={config[key]}: expected a whole number of at least {low}")


# --- command line

SCRIPTS = ("evaluate", "train")  # that choose from conf/experiment


def run_command(main: Callable[[], None], name: str) -> None:
    """Run a command that Hydra configures by conf/<name>.yaml.

    `--help` prints the files of the configuration, with the files that the command line chooses. An option that there
    is not ends the command with the nearest one, status 2; so does a key added by + that looks like one there is.
    """
    arguments = sys.argv[1:]
    if {"-h", "--help"} & set(arguments):
        print(help_text(name, arguments))
        return
    os.environ["HYDRA_FULL_ERROR"] = "1"  # errors arrive here as they are
    with ending():
        if wrong := added_by_mistake(name, arguments) + of_another_command(name, arguments):
            raise InputError("; ".join(wrong))
        try:
            main()
        except HydraException as error:
            raise InputError("; ".join(mistyped(name, arguments)) or str(error)) from error


def help_text(name: str, arguments: Sequence[str]) -> str:
    """Returns the configuration of a command as its files say it, comments included."""
    folders = [conf_folder(), *_further(arguments)]
    parts = [
        f"{' '.join(program())} [GROUP=FILE] [KEY=VALUE] [PART.KEY=VALUE]\n\nOptions by group, with what they are now; "
        f"`GROUP=FILE --help` shows those of another file. hydra.run.dir=FOLDER: where the run is written.",
        (conf_folder() / f"{name}.yaml").read_text(),
    ]
    chosen = {key: value for _, key, value in _options(arguments)}
    for group, file in _groups(name).items():
        if file := chosen.get(group, file):
            parts += _file_texts(folders, group, str(file))
    return "\n\n".join(part.rstrip() for part in parts)


def _file_texts(folders: Sequence[Path], group: str, name: str) -> Iterator[str]:
    """A group's file under a heading, and those of the group that it builds on."""
    file = next((each for folder in folders if (each := folder / group / f"{name}.yaml").is_file()), None)
    if file is None:
        yield f"### {group}={name}: none of {', '.join(choices(group))}"
        return
    others = ", ".join(sorted(path.stem for folder in folders for path in (folder / group).glob("*.yaml")))
    yield f"### {group}={name} (of: {others})\n\n{file.read_text()}"
    for base in _content(file).get("defaults", ()):
        if isinstance(base, str) and base != "_self_":
            yield from _file_texts(folders, group, base)


def mistyped(name: str, arguments: Sequence[str]) -> list[str]:
    """Returns what is wrong with options that no file of the configuration has, with the nearest name that one has.

    Nothing where the command line names further folders of configuration: Hydra alone knows what is in force then.
    """
    if any(_further(arguments)) or any(argument.startswith("hydra.searchpath") for argument in arguments):
        return []
    given, groups = [option for option in _options(arguments) if not option[0]], _groups(name)
    chosen = [f"{key}={value}" for _, key, value in given if key in groups and value in (*choices(key), "null")]
    keys = list(_keys(OmegaConf.to_container(load_config(name, chosen))))
    wrong = []
    for _, key, value in given:
        if key in groups and value not in (*choices(key), "null"):
            wrong.append(_told(f"{key}={value}", value, choices(key)))
        elif key not in groups and key not in keys:
            wrong.append(_told(key, key, keys))
    return wrong


def added_by_mistake(name: str, arguments: Sequence[str]) -> list[str]:
    """The same for keys added by + at the top, where they look like one of the file's own: they would do nothing."""
    known = [*_content(conf_folder() / f"{name}.yaml"), *_groups(name)]
    added = [key for plus, key, _ in _options(arguments) if plus and "." not in key and "/" not in key]
    return [_told(key, key, known) for key in added if key not in known and get_close_matches(key, known, 1, ALIKE)]


def of_another_command(name: str, arguments: Sequence[str]) -> list[str]:
    """What is wrong with an `experiment` whose file sets options that the command does not have."""

    def fits(command: str) -> bool:
        return sets <= {*_content(conf_folder() / f"{command}.yaml"), *_groups(command)}

    for _, key, value in _options(arguments):
        file = conf_folder() / key / f"{value}.yaml"
        if key == "experiment" and name in SCRIPTS and file.is_file():
            content = _content(file)
            changed = {word for entry in content.pop("defaults", []) if isinstance(entry, dict) for word in entry}
            sets = {*content, *(word.removeprefix("override ").removeprefix("/") for word in changed)}
            if not fits(name):
                right = next((other for other in SCRIPTS if fits(other)), None)
                return [f"experiment={value}: " + (f"of {right}.py, not {name}.py" if right else "of another command")]
    return []


def _told(option: str, given: str, known: Sequence[str]) -> str:
    near = get_close_matches(given, known, 1, 0.5) or get_close_matches(
        given.rpartition(".")[2], [key.rpartition(".")[2] for key in known], 1, 0.5
    )
    return f"{option}: there is no such option" + (f"; the nearest is {near[0]}" if near else "; see --help")


def _further(arguments: Sequence[str]) -> Iterator[Path]:
    """Folders of configuration that the command line names."""
    for position, argument in enumerate(arguments):
        option, _, value = argument.partition("=")
        if option in ("--config-dir", "-cd"):
            yield Path(value or "".join(arguments[position + 1 : position + 2]))


def _options(arguments: Sequence[str]) -> list[tuple[str, str, str]]:
    """(plus signs, key, value) of the options of a command line, Hydra's own apart."""
    found = (OPTION.fullmatch(argument) for argument in arguments)
    parts = [(each["added"], each["key"], each["value"]) for each in found if each]
    return [part for part in parts if not part[1].startswith(("hydra.", "hydra/", "-"))]


def _content(file: Path) -> dict[str, Any]:
    content = OmegaConf.to_container(OmegaConf.load(file))
    return {str(key): value for key, value in content.items()} if isinstance(content, dict) else {}


def _groups(name: str) -> dict[str, str | None]:
    """The groups that a command's configuration chooses from, with the file that it chooses."""
    groups: dict[str, str | None] = {}
    for entry in _content(conf_folder() / f"{name}.yaml")["defaults"]:
        if isinstance(entry, dict):
            groups |= {key.removeprefix("override ").removeprefix("/"): value for key, value in entry.items()}
        elif entry != "_self_":  # the configuration that it builds on
            groups |= _groups(entry)
    return groups


def _keys(config: Any, prefix: str = "") -> Iterator[str]:
    """The dotted names of all entries of nested containers."""
    if isinstance(config, dict):
        for key, value in config.items():
            yield f"{prefix}{key}"
            yield from _keys(value, f"{prefix}{key}.")
