"""`reproduce=RUN_DIR`: the table of a run made again in a new folder, with its configuration, scenes and weights.

The folder may be a stranger's, so what holds for `resume` holds here, too: no code of its takes part
that the command line does not name. Where data and weights lie, and what fits a machine, is the command line's own.
"""

import json
import sys
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from e2rl.evaluation.provenance import PROVENANCE, changed, inputs, read_provenance, versions
from e2rl.evaluation.resume import ALWAYS, Run, saved_choices, saved_configuration
from e2rl.evaluation.rollout_files import METRICS_FILE, nulls, read_metrics
from e2rl.evaluation.table_comparison import Comparison, compare_tables
from e2rl.run.errors import InputError
from e2rl.run.files import write_atomically
from e2rl.scenes.scene_list import SCENES

HERE = ("processes", "data.cache", "data.workers")  # always the command line's: of this machine, without influence
MOVED = ("device", "data.path", *HERE)  # what the command line may set, besides files of weights
RESULT = "reproduced.json"
LISTED = "scenes"  # the name of the scenes in provenance.json


def reproduction_of(config: DictConfig) -> Run:
    """The run that `config.reproduce` asks for: the configuration and files of the groups of that run, in a new folder.

    Raises InputError where there is no finished table, where its configuration names code as in `resume.run_of`, for
    weights that are others or not there, and for settings that cannot change. Tells on stderr where versions differ.
    """
    where, old = f"reproduce={config.reproduce}", Path(config.reproduce).resolve()
    choices = saved_choices(where, old)
    saved = saved_configuration(config, old, choices, where)
    known, out = read_provenance(old), Path(HydraConfig.get().runtime.output_dir)
    if known is None or not (old / METRICS_FILE).is_file() or not (old / SCENES).is_file():
        missing = f"{METRICS_FILE}, {SCENES} or {PROVENANCE} is missing"
        raise InputError(f"{where}: {missing}; give a finished run of evaluate.py that has tables")
    if out == old:
        raise InputError(f"{where}: is the folder of this run, too; leave out hydra.run.dir, or name a new folder")
    table = read_metrics(old / METRICS_FILE)
    compare_tables(table, table)  # what is damaged is told now, and not at the end
    files = {name: value for name, value in known["inputs"].items() if "=" in name and isinstance(value, str)}
    _move(config, saved, [_key(name) for name in files], choices, where)
    saved.plugins, saved.resume, saved.reproduce, saved.scenes = config.plugins, None, str(old), str(old / SCENES)
    check_weights(config, saved, files, where)
    tell_versions(saved, known, where)
    _remember(saved, choices, out)
    return Run(saved, out, choices)


def _move(config: DictConfig, saved: DictConfig, files: Collection[str], choices: dict[str, str], where: str) -> None:
    """Set in `saved` what the command line may set anew."""
    given = [item.lstrip("+~").partition("=")[::2] for item in HydraConfig.get().overrides.task]
    names = [name for name, value in given if name not in ("reproduce", *ALWAYS) and choices.get(name) != value]
    if wrong := [name for name in names if name not in (*MOVED, *files)]:
        raise InputError(
            f"{where}: is made again as it was; leave out {', '.join(wrong)} (only {', '.join(MOVED)} and files of "
            "weights can be others)"
        )
    if "data.path" in names and OmegaConf.select(saved, "data.split") is None:  # which names the split otherwise
        saved.data.split = Path(str(saved.data.path)).stem
    for name in {*names, *(key for key in HERE if _has(saved, key))}:
        OmegaConf.update(saved, name, OmegaConf.select(config, name))


def _has(config: DictConfig, key: str) -> bool:
    """Whether a configuration has a dotted key, null or not."""
    parent, _, name = key.rpartition(".")
    inside = OmegaConf.select(config, parent) if parent else config
    return isinstance(inside, DictConfig) and name in inside


def _key(name: str) -> str:
    """The key of the configuration in the name of an input; of a list's entry the list's."""
    key = name.partition("=")[0]
    parent, _, last = key.rpartition(".")
    return parent if last.isdigit() else key


def check_weights(config: DictConfig, saved: DictConfig, files: Mapping[str, str], where: str) -> None:
    """InputError where a file that the run's configuration named is another one now, or not there; files: hash of each
    {key=path: SHA-256}."""
    now = {name.partition("=")[0]: value for name, value in inputs(saved)}
    for name, value in files.items():
        key, setting = name.partition("=")[0], _key(name)
        if key == LISTED:
            continue
        mend = f"{'' if _has(config, setting) else '+'}{setting}=FILE"
        if key not in now:
            raise InputError(f"{where}: {name}: not there; say where the file lies that the run used, by {mend}")
        if now[key] != value:
            raise InputError(
                f"{where}: {key} is another file than the run's {name} (SHA-256 {_short(now[key])} instead of "
                f"{_short(value)}); give the one that it used, by {mend}"
            )


def tell_versions(saved: DictConfig, known: Mapping[str, Any], where: str) -> None:
    """Tell on stderr which versions, and which files in conf/ of methods and egos, are others than the run's."""
    then, now = known["versions"][-1], versions(saved)
    told = [f"{name} {_short(then.get(name))} then, {_short(now.get(name))} now" for name in changed(then, now)]
    before = {name: value for name, value in known["inputs"].items() if not isinstance(value, str)}
    here = json.loads(json.dumps(dict(inputs(saved))))
    told += [f"conf/{name.replace('=', '/')}.yaml" for name, value in before.items() if here.get(name) != value]
    if told:
        print(f"{where}: versions differ: {'; '.join(told)}", file=sys.stderr)


def _short(value: Any) -> str:
    return str(value)[:12] if value else "none"


def _remember(saved: DictConfig, choices: Mapping[str, str], out: Path) -> None:
    """Write the configuration and the groups' files into the new folder, in place of the command line's: so that the
    run can go on, and be reproduced itself."""
    folder = out / ".hydra"
    hydra = OmegaConf.load(folder / "hydra.yaml")
    OmegaConf.update(hydra, "hydra.runtime.choices", dict(choices), merge=False)
    write_atomically(folder / "config.yaml", OmegaConf.to_yaml(saved))
    write_atomically(folder / "hydra.yaml", OmegaConf.to_yaml(hydra))


def files_of_run(config: DictConfig) -> str:
    """SHA-256 of the data files of the run that is reproduced, "" where it is not known."""
    known = read_provenance(Path(config.reproduce)) if config.reproduce else None
    files = known.get("files") if known else None
    return str(files.get(LISTED, "")) if isinstance(files, dict) else ""


def compared_with_run(config: DictConfig, folder: Path) -> Comparison:
    """The table in `folder` beside that of the run that it reproduces; also as reproduced.json in `folder`."""
    found = compare_tables(read_metrics(Path(config.reproduce) / METRICS_FILE), read_metrics(folder / METRICS_FILE))
    content = {"run": config.reproduce, "equal": found.equal, "close": found.close, "different": found.different}
    write_atomically(folder / RESULT, json.dumps(nulls(content), indent=1))
    return found
