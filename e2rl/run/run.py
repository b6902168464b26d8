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
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from e2rl.run.config import assigned, load_choice, load_config, resolved
from e2rl.run.endings import command_line, program
from e2rl.run.errors import InputError
from e2rl.run.files import (
    MAX_RECORD,
    altered,
    hash_files,
    read_regular,
    sha256_of,
    write_atomically,
)
from e2rl.run.parts import PARTS, Parts
from e2rl.run.trust import (
    ALWAYS,
    CONFIG,
    check_written,
    leaves,
    outside_modules,
    saved_configuration,
    written_outside,
)

PROVENANCE = "provenance.json"
PACKAGE = Path(__file__).parents[1]
LOGS = (
    ".log",
    ".out",
    ".err",
)  # files that whatever starts a command may write into its run's folder
READ_OTHERWISE = (
    "data",
    "tuning",
)  # groups whose files are not hashed: scenes are, and a study is to grow


@dataclass(frozen=True)
class Run:
    """What a command does.

    Args:
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
            return cls(
                config,
                Path(hydra.runtime.output_dir),
                dict(hydra.runtime.choices),
                free,
            )
        folder = Path(config.resume).resolve()
        where = f"resume={config.resume}"
        saved = saved_configuration(config, folder, where=where)
        known = read_provenance(folder)
        given = {item.split("=", 1)[0].lstrip("+~") for item in hydra.overrides.task}
        default = load_config(str(hydra.job.config_name))
        needed = {
            option.partition("=")[0]
            for option in written_outside(saved, folder, default)
        }
        if wrong := sorted(given - {*free, *ALWAYS, *needed}):
            raise InputError(
                f"{where}: goes on as it was begun; leave out {', '.join(wrong)} (only {', '.join(free)} can change)"
            )
        check_written(saved, folder, where, config, default)
        for key in given.intersection(free):
            saved[key] = config[key]
        saved.plugins = config.plugins
        saved.resume = str(folder)
        return cls(saved, folder, known["choices"], free)

    def enter(self) -> None:
        """Make the folder ready, once nobody else is at work in it. Raises InputError
        where it cannot be written; where a new run's is not empty, but for logs and for
        what is left of a run that was killed as it began."""
        if not os.access(self.folder, os.W_OK):
            raise InputError(
                f"{self.folder}: cannot be written; make it writable, or name another folder"
            )
        if self.config.resume:
            for left in list(
                self.folder.rglob(".*.part")
            ):  # of what was being written at the end
                shutil.rmtree(left) if left.is_dir() else left.unlink(missing_ok=True)
            return
        found = {
            path.relative_to(self.folder).parts[0]
            for path in self.folder.rglob("*")
            if not path.is_dir()
        }
        found -= {name for name in found if name.endswith(LOGS)}
        if {PROVENANCE, PARTS} & found:
            raise InputError(
                f"{self.folder}: has a run already; go on with it by {assigned('resume', self.folder)}, or name "
                "another folder by hydra.run.dir=FOLDER"
            )
        if CONFIG.parts[0] not in found and (others := sorted(found)):
            raise InputError(
                f"{self.folder}: is not empty ({others[0]}); name another folder by hydra.run.dir=FOLDER"
            )

    def parts(self, stage: str = "", about: str = "") -> Parts:
        """Returns the parts of a stage that are done."""
        return Parts(self.folder, stage, about=about)

    def begin(self, scenes: Mapping[str, tuple[str, str]]) -> None:
        """Write what the run was begun with; or where it goes on, compare with that.
        Raises InputError for other inputs or settings than those that the run was begun
        with. Other versions are told on stderr.

        scenes: of each set of scenes, by its name, what `e2rl.scenes.scene_list.listed`
        returns.
        """
        lists = {
            name: hashlib.sha256(text.encode()).hexdigest()
            for name, (text, _) in scenes.items()
        }
        now = {
            "versions": [versions(self.config)],
            "settings": settings(self.config, self.free),
            "inputs": lists | dict(inputs(self.config)),
            "files": {name: files for name, (_, files) in scenes.items()},
        }
        if self.config.resume:
            self._compare(json.loads(json.dumps(now)))
            return
        write_atomically(self.folder / CONFIG, OmegaConf.to_yaml(self.config))
        for name, (text, _) in scenes.items():
            write_atomically(self.folder / f"{name.replace(' ', '_')}.csv", text)
        begun = {
            "command": command_line(),
            "cwd": str(Path.cwd()),
            "choices": dict(self.choices),
        }
        self._write(begun | now)

    def _compare(self, now: Mapping[str, Any]) -> None:
        known = read_provenance(self.folder)
        for kind in ("inputs", "settings"):
            if names := changed(known[kind], now[kind]):
                raise InputError(
                    f"resume={self.folder}: {', '.join(names)} changed since the run began, so what is finished "
                    "would not fit to the rest; restore them, or begin a new run"
                )
        last = known["versions"][-1]
        here = now["versions"][0]
        if names := [
            name for name in changed(last, here) if name in last
        ]:  # modules may join
            said = f"other versions than before ({', '.join(names)}); see {PROVENANCE}"
            print(f"resume={self.folder}: {said}", file=sys.stderr)
            known["versions"].append(here)
            self._write(known)

    def _write(self, provenance: Mapping[str, Any]) -> None:
        write_atomically(self.folder / PROVENANCE, json.dumps(provenance, indent=1))


def how_to_go_on(config: DictConfig) -> str:
    """Returns the command that goes on with a run that ends early, for a shell: the
    same where it had not begun."""
    folder = Path(config.resume or HydraConfig.get().runtime.output_dir)
    if not (folder / PROVENANCE).is_file():
        return command_line()
    words = program()
    arguments = sys.argv[1:]
    for position, argument in enumerate(arguments):  # further folders of configuration
        if argument.split("=")[0] in ("--config-dir", "-cd"):
            words += (
                [argument] if "=" in argument else arguments[position : position + 2]
            )
    words.append(assigned("resume", folder))
    words += written_outside(
        config, folder, load_config(str(HydraConfig.get().job.config_name))
    )
    if modules := sorted(outside_modules(config)):
        words.append(f"plugins=[{','.join(modules)}]")
    return shlex.join(words)


def read_provenance(folder: Path) -> dict[str, Any]:
    """Returns the content of a run's provenance.json; InputError where it is not there
    or damaged."""
    file = Path(folder) / PROVENANCE
    damaged = InputError(
        f"{file}: damaged, or of another version; restore it, or begin a new run"
    )
    try:
        known = json.loads(read_regular(file, MAX_RECORD, within=Path(folder)))
        kinds = {
            "command": str,
            "cwd": str,
            "choices": dict,
            "inputs": dict,
            "settings": dict,
            "files": dict,
        }
        wrong = [
            name for name, kind in kinds.items() if not isinstance(known[name], kind)
        ]
        if (
            not wrong
            and known["versions"]
            and all(isinstance(each["git"], str) for each in known["versions"])
        ):
            return known
    except FileNotFoundError as error:
        raise InputError(
            f"{file}: not there; give the folder of a run that had begun"
        ) from error
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise damaged from error
    raise damaged


def origin_of(folder: Path) -> dict[str, Any]:
    """Returns `git` and `command` of a run's rows: as it was begun; several commits
    where it went on with others."""
    if not (Path(folder) / PROVENANCE).is_file():
        return {"git": git_commit(), "command": command_line()}
    known = read_provenance(folder)
    return {
        "git": ", ".join(dict.fromkeys(each["git"] for each in known["versions"])),
        "command": known["command"],
    }


# --- what a run depends on


def changed(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Returns the names whose plain values differ."""
    texts = [
        {name: json.dumps(value, sort_keys=True) for name, value in each.items()}
        for each in (before, now)
    ]
    return sorted(
        name for name in {*before, *now} if texts[0].get(name) != texts[1].get(name)
    )


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
    found = {
        "git": git_commit(),
        "python": platform.python_version(),
        "torch": torch.__version__,
    }
    found["e2rl"] = hash_files(sorted(PACKAGE.rglob("*.py"))).hex()
    found["bundled weights"] = hash_files(sorted(PACKAGE.rglob("*.safetensors"))).hex()
    for name in sorted(outside_modules(config)):
        spec = find_spec(name)
        found[name] = (
            hash_files([Path(spec.origin)]).hex()
            if spec is not None and spec.origin is not None
            else ""
        )
    return found


def inputs(config: DictConfig) -> Iterator[tuple[str, Any]]:
    """(name, hash) of every file that a configuration names, (name, content) of files
    in conf/ that it names."""
    for key, value in leaves(
        {
            name: part
            for name, part in resolved(config).items()
            if name not in READ_OTHERWISE
        }
    ):
        if not isinstance(value, str) or not value or key == "resume":
            continue
        path = Path(value)
        if (
            "checkpoint" in key and path.is_dir()
        ):  # perhaps a run's folder, of which the newest whole checkpoint counts
            whole = [
                each
                for each in sorted(path.glob("checkpoints/*/"))
                if altered(each) is None
            ]
            path = next(
                iter(sorted((whole[-1] if whole else path).glob("*.safetensors"))), path
            )
        if path.is_file():
            try:
                yield f"{key}={value}", sha256_of(path)
            except OSError as error:
                raise InputError(
                    f"{key}={value}: cannot be read: {error.strerror}; name another file"
                ) from error
    families = (
        config.search.families.values()
        if "search" in config and config.get("tries") != 1
        else ()
    )
    of_families = (
        family.get("method", "e2")
        for family in families
        if isinstance(family, DictConfig)
    )
    for name in dict.fromkeys([*config.get("methods", ()), *of_families]):
        if name not in (*config.get("variants", ()), config.synthesizer.name, "search"):
            yield f"synthesizer={name}", resolved(load_choice("synthesizer", name))
    for entry in config.get("egos", {}).values():
        yield (
            f"ego={entry.ego}",
            OmegaConf.to_container(load_choice("ego", entry.ego)),
        )  # as written


@cache
def git_commit() -> str:
    """Returns the package's commit, with '+changes' where tracked files differ from it;
    "" outside a git checkout."""

    def git(*arguments: str) -> str | None:
        try:
            done = subprocess.run(
                ["git", *arguments],
                cwd=PACKAGE,
                capture_output=True,
                text=True,
                timeout=20,
            )
        except (OSError, subprocess.TimeoutExpired):
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    commit = git("rev-parse", "HEAD")
    changes = git("status", "--porcelain", "--untracked-files=no")
    return "" if commit is None else commit + ("+changes" if changes else "")
