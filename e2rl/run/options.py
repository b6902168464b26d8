"""The options of a command: all of them for `--help`, and the nearest to a wrong one."""

import re
from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from e2rl.run.config import CONF, as_a_list, choices, load_config
from e2rl.run.endings import program
from e2rl.run.errors import InputError
from e2rl.run.trust import nodes

READERS = {  # of data sets
    "waymo": "scenarionet",
    "nuscenes": "scenarionet",
    "nuplan": "scenarionet",
    "lyft": "scenarionet",
    "av2": "argoverse2",
}


def check_keys(config: DictConfig, name: str) -> None:
    """Raises InputError for keys that conf/<name>.yaml does not have, which do nothing:
    added by +, or by an experiment of another command."""
    keys = [*map(str, load_config(name)), *groups_of(name)]
    unknown = [str(key) for key in config if key not in keys]
    if unknown:
        reasons = [no_such(key, nearest(key, keys)) for key in unknown]
        raise InputError(f"{'; '.join(reasons)} ({' '.join(program())})")


def check_same_command(
    saved: DictConfig, name: str, *, where: str, command: str
) -> None:
    """Raises InputError for the configuration of a run of another command, which has
    keys that conf/<name>.yaml does not have.

    Args:
        saved: of the run.
        name: of the command's configuration.
        where: the option that names the run.
        command: that began the run.
    """
    keys = {*map(str, load_config(name)), *groups_of(name)}
    if others := [str(key) for key in saved if key not in keys]:
        raise InputError(
            f"{where}: is a run of another command, which has {', '.join(others)}; it "
            f"began as: {command}"
        )


def check_unused(config: DictConfig, command: str, keys: Sequence[str]) -> None:
    """Raises InputError for an option that a command has and does not use."""
    for key in keys:
        if config[key] is not None:
            raise InputError(
                f"{key}={config[key]}: {command} does not use it; leave it out"
            )


def help_text(name: str, arguments: Sequence[str]) -> str:
    """Returns the configuration of a command as its files say it, comments included."""
    folders = [CONF, *further_folders(arguments)]
    chosen = dict(argument.split("=", 1) for argument in arguments if "=" in argument)
    parts = [
        f"{' '.join(program())} [GROUP=FILE] [KEY=VALUE] [PART.KEY=VALUE]\n\nOptions by "
        "group, with what they are now; `GROUP=FILE --help` shows those of another "
        "file. hydra.run.dir=FOLDER: where the run is written.",
        (CONF / f"{name}.yaml").read_text(),
    ]
    for group, file in groups_of(name).items():
        if file := chosen.get(group, file):
            parts += file_texts(folders, group, file)
    return "\n\n".join(part.rstrip() for part in parts)


def file_texts(folders: Sequence[Path], group: str, name: str) -> Iterator[str]:
    """Yields a group's file under a heading, and those of the group that it builds on."""
    files = [path for folder in folders for path in (folder / group).glob("*.yaml")]
    names = ", ".join(sorted(path.stem for path in files))
    file = next((path for path in files if path.stem == name), None)
    if file is None:
        yield f"### {group}={name}: none of {names}"
        return
    yield f"### {group}={name} (of: {names})\n\n{file.read_text()}"
    for base in content_of(file).get("defaults", ()):
        if isinstance(base, str) and base != "_self_":
            yield from file_texts(folders, group, base)


def wrong_option(name: str, arguments: Sequence[str], message: str) -> str:
    """Returns Hydra's message on a wrong option or choice, shortened, with the valid
    ones.

    Args:
        name: of the command's configuration.
        arguments: of the command line.
        message: Hydra's.
    """
    if match := re.search("Could not find '(.+)/(.+?)'", message):
        return wrong_choice(match[1], match[2])
    if match := re.search("Ambiguous value for argument '(.+?)=(.*?)'", message):
        key, value = match.groups()
        mend = f"{as_a_list(key, value)}; a sweep, a run for each, is -m"
        return f"{key}={value}: {mend}"
    match = re.search("Could not override '(.+?)'", message)
    if match is None:
        return message
    key = match[1]
    groups = {} if any(further_folders(arguments)) else groups_of(name)
    chosen = [argument for argument in arguments if argument.split("=")[0] in groups]
    keys = keys_of(load_config(name, chosen))
    if key in keys:
        return f"{key}: what it does not have yet is added by +: '+{key}=...'"
    group = key.partition(".")[0]
    if group in groups:
        with_it = [
            f"{group}={choice}"
            for choice in choices(group)
            if key in keys_of(load_config(name, [f"{group}={choice}"]))
        ]
        if with_it:
            return no_such(key, [f"{key} with {', '.join(with_it)}"])
    return no_such(key, nearest(key, keys))


def wrong_choice(group: str, file: str) -> str:
    """Returns what is said of a file that a group does not have."""
    names = choices(group)
    near = get_close_matches(file, names, 1, 0.5)
    if group == "data" and file in READERS:
        near = [READERS[file]]
    if near:
        return no_such(f"{group}={file}", [f"{group}={near[0]}"])
    return (
        f"{group}={file}: there is no such option; of {', '.join(names)}; one of your "
        f"own is FOLDER/{group}/{file}.yaml, with --config-dir FOLDER"
    )


def no_such(option: str, near: Sequence[str]) -> str:
    """Returns that an option is none, and what it may stand for."""
    advice = f"did you mean {' or '.join(near)}?" if near else "see --help"
    return f"{option}: there is no such option; {advice}"


def nearest(key: str, known: Sequence[str]) -> list[str]:
    """Returns the options that one which is none may stand for: those of its last name,
    or the nearest."""
    last = key.rpartition(".")[2]
    same = [name for name in known if name.rpartition(".")[2] == last]
    return same[:3] or get_close_matches(key, known, 1, 0.6)


def keys_of(config: DictConfig) -> list[str]:
    """Returns the dotted keys of a configuration."""
    return [key for key, _ in nodes(OmegaConf.to_container(config))]


def further_folders(arguments: Sequence[str]) -> Iterator[Path]:
    """Yields folders of configuration that the command line names."""
    for position, argument in enumerate(arguments):
        option, _, value = argument.partition("=")
        if option in ("--config-dir", "-cd"):
            yield Path(value or "".join(arguments[position + 1 : position + 2]))


def content_of(file: Path) -> dict[Any, Any]:
    """Returns the mapping in a YAML file."""
    content = OmegaConf.to_container(OmegaConf.load(file))
    return content if isinstance(content, dict) else {}


def groups_of(name: str) -> dict[str, str | None]:
    """Returns the groups that a command's configuration chooses from, with the file
    that it chooses."""
    groups: dict[str, str | None] = {}
    for entry in content_of(CONF / f"{name}.yaml")["defaults"]:
        if isinstance(entry, dict):
            for group, file in entry.items():
                groups[group.removeprefix("override ").removeprefix("/")] = file
        elif entry != "_self_":  # the configuration that it builds on
            groups |= groups_of(entry)
    return groups
