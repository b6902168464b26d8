"""`e2rl try LOGS --planner MODULE:CLASS`: how a planner of one's own fails in attacked
traffic, without a YAML file.

It writes the command line of `e2rl evaluate` and runs it: the same protocol, files and
report.
"""

import argparse
import inspect
import os
import sys
from collections.abc import Sequence
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from types import ModuleType

from e2rl.planners.ego import Ego
from e2rl.run.config import assigned
from e2rl.run.endings import ending
from e2rl.run.errors import InputError
from e2rl.scenes.source import open_source

SCENES = 12
NAMED = (
    inspect.Parameter.POSITIONAL_ONLY,
    inspect.Parameter.POSITIONAL_OR_KEYWORD,
    inspect.Parameter.KEYWORD_ONLY,
)


def planner_class(named: str) -> type[Ego]:
    """Returns the class that MODULE:CLASS or FILE.py:CLASS names; its folder is where
    modules are sought from then on.

    Raises:
        InputError: where the module cannot be imported, and where it has no such class,
            or one that is no Ego or does
            not drive.
    """
    where = f"--planner {named}"
    place, _, name = named.rpartition(":")
    if not place or not name:
        raise InputError(f"{where}: name a class, as MODULE:CLASS or FILE.py:CLASS")
    module = _imported(place, where)
    planners = [
        key
        for key, value in vars(module).items()
        if _is_planner(value) and _drives(value)
    ]
    kind = vars(module).get(name)
    near = get_close_matches(name, planners, 1) or planners
    if kind is None:
        advice = (
            f"it has {', '.join(near)}"
            if near
            else "nor any other subclass of e2rl.planners.ego.Ego"
        )
        raise InputError(f"{where}: {place} has no {name}; {advice}")
    if not _is_planner(kind):
        raise InputError(
            f"{where}: {name} is no planner; make it a subclass of "
            "e2rl.planners.ego.Ego with `plan`"
        )
    if not _drives(kind):
        advice = f"; name {', '.join(near)}" if near else ""
        raise InputError(
            f"{where}: {name} overrides neither plan nor act, so that it does not "
            f"drive{advice}"
        )
    return kind


def _imported(place: str, where: str) -> ModuleType:
    """The module of a name or a file; InputError where another one has its name."""
    folder = os.getcwd()
    module = place
    if place.endswith(".py"):
        file = Path(place).resolve()
        if not file.is_file():
            raise InputError(f"{where}: no file {place}; name one that is there")
        folder = str(file.parent)
        module = file.stem
    sys.path.insert(0, folder)
    os.environ["PYTHONPATH"] = os.pathsep.join(
        filter(None, [folder, os.environ.get("PYTHONPATH")])
    )
    try:
        loaded = import_module(module)
    except ModuleNotFoundError as error:
        if error.name and module.split(".")[0] == error.name.split(".")[0]:
            raise InputError(
                f"{where}: no module {module} in {folder}; start in the folder that "
                "holds it, put that on PYTHONPATH, or name the file as FILE.py:CLASS"
            ) from error
        raise InputError(
            f"{where}: {module} needs {error.name}, which is not installed; install it"
        ) from error
    except (Exception, SystemExit) as error:  # of outside code
        raise InputError(
            f"{where}: {module} cannot be imported: {type(error).__name__}: {error}; "
            "mend that"
        ) from error
    file = Path(folder, *module.split(".")).with_suffix(".py")
    other = getattr(loaded, "__file__", None) or "a part of Python"
    if file.is_file() and Path(other).resolve() != file.resolve():
        raise InputError(
            f"{where}: rename {file.name}: a module {module} is loaded already, {other}"
        )
    return loaded


def _is_planner(value: object) -> bool:
    return isinstance(value, type) and issubclass(value, Ego)


def _drives(kind: type[Ego]) -> bool:
    return kind.plan is not Ego.plan or kind.act is not Ego.act


def check_arguments(kind: type[Ego], settings: Sequence[str], where: str) -> None:
    """Raises InputError where an argument of the class has neither a default nor a
    setting NAME=VALUE."""
    names = {setting.partition("=")[0] for setting in settings}
    missing = [
        parameter.name
        for parameter in inspect.signature(kind).parameters.values()
        if parameter.kind in NAMED
        and parameter.default is parameter.empty
        and parameter.name not in names
    ]
    if missing:
        mend = " ".join(f"--set {name}=VALUE" for name in missing)
        raise InputError(
            f"{where}: {kind.__name__} needs {', '.join(missing)}; give defaults, or add {mend}"
        )


def overrides_of(options: argparse.Namespace) -> list[str]:
    """Returns the overrides of `e2rl evaluate` for the options; InputError for a
    planner or logs that are none."""
    kind = planner_class(options.planner)
    check_arguments(kind, options.settings, where=f"--planner {options.planner}")
    logs = [word for word in options.logs if "=" not in word]
    if len(logs) > 1:
        raise InputError(
            f"{logs[1]}: name one folder or zip of logs, or leave it out for the "
            "bundled scenes"
        )
    words = [
        "ego=class",
        assigned("ego._target_", f"{kind.__module__}.{kind.__qualname__}"),
    ]
    words += [f"+ego.{setting}" for setting in options.settings]
    if logs:
        data, _ = open_source(Path(logs[0]), options.data, workers=1)
        words += [f"data={data}", assigned("data.path", logs[0])]
    if options.scenes:
        words.append(f"num_scenes={options.scenes}")
    if options.out:
        words.append(assigned("hydra.run.dir", options.out))
    return words + [word for word in options.logs if "=" in word]


def parser_of(program: str) -> argparse.ArgumentParser:
    """Returns the parser of a program's options that name a class and logs."""
    parser = argparse.ArgumentParser(prog=program, description=__doc__.splitlines()[0])
    logs = "folder or zip of logs (default: the bundled scenes); further KEY=VALUE of evaluate"
    parser.add_argument("logs", nargs="*", metavar="LOGS", help=logs)
    parser.add_argument(
        "--planner",
        required=True,
        metavar="MODULE:CLASS",
        help="an Ego, or FILE.py:CLASS",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        dest="settings",
        metavar="NAME=VALUE",
        help="its argument",
    )
    parser.add_argument(
        "--scenes",
        type=int,
        default=SCENES,
        metavar="N",
        help="the first N; 0: all (%(default)s)",
    )
    parser.add_argument(
        "--data",
        metavar="NAME",
        help="file of conf/data that reads the logs (default: one that can)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FOLDER",
        help="of the run (default: below runs/evaluate)",
    )
    return parser


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    options = parser_of("e2rl try").parse_intermixed_args(arguments)
    with ending():
        sys.argv = ["e2rl evaluate", *overrides_of(options)]
    import_module("e2rl.scripts.evaluate").main()
