"""One run of a command: its folder, its configuration, and what it was begun with.

`provenance.json` has the command, versions, configuration and hashes of the inputs,
`scenes.csv` the scenes. A run that goes on (`resume=FOLDER`) must find the same inputs
and configuration. Other code is reported, not refused: the user may have mended what
ended the run.
"""

import copy
import hashlib
import json
import os
import platform
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from e2rl.run.config import assigned, load_choice, load_config, resolved
from e2rl.run.endings import command_line, program
from e2rl.run.errors import InputError
from e2rl.run.files import (
    MAX_RECORD,
    altered,
    check_format,
    hash_files,
    misfit,
    read_regular,
    sha256_of,
    write_atomically,
)
from e2rl.run.options import check_same_command
from e2rl.run.trust import (
    ALWAYS,
    CONFIG,
    check_written,
    leaves,
    outside_modules,
    saved_configuration,
    written_outside,
)

FORMAT = "e2rl-run/1"  # of provenance.json and the tables beside it
FIRST = "e2rl-run/1"  # of those that do not say their format
PROVENANCE = "provenance.json"
PARTS = "parts"  # the folder of `e2rl.run.parts`
PROVENANCE_SHAPE = {
    "command": str,
    "cwd": str,
    "choices": dict,
    "inputs": dict,
    "settings": dict,
    "files": dict,
    "versions": [{"git": str}],
}
PACKAGE = Path(__file__).parents[1]
# files that whatever starts a command may write into its run's folder
LOGS = (".log", ".out", ".err")
# groups whose files are not hashed: scenes are, and a study is to grow
READ_OTHERWISE = ("data", "tuning")


@dataclass(frozen=True)
class Run:
    """What a command does.

    Args:
        config: its configuration.
        folder: that it writes to.
        choices: the file of each group of the configuration.
        free: keys of the configuration that may be others where the run goes on.
    """

    config: DictConfig
    folder: Path
    choices: Mapping[str, str]
    free: Sequence[str] = ()

    @classmethod
    def of(cls, config: DictConfig, free: Sequence[str] = ()) -> "Run":
        """Returns the run that the command line asks for: a new one, or the one that
        `config.resume` goes on with. Raises InputError where there is none to go on
        with; where its configuration names what the command line does not
        (`e2rl.run.trust`); for settings that are fixed."""
        hydra = HydraConfig.get()
        if not config.resume:
            folder = Path(hydra.runtime.output_dir)
            return cls(config, folder, dict(hydra.runtime.choices), free)
        folder = Path(config.resume).resolve()
        where = f"resume={config.resume}"
        saved = saved_configuration(config, folder, where=where)
        provenance = read_provenance(folder)
        check_same_command(
            saved,
            str(hydra.job.config_name),
            where=where,
            command=provenance["command"],
        )
        choices = provenance["choices"]
        keys = {item.split("=", 1)[0].lstrip("+~") for item in hydra.overrides.task}
        default = load_config(str(hydra.job.config_name))
        needed = written_outside(saved, folder, default)
        allowed = {*free, *ALWAYS, *(option.partition("=")[0] for option in needed)}
        if fixed := sorted(keys - allowed):
            raise InputError(
                f"{where}: goes on as it was begun; leave out {', '.join(fixed)} (only "
                f"{', '.join(free)} can change)"
            )
        check_written(saved, folder, where, config, default)
        for key in keys.intersection(free):
            saved[key] = config[key]
        saved.plugins = config.plugins
        saved.resume = str(folder)
        return cls(saved, folder, choices, free)

    def enter(self) -> None:
        """Make the folder ready, once nobody else is at work in it. Raises InputError
        where it cannot be written; where a new run's is not empty, but for logs and for
        what is left of a run that was killed as it began."""
        if not os.access(self.folder, os.W_OK):
            raise InputError(
                f"{self.folder}: cannot be written; make it writable, or name another "
                "folder"
            )
        if self.config.resume:
            for part in list(self.folder.rglob(".*.part")):  # was being written
                shutil.rmtree(part) if part.is_dir() else part.unlink(missing_ok=True)
            return
        names = set()
        for path in self.folder.rglob("*"):
            name = path.relative_to(self.folder).parts[0]
            if not path.is_dir() and not name.endswith(LOGS):
                names.add(name)
        if {PROVENANCE, PARTS} & names:
            raise InputError(
                f"{self.folder}: has a run already; go on with it by "
                f"{assigned('resume', self.folder)}, or name another folder by "
                "hydra.run.dir=FOLDER"
            )
        if names and CONFIG.parts[0] not in names:
            raise InputError(
                f"{self.folder}: is not empty ({min(names)}); name another folder by "
                "hydra.run.dir=FOLDER"
            )

    def begin(self, scenes: Mapping[str, tuple[str, str]]) -> dict[str, str]:
        """Write what the run was begun with; or where it goes on, compare with that.
        Other versions are told on stderr. Returns `git` and `command` of the run's
        rows.

        Args:
            scenes: of each set of scenes, by its name, what
                `e2rl.scenes.scene_list.listed` returns.

        Raises:
            InputError: for other inputs or settings than those that the run was begun
                with.
        """
        lists = {
            name: hashlib.sha256(text.encode()).hexdigest()
            for name, (text, _) in scenes.items()
        }
        provenance = {
            "format": FORMAT,
            "release": metadata.version("e2rl"),
            "command": command_line(),
            "cwd": str(Path.cwd()),
            "choices": dict(self.choices),
            "versions": [versions(self.config)],
            "settings": settings(self.config, self.free),
            "inputs": lists | dict(inputs(self.config)),
            "files": {name: files for name, (_, files) in scenes.items()},
        }
        if self.config.resume:
            return self._compare(json.loads(json.dumps(provenance)))
        files = {str(CONFIG): OmegaConf.to_yaml(self.config)}
        for name, (text, _) in scenes.items():
            files[f"{name.replace(' ', '_')}.csv"] = text
        files[PROVENANCE] = json.dumps(provenance, indent=1)
        for name, text in files.items():
            write_atomically(self.folder / name, text)
        return _origin(provenance)

    def _compare(self, present: Mapping[str, Any]) -> dict[str, str]:
        provenance = read_provenance(self.folder)
        for kind in ("inputs", "settings"):
            if names := changed(provenance[kind], present[kind]):
                raise InputError(
                    f"resume={self.folder}: {', '.join(names)} changed since the run "
                    "began, so what is finished would not fit to the rest; restore "
                    "them, or begin a new run"
                )
        last = provenance["versions"][-1]
        here = present["versions"][0]
        names = [name for name in changed(last, here) if name in last]
        if names:  # modules may join
            print(
                f"resume={self.folder}: other versions than before "
                f"({', '.join(names)}); see {PROVENANCE}",
                file=sys.stderr,
            )
            provenance["versions"].append(here)
            write_atomically(self.folder / PROVENANCE, json.dumps(provenance, indent=1))
        return _origin(provenance)


def how_to_go_on(config: DictConfig) -> str:
    """Returns the command that goes on with a run that ends early, for a shell: the
    same where it had not begun."""
    hydra = HydraConfig.get()
    folder = Path(config.resume or hydra.runtime.output_dir)
    if not (folder / PROVENANCE).is_file():
        return command_line()
    words = program()
    arguments = sys.argv[1:]
    for position, argument in enumerate(arguments):  # further folders of configuration
        if argument in ("--config-dir", "-cd"):
            words += arguments[position : position + 2]
        elif argument.startswith(("--config-dir=", "-cd=")):
            words.append(argument)
    words.append(assigned("resume", folder))
    default = load_config(str(hydra.job.config_name))
    words += written_outside(config, folder, default)
    if modules := sorted(outside_modules(config)):
        words.append(f"plugins=[{','.join(modules)}]")
    return shlex.join(words)


def read_provenance(folder: Path) -> dict[str, Any]:
    """Returns the content of a run's provenance.json; InputError where it is not there,
    damaged or of another format. One of no format is of the first."""
    file = Path(folder) / PROVENANCE
    try:
        provenance = json.loads(read_regular(file, MAX_RECORD, within=Path(folder)))
        written = provenance.get("format", FIRST)
        if written == FORMAT:
            reason = misfit(provenance, PROVENANCE_SHAPE)
            if reason or not provenance["versions"]:
                raise ValueError(reason)
    except FileNotFoundError as error:
        raise InputError(
            f"{file}: not there; give the folder of a run that had begun"
        ) from error
    except (OSError, ValueError, AttributeError, RecursionError) as error:
        raise InputError(f"{file}: damaged; restore it, or begin a new run") from error
    mend = f"read it with e2rl {provenance.get('release')}, or begin a new run"
    check_format(file, written, expected=FORMAT, mend=mend)
    return provenance


def check_run(folder: Path) -> None:
    """Raises InputError where a folder of tables is, or lies in, that of a run of
    another format."""
    for run in (folder, folder.parent):
        if (run / PROVENANCE).is_file():
            read_provenance(run)


def origin_of(folder: Path) -> dict[str, str]:
    """Returns `git` and `command` of a run's rows: as it was begun; several commits
    where it went on with others."""
    if not (Path(folder) / PROVENANCE).is_file():
        return {"git": git_commit(), "command": command_line()}
    return _origin(read_provenance(folder))


def _origin(provenance: Mapping[str, Any]) -> dict[str, str]:
    commits = dict.fromkeys(version["git"] for version in provenance["versions"])
    return {"git": ", ".join(commits), "command": provenance["command"]}


# --- what a run depends on


def changed(before: Mapping[str, Any], after: Mapping[str, Any]) -> list[str]:
    """Returns the names whose plain values differ."""

    def text(values: Mapping[str, Any], name: str) -> str:
        return json.dumps(values[name], sort_keys=True) if name in values else ""

    names = sorted({*before, *after})
    return [name for name in names if text(before, name) != text(after, name)]


def settings(config: DictConfig, free: Sequence[str]) -> dict[str, Any]:
    """Returns the configuration without the keys that may change, and without their
    values elsewhere."""
    fixed = copy.deepcopy(config)
    for key in (*free, "resume", "plugins"):
        fixed[key] = None
    return {key: value for key, value in resolved(fixed).items() if value is not None}


def versions(config: DictConfig) -> dict[str, str]:
    """Returns commit, versions of python and torch, and hashes: of the code of e2rl, of
    the weights that come with it, and of modules outside of it that the configuration
    names."""
    result = {
        "git": git_commit(),
        "python": platform.python_version(),
        "torch": metadata.version("torch"),
        "e2rl": hash_files(sorted(PACKAGE.rglob("*.py"))).hex(),
        "bundled weights": hash_files(sorted(PACKAGE.rglob("*.safetensors"))).hex(),
    }
    for name in sorted(outside_modules(config)):
        spec = find_spec(name)
        origin = spec.origin if spec else None
        result[name] = hash_files([Path(origin)]).hex() if origin else ""
    return result


def inputs(config: DictConfig) -> Iterator[tuple[str, Any]]:
    """Yields (name, hash) of every file that a configuration names, (name, content) of
    files in conf/ that it names."""
    plain: Any = OmegaConf.to_container(config, resolve=True)
    for group in (*READ_OTHERWISE, "resume"):
        plain.pop(group, None)
    for key, value in leaves(plain):
        if not isinstance(value, str) or not value:
            continue
        path = Path(value)
        if "checkpoint" in key and path.is_dir():
            path = newest_weights(path)
        if path.is_file():
            try:
                yield f"{key}={value}", sha256_of(path)
            except OSError as error:
                raise InputError(
                    f"{key}={value}: cannot be read: {error.strerror}; name another "
                    "file"
                ) from error
    methods = list(config.get("methods", ()))
    if "search" in config and config.get("tries") != 1:
        for family in config.search.families.values():
            if isinstance(family, DictConfig):
                methods.append(family.get("method", "e2"))
    for name in dict.fromkeys(methods):
        if name in ("search", config.synthesizer.name, *config.get("variants", ())):
            continue
        synthesizer = load_choice("synthesizer", name)
        yield f"synthesizer={name}", OmegaConf.to_container(synthesizer, resolve=True)
    for entry in config.get("egos", {}).values():
        ego = load_choice("ego", entry.ego)
        yield f"ego={entry.ego}", OmegaConf.to_container(ego)  # as written


def newest_weights(folder: Path) -> Path:
    """Returns the weights in a folder, or of the newest whole checkpoint where it is a
    run's; the folder itself where there are none."""
    whole = [
        path for path in sorted(folder.glob("checkpoints/*/")) if altered(path) is None
    ]
    place = whole[-1] if whole else folder
    return min(place.glob("*.safetensors"), default=folder)


@cache
def git_commit() -> str:
    """Returns the package's commit, with '+changes' where tracked files differ from it;
    "" outside a git checkout."""
    try:
        commit = _git("rev-parse", "HEAD")
        changes = _git("status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.SubprocessError):
        return ""
    return commit + ("+changes" if changes else "")


def _git(*arguments: str) -> str:
    """What git says of the package."""
    ended = subprocess.run(
        ["git", *arguments],
        cwd=PACKAGE,
        capture_output=True,
        text=True,
        timeout=20,
        check=True,
    )
    return ended.stdout.strip()
