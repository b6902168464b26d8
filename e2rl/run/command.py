"""A command that Hydra configures: `--help` prints all options; an unknown option is
answered with the nearest name."""

import logging
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from difflib import get_close_matches
from itertools import count
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from e2rl.run.config import as_a_list, choices, load_config
from e2rl.run.endings import REFUSED, ending, program
from e2rl.run.errors import InputError
from e2rl.run.files import alone_in
from e2rl.run.run import Run, how_to_go_on
from e2rl.run.settings import conf_folder
from e2rl.run.trust import nodes

BEFORE_QUOTE = re.compile(
    r"(\\+)(?='|\Z)"
)  # elsewhere Hydra keeps backslashes as they are


def run_command(
    name: str,
    work: Callable[[Run], object],
    may_change: Sequence[str] = (),
    begun: Callable[[DictConfig, Sequence[str]], Run] = Run.of,
    alone: bool = True,
) -> None:
    """Do the work of a command that Hydra configures by conf/<name>.yaml; with -m, a
    sweep, in a run for each job.

    A sweep goes on after a job that is refused for bad input, names it at the end, and
    ends with status 2.

    Args:
        may_change: keys that may be others when a run is resumed.
        begun: makes the run of a configuration.
        alone: no other process may be at work in the run's folder.
    """
    sys.argv[1:] = map(with_path, sys.argv[1:])
    arguments = sys.argv[1:]
    if {"-h", "--help"} & set(arguments):
        print(help_text(name, arguments))
        return
    os.environ["HYDRA_FULL_ERROR"] = "1"  # errors arrive here as they are

    sweep = Sweep()
    OmegaConf.register_new_resolver(
        "new_folder", new_folder, replace=True, use_cache=True
    )

    @hydra.main(
        version_base="1.3", config_path=str(conf_folder().resolve()), config_name=name
    )
    def command(config: DictConfig) -> None:
        try:
            with sweep.job(), ending(lambda: how_to_go_on(config)):
                check_keys(config, name)
                run = begun(config, may_change)
                if not alone:
                    work(run)
                    return
                with alone_in(run.folder):
                    run.enter()
                    work(run)
        finally:
            end_log()
            if not any(
                item.startswith("hydra.run.dir=")
                for item in HydraConfig.get().overrides.hydra
            ):
                with suppress(OSError):
                    os.rmdir(
                        HydraConfig.get().runtime.output_dir
                    )  # where nothing was written into it

    with ending():
        try:
            command()
        except HydraException as error:
            raise InputError(told(name, arguments, said=str(error))) from error
        sweep.end()


class Sweep:
    """The jobs of a command: one, or with -m several."""

    def __init__(self) -> None:
        self._jobs: list[str] = []
        self._refused: list[str] = []

    @contextmanager
    def job(self) -> Iterator[None]:
        """A job in the block, which may be refused where it is one of several."""
        hydra = HydraConfig.get()
        name = " ".join(hydra.overrides.task)
        self._jobs.append(name)
        try:
            yield
        except SystemExit as error:
            if hydra.mode != RunMode.MULTIRUN or error.code != REFUSED:
                raise
            self._refused.append(name)

    def end(self) -> None:
        """Raises InputError that names the refused jobs, where there are any."""
        if self._refused:
            names = "; ".join(self._refused)
            raise InputError(
                f"{len(self._refused)} of {len(self._jobs)} jobs of the sweep were refused: {names}"
            )


def with_path(argument: str) -> str:
    """A command line's KEY=PATH as Hydra reads it: ~ is the home folder, and what its
    grammar has no place for, such as letters beyond ASCII, is quoted. Anything else as
    it is."""
    option, _, value = argument.partition("=")
    if not value or option.startswith("-") or value[0] in "[{'\"":
        return argument
    if value.startswith("~"):
        value = str(Path(value).expanduser())
    elif value.isascii():
        return argument
    quoted = BEFORE_QUOTE.sub(r"\1\1", value).replace("'", r"\'")
    return f"{option}='{quoted}'"


def end_log() -> None:
    """End the run's log, so that what else this process logs neither goes there nor
    creates the file again."""
    root = logging.getLogger()
    for handler in [
        each for each in root.handlers if isinstance(each, logging.FileHandler)
    ]:
        root.removeHandler(handler)
        handler.close()


def new_folder(parent: str) -> str:
    """Returns parent/DATE/TIME, a folder made now: of commands that begin in one second
    each has its own."""
    now = datetime.now()
    name = f"{now:%Y-%m-%d}/{now:%H-%M-%S}"
    with suppress(OSError):  # Hydra makes it, too, and says what is wrong
        Path(parent, name).parent.mkdir(parents=True, exist_ok=True)
        for number in count(1):
            folder = Path(parent, name if number == 1 else f"{name}-{number}")
            with suppress(FileExistsError):
                folder.mkdir()
                return str(folder)
    return str(Path(parent, name))


def check_keys(config: DictConfig, name: str) -> None:
    """Raises InputError for keys that conf/<name>.yaml does not have, which do nothing:
    added by +, or by an experiment of another command."""
    known = [*map(str, load_config(name)), *_groups(name)]
    if wrong := [
        _told(str(key), _near(str(key), known)) for key in config if key not in known
    ]:
        raise InputError(f"{'; '.join(wrong)} ({' '.join(program())})")


def help_text(name: str, arguments: Sequence[str]) -> str:
    """Returns the configuration of a command as its files say it, comments included."""
    folders = [conf_folder(), *_further(arguments)]
    parts = [
        f"{' '.join(program())} [GROUP=FILE] [KEY=VALUE] [PART.KEY=VALUE]\n\nOptions by group, with what they are now; "
        f"`GROUP=FILE --help` shows those of another file. hydra.run.dir=FOLDER: where the run is written.",
        (conf_folder() / f"{name}.yaml").read_text(),
    ]
    chosen = dict(argument.split("=", 1) for argument in arguments if "=" in argument)
    for group, file in _groups(name).items():
        if file := chosen.get(group, file):
            parts += _file_texts(folders, group, name=file)
    return "\n\n".join(part.rstrip() for part in parts)


def _file_texts(folders: Sequence[Path], group: str, name: str) -> Iterator[str]:
    """A group's file under a heading, and those of the group that it builds on."""
    file = next(
        (
            each
            for folder in folders
            if (each := folder / group / f"{name}.yaml").is_file()
        ),
        None,
    )
    if file is None:
        yield f"### {group}={name}: none of {', '.join(choices(group))}"
        return
    others = ", ".join(
        sorted(
            path.stem for folder in folders for path in (folder / group).glob("*.yaml")
        )
    )
    yield f"### {group}={name} (of: {others})\n\n{file.read_text()}"
    for base in _content(file).get("defaults", ()):
        if isinstance(base, str) and base != "_self_":
            yield from _file_texts(folders, group, name=base)


DATA = dict.fromkeys(("waymo", "nuscenes", "nuplan", "lyft"), "scenarionet") | {
    "av2": "argoverse2"
}  # their readers


def told(name: str, arguments: Sequence[str], said: str) -> str:
    """Returns Hydra's message on a wrong option or choice, shortened, with the valid
    ones."""
    if found := re.search("Could not find '(.+)/(.+?)'", said):
        group, file = found.groups()
        known = choices(group)
        near = (
            [DATA[file]]
            if group == "data" and file in DATA
            else get_close_matches(file, known, 1, 0.5)
        )
        own = f"one of your own is FOLDER/{group}/{file}.yaml, with --config-dir FOLDER"
        return _told(
            f"{group}={file}",
            [f"{group}={each}" for each in near],
            otherwise=f"of {', '.join(known)}; {own}",
        )
    if found := re.search("Ambiguous value for argument '(.+?)=(.*?)'", said):
        return f"{found[1]}={found[2]}: {as_a_list(found[1], found[2])}; a sweep, a run for each, is -m"
    if found := re.search("Could not override '(.+?)'", said):
        groups = () if any(_further(arguments)) else _groups(name)
        config = load_config(
            name,
            [argument for argument in arguments if argument.split("=")[0] in groups],
        )
        known = [key for key, _ in nodes(OmegaConf.to_container(config))]
        if found[1] in known:
            return f"{found[1]}: what it does not have yet is added by +: '+{found[1]}=...'"
        group = found[1].partition(".")[0]
        others = [
            f"{group}={each}"
            for each in choices(group)
            if group in groups and _has(name, group, choice=each, key=found[1])
        ]
        return _told(
            found[1],
            others
            and [f"{found[1]} with {', '.join(others)}"]
            or _near(found[1], known),
        )
    return said


def _has(name: str, group: str, choice: str, key: str) -> bool:
    """Whether a file of a group has an option."""
    config = load_config(name, [f"{group}={choice}"])
    return key in [
        each for each, _ in nodes(OmegaConf.to_container(config[group]), group)
    ]


def _near(given: str, known: Sequence[str]) -> list[str]:
    """The options that an option which is none may stand for: those of its last name,
    or the nearest."""
    last = given.rpartition(".")[2]
    same = [key for key in known if key.rpartition(".")[2] == last]
    return same[:3] or get_close_matches(given, known, 1, 0.6)


def _told(option: str, near: Sequence[str], otherwise: str = "see --help") -> str:
    advice = f"did you mean {' or '.join(near)}?" if near else otherwise
    return f"{option}: there is no such option; {advice}"


def _further(arguments: Sequence[str]) -> Iterator[Path]:
    """Folders of configuration that the command line names."""
    for position, argument in enumerate(arguments):
        option, _, value = argument.partition("=")
        if option in ("--config-dir", "-cd"):
            yield Path(value or "".join(arguments[position + 1 : position + 2]))


def _content(file: Path) -> dict[str, Any]:
    content = OmegaConf.to_container(OmegaConf.load(file))
    return (
        {str(key): value for key, value in content.items()}
        if isinstance(content, dict)
        else {}
    )


def _groups(name: str) -> dict[str, str | None]:
    """The groups that a command's configuration chooses from, with the file that it
    chooses."""
    groups: dict[str, str | None] = {}
    for entry in _content(conf_folder() / f"{name}.yaml")["defaults"]:
        if isinstance(entry, dict):
            groups |= {
                key.removeprefix("override ").removeprefix("/"): value
                for key, value in entry.items()
            }
        elif entry != "_self_":  # the configuration that it builds on
            groups |= _groups(entry)
    return groups
