"""What a run was begun with: its command, versions, configuration and the hashes of its inputs, in provenance.json, and
its scenes, in scenes.csv.

A run that goes on must find the same inputs and configuration. Another version of the code is told, not refused: the
user may have mended what ended the run.
"""

import copy
import hashlib
import json
import platform
import shlex
import sys
from collections.abc import Collection, Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

import e2rl
from e2rl.evaluation.methods import method_config
from e2rl.evaluation.rollout_files import command_line, git_commit
from e2rl.planners.network import find_weights
from e2rl.run.config import load_choice, resolved
from e2rl.run.errors import InputError
from e2rl.run.files import sha256_of, write_atomically
from e2rl.run.parts import forget_parts
from e2rl.scenes.scene import SceneSet
from e2rl.scenes.scene_list import SCENES, list_text
from e2rl.scenes.source import hash_files

PROVENANCE = "provenance.json"
FREE = ("resume", "plugins")
STARTING = {
    "command": "e2rl.planners.external",
    "address": "e2rl.planners.external",
}  # by a part of the key that names it
PROGRAM, ARITHMETIC = "e2rl.planners.policy_file", ".onnx"  # other files of policies are programs
READ_OTHERWISE = ("data", "tuning")  # groups whose files are not hashed: scenes are, and a study is to grow


def begin_run(folder: Path, config: DictConfig, free: Collection[str], scenes: Mapping[str, SceneSet]) -> None:
    """Write provenance.json of a new run and the lists of its scenes, scenes.csv for `scenes`; parts of an earlier one
    in the same folder are removed. Or where `config.resume` goes on with a run, compare with provenance.json.

    free: keys of the configuration that may change; scenes: by name in messages. Raises InputError for other inputs or
    settings than those that the run was begun with; says on stderr where versions differ.
    """
    lists = {name: list_text(each) for name, each in scenes.items()}
    now = {
        "versions": [versions(config)],
        "settings": settings(config, free),
        "inputs": {name: hashlib.sha256(text.encode()).hexdigest() for name, text in lists.items()}
        | dict(inputs(config)),
        "files": {name: each.files for name, each in scenes.items()},
    }
    known = read_provenance(folder) if config.resume else None
    if known is None:
        forget_parts(folder)
        for name, text in lists.items():
            write_atomically(folder / SCENES.replace("scenes", name.replace(" ", "_")), text)
        command = begun_command(folder) if config.resume else command_line()
        write_atomically(folder / PROVENANCE, json.dumps({"command": command, **now}, indent=1))
        return
    now = json.loads(json.dumps(now))
    for kind in ("inputs", "settings"):
        if names := changed(known[kind], now[kind]):
            raise InputError(
                f"resume={config.resume}: {', '.join(names)} changed since the run began, so what is finished "
                "would not fit to the rest; restore them, or begin a new run"
            )
    last, here = known["versions"][-1], now["versions"][0]
    if names := [name for name in changed(last, here) if name in last]:  # modules may join
        print(
            f"resume={config.resume}: other versions than before ({', '.join(names)}); see {PROVENANCE}",
            file=sys.stderr,
        )
        known["versions"].append(here)
        write_atomically(folder / PROVENANCE, json.dumps(known, indent=1))


def begun_command(folder: Path) -> str:
    """The command that a run was begun with, by its overrides: it ended before provenance.json was written."""
    saved: Any = OmegaConf.to_container(OmegaConf.load(folder / ".hydra" / "hydra.yaml"))  # ${..} in an override stays
    try:
        overrides = saved["hydra"]["overrides"]
        given = [str(each) for each in (*overrides["task"], *overrides["hydra"]) if each != "hydra.mode=RUN"]
    except (KeyError, TypeError) as error:
        raise InputError(f"{folder / '.hydra' / 'hydra.yaml'}: damaged; restore it, or begin a new run") from error
    return shlex.join(["python", sys.argv[0], *given])


def changed(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Names whose plain values differ."""
    texts = [{name: json.dumps(value, sort_keys=True) for name, value in each.items()} for each in (before, now)]
    return sorted(name for name in {*before, *now} if texts[0].get(name) != texts[1].get(name))


def read_provenance(folder: Path) -> dict[str, Any] | None:
    """The content of a run's provenance.json; None where the run ended before it was written."""
    file = Path(folder) / PROVENANCE
    if not file.is_file():
        return None
    try:
        known = json.loads(file.read_text())
        whole = isinstance(known["command"], str) and all(isinstance(each["git"], str) for each in known["versions"])
        if whole and known["versions"] and isinstance(known["inputs"], dict) and isinstance(known["settings"], dict):
            return known
    except (OSError, ValueError, KeyError, TypeError):
        pass
    raise InputError(f"{file}: damaged; restore it, or begin a new run")


def origin_of(folder: Path) -> dict[str, Any]:
    """`git` and `command` of a run's rows: as it was begun; several commits where it went on with other versions."""
    known = read_provenance(folder)
    if known is None:
        return {"git": git_commit(), "command": command_line()}
    return {"git": ", ".join(dict.fromkeys(each["git"] for each in known["versions"])), "command": known["command"]}


def settings(config: DictConfig, free: Collection[str]) -> dict[str, Any]:
    """The configuration without the keys that may change, and without their values elsewhere."""
    fixed = copy.deepcopy(config)
    for key in (*free, *FREE):
        fixed[key] = None
    return {key: value for key, value in resolved(fixed).items() if value is not None}


def versions(config: DictConfig) -> dict[str, str]:
    """Commit, versions of python and torch, and hashes: of the code of e2rl, of the weights that come with it, and of
    modules outside of it that the configuration names."""
    package = Path(e2rl.__file__).parent
    found = {"git": git_commit(), "python": platform.python_version(), "torch": torch.__version__}
    found["e2rl"] = hash_files(sorted(package.rglob("*.py"))).hex()
    found["bundled weights"] = hash_files(sorted(package.rglob("*.safetensors"))).hex()
    for name in sorted(outside_modules(config)):
        spec = find_spec(name)
        found[name] = hash_files([Path(spec.origin)]).hex() if spec is not None and spec.origin is not None else ""
    return found


def outside_modules(config: DictConfig) -> set[str]:
    """Modules outside of e2rl that a configuration names, plugins and those of `_target_`s, and `starting_modules`."""
    plain = OmegaConf.to_container(config)
    named = {str(value).rpartition(".")[0] for key, value in leaves(plain) if key.endswith("_target_")}
    outside = {name for name in named if not name.startswith("e2rl.")} - {""}
    return {str(name) for name in config.plugins} | outside | starting_modules(plain)


def starting_modules(plain: Any) -> set[str]:
    """Modules of e2rl that run a program or connect to an address that a configuration names; plain: containers."""
    named = [(key, str(value)) for key, value in leaves(plain) if value]
    found = {module for key, _ in named for part, module in STARTING.items() if part in key}
    return found | {PROGRAM for key, value in named if "file" in key and not value.endswith(ARITHMETIC)}


def inputs(config: DictConfig) -> Iterator[tuple[str, Any]]:
    """(name, hash) of every file that a configuration names, (name, content) of files in conf/ that it names."""
    for key, value in leaves({name: part for name, part in resolved(config).items() if name not in READ_OTHERWISE}):
        if not isinstance(value, str) or not value or key == "resume":
            continue
        path = Path(value)
        if "checkpoint" in key and path.is_dir():
            path = find_weights(path)
        if path.is_file():
            yield f"{key}={value}", sha256_of(path)
    for name in config.get("methods", ()):
        if name not in config.variants and name != config.synthesizer.name:
            yield f"synthesizer={name}", resolved(method_config(config, name))
    for entry in config.get("egos", {}).values():
        yield f"ego={entry.ego}", OmegaConf.to_container(load_choice("ego", entry.ego))  # as written


def leaves(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted key, value) of every value in nested containers."""
    if isinstance(value, dict | list):
        for name, part in value.items() if isinstance(value, dict) else enumerate(value):
            yield from leaves(part, f"{key}.{name}" if key else str(name))
    else:
        yield key, value
