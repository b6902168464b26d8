"""A command that Hydra configures: `--help` prints all options; an unknown option is
answered with the nearest name."""

import logging
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from itertools import count
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from e2rl.run.config import CONF
from e2rl.run.endings import REFUSED, ending
from e2rl.run.errors import InputError
from e2rl.run.files import alone_in
from e2rl.run.options import check_keys, help_text, wrong_option
from e2rl.run.run import Run, how_to_go_on

# elsewhere Hydra keeps backslashes as they are
BEFORE_QUOTE = re.compile(r"(\\+)(?='|\Z)")


def run_command(
    name: str,
    work: Callable[[Run], object],
    may_change: Sequence[str] = (),
    begun: Callable[[DictConfig, Sequence[str]], Run] = Run.of,
) -> None:
    """Do the work of a command that Hydra configures by conf/<name>.yaml; with -m, a
    sweep, in a run for each job.

    A sweep goes on after a job that is refused for bad input, names it at the end, and
    ends with status 2.

    Args:
        name: of the command's configuration.
        work: of a run.
        may_change: keys that may be others when a run is resumed.
        begun: makes the run of a configuration.
    """
    sys.argv[1:] = map(with_path, sys.argv[1:])
    arguments = sys.argv[1:]
    if {"-h", "--help"} & set(arguments):
        print(help_text(name, arguments))
        return
    os.environ["HYDRA_FULL_ERROR"] = "1"  # errors arrive here as they are
    sweep = Sweep()
    OmegaConf.register_new_resolver(
        "new_folder",
        new_folder,
        replace=True,
        use_cache=True,
    )

    def job(config: DictConfig) -> None:
        with sweep.job(), ending(lambda: how_to_go_on(config)):
            check_keys(config, name)
            run = begun(config, may_change)
            with alone_in(run.folder):
                run.enter()
                work(run)

    @hydra.main(
        version_base="1.3",
        config_path=str(CONF),
        config_name=name,
    )
    def command(config: DictConfig) -> None:
        try:
            job(config)
        finally:
            end_log()
            remove_unused_folder()

    with ending():
        try:
            command()
        except HydraException as error:
            raise InputError(wrong_option(name, arguments, str(error))) from error
        sweep.end()


class Sweep:
    """The jobs of a command: one, or with -m several."""

    def __init__(self) -> None:
        self._jobs: list[str] = []
        self._refused: list[str] = []

    @contextmanager
    def job(self) -> Iterator[None]:
        """A job in the block, which may be refused where it is one of several."""
        config = HydraConfig.get()
        name = " ".join(config.overrides.task)
        self._jobs.append(name)
        try:
            yield
        except SystemExit as error:
            if config.mode != RunMode.MULTIRUN or error.code != REFUSED:
                raise
            self._refused.append(name)

    def end(self) -> None:
        """Raises InputError that names the refused jobs, where there are any."""
        if self._refused:
            raise InputError(
                f"{len(self._refused)} of {len(self._jobs)} jobs of the sweep were "
                f"refused: {'; '.join(self._refused)}"
            )


def with_path(argument: str) -> str:
    """Returns a command line's KEY=PATH as Hydra reads it: ~ is the home folder, and
    what its grammar has no place for, such as letters beyond ASCII, is quoted. Anything
    else as it is."""
    option, _, value = argument.partition("=")
    if not value or option.startswith("-") or value[0] in "[{'\"":
        return argument
    if value.startswith("~"):
        value = str(Path(value).expanduser())
    elif value.isascii():
        return argument
    quoted = BEFORE_QUOTE.sub(r"\1\1", value).replace("'", r"\'")
    return f"{option}='{quoted}'"


def new_folder(parent: str) -> str:
    """Returns parent/DATE/TIME, a new folder: of commands that begin in one second each
    has its own."""
    begin = datetime.now()
    day = Path(parent, f"{begin:%Y-%m-%d}")
    name = f"{begin:%H-%M-%S}"
    with suppress(OSError):  # Hydra makes it, too, and says what is wrong
        day.mkdir(parents=True, exist_ok=True)
        for number in count(1):
            folder = day / (name if number == 1 else f"{name}-{number}")
            with suppress(FileExistsError):
                folder.mkdir()
                return str(folder)
    return str(day / name)


def end_log() -> None:
    """End the run's log, so that what else this process logs neither goes there nor
    creates the file again."""
    root = logging.getLogger()
    for handler in list(root.handlers):
        if isinstance(handler, logging.FileHandler):
            root.removeHandler(handler)
            handler.close()


def remove_unused_folder() -> None:
    """Remove the run's folder where nothing was written into it and nobody named it."""
    config = HydraConfig.get()
    if not any(item.startswith("hydra.run.dir=") for item in config.overrides.hydra):
        with suppress(OSError):
            os.rmdir(config.runtime.output_dir)
