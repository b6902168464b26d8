"""`reproduce=RUN_DIR`: the table of a run made again in a new folder, with its
configuration, scenes and weights; with `failure=NAME` one of its failures alone.

The folder may be a stranger's, so what holds for `resume` holds here, too: no code of
its takes part that the command line does not name. Where data and weights lie, and what
fits a machine, is the command line's own.
"""

import json
import math
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from e2rl.evaluation.rollout_files import (
    METRICS_FILE,
    TABLE,
    read_metrics,
    read_rows,
    write_json,
)
from e2rl.metrics.failure_modes import is_failure
from e2rl.run.config import load_config
from e2rl.run.errors import InputError
from e2rl.run.options import check_same_command
from e2rl.run.run import Run, changed, inputs, read_provenance, versions
from e2rl.run.trust import ALWAYS, WRITTEN, check_written, leaves, saved_configuration
from e2rl.scenes.scene_list import SCENES
from e2rl.sim.rollout_file import rollout_key

# of this machine: always the command line's
HERE = ("processes", "data.cache", "data.cache_gb", "data.workers")
# what the command line may set, besides files of weights
MOVED = ("device", "data.path", *HERE)
RESULT = "reproduced.json"
LISTED = "scenes"  # the name of the scenes in provenance.json
# of a row, as far as it has them
IDENTITY = ("stage", "dataset", "split", "method", "ego", "eta", "training")
COUNTS = ("n_scenes", "n_seeds", "n_rollouts", "errored")
CLOSE = 1e-6  # relative difference: rounding of another machine
TIME = "seconds_per_rollout"  # the metric of wall time, which is never the same
SHOWN = 10  # differences in a text


def run_of(config: DictConfig, free: Sequence[str]) -> Run:
    """Returns the run that the command line asks for; with `config.reproduce` the
    configuration of that run, in a new folder.

    Says on stderr where versions differ. Raises InputError where there is no finished
    table, where its configuration names code (`e2rl.run.trust`), for weights that are
    others or not there, and for settings that cannot change.
    """
    if config.failure and not (config.reproduce or config.resume):
        raise InputError(
            f"failure={config.failure}: is one of a run; name its folder by reproduce=RUN_DIR"
        )
    if config.resume or not config.reproduce:
        return Run.of(config, free)
    where = f"reproduce={config.reproduce}"
    former = Path(config.reproduce).resolve()
    whole = config.copy()
    whole.failure = None
    saved = saved_configuration(whole, former, where=where)
    provenance = read_provenance(former)
    check_same_command(
        saved,
        "evaluate",
        where=where,
        command=provenance["command"],
    )
    for name in (METRICS_FILE, SCENES):
        if not (former / name).is_file():
            raise InputError(
                f"{where}: {name} is missing; give a finished run of evaluate.py that "
                "has tables"
            )
    read_metrics(former / METRICS_FILE)  # what is damaged is said now, not at the end
    files = {
        name: value
        for name, value in provenance["inputs"].items()
        if "=" in name and isinstance(value, str)
    }
    choices = provenance["choices"]
    keys = keys_to_move(config, files=files, choices=choices, where=where)
    if "data.path" in keys and OmegaConf.select(saved, "data.split") is None:
        saved.data.split = Path(str(saved.data.path)).stem  # which the path named
    keys |= {key for key in HERE if OmegaConf.select(saved, key) is not None}
    for key in keys:
        OmegaConf.update(saved, key, OmegaConf.select(config, key))
    check_written(saved, former, where, config, load_config())
    saved.plugins = config.plugins
    saved.resume = None
    saved.reproduce = str(former)
    saved.scenes = str(former / SCENES)
    saved.failure = config.failure or saved.failure
    check_weights(config, saved, files=files, where=where)
    if differing := other_versions(saved, provenance):
        print(f"{where}: versions differ: {'; '.join(differing)}", file=sys.stderr)
    return Run(saved, Run.of(config).folder, choices=choices)


def files_of_run(run: Path) -> str:
    """Returns the SHA-256 of a run's data files, "" where it is not known."""
    return str(read_provenance(run)["files"].get(LISTED, ""))


def keys_to_move(
    config: DictConfig,
    files: Collection[str],
    choices: Mapping[str, str],
    where: str,
) -> set[str]:
    """Returns the keys that the command line sets anew.

    Args:
        config: that of the command line.
        files: KEY=PATH of those that the run read.
        choices: the file of each group of the run.
        where: the option that names the run, for messages.

    Raises:
        InputError: for a key that cannot be another than the run's.
    """
    keys = set()
    for override in HydraConfig.get().overrides.task:
        key, _, value = override.lstrip("+~").partition("=")
        if key not in ("reproduce", "failure", *ALWAYS) and choices.get(key) != value:
            keys.add(key)
    fixed = keys.difference(MOVED, WRITTEN, map(setting_of, files))
    if fixed:
        raise InputError(
            f"{where}: is made again as it was; leave out {', '.join(sorted(fixed))} "
            f"(only {', '.join(MOVED)} and files of weights can be others)"
        )
    return keys


def setting_of(name: str) -> str:
    """Returns the key of the configuration in the name of an input, KEY=PATH; of a
    list's entry the list's."""
    key = name.partition("=")[0]
    parent, _, last = key.rpartition(".")
    return parent if last.isdigit() else key


def check_weights(
    config: DictConfig,
    saved: DictConfig,
    files: Mapping[str, str],
    where: str,
) -> None:
    """Raises InputError where a file that the run's configuration named is another one
    now, or not there.

    Args:
        config: that of the command line.
        saved: that of the run, with what the command line sets.
        files: SHA-256 of each KEY=PATH.
        where: the option that names the run, for messages.
    """
    present = {name.partition("=")[0]: value for name, value in inputs(saved)}
    for name, value in files.items():
        key = name.partition("=")[0]
        setting = setting_of(name)
        if key == LISTED or present.get(key) == value:
            continue
        plus = "++" if OmegaConf.select(config, setting) is None else ""
        mend = f"by {plus}{setting}=FILE"
        if key not in present:
            raise InputError(
                f"{where}: {name}: not there; say where the file lies that the run used, {mend}"
            )
        raise InputError(
            f"{where}: {key} is another file than the run's {name} (SHA-256 "
            f"{short(present[key])} instead of {short(value)}); give the one that it "
            f"used, {mend}"
        )


def other_versions(saved: DictConfig, provenance: Mapping[str, Any]) -> list[str]:
    """Returns which versions, and which files in conf/ of methods and egos, are others
    than the run's."""
    recorded = provenance["versions"][-1]
    installed = versions(saved)
    differing = [
        f"{name} {short(recorded.get(name))} then, {short(installed.get(name))} now"
        for name in changed(recorded, installed)
    ]
    present = json.loads(json.dumps(dict(inputs(saved))))
    for name, content in provenance["inputs"].items():
        if not isinstance(content, str) and present.get(name) != content:
            differing.append(f"conf/{name.replace('=', '/')}.yaml")
    return differing


def short(value: Any) -> str:
    """Returns the beginning of a hash or a version."""
    return str(value)[:12] if value else "none"


# --- one failure


def failure_row(run: Path, name: str) -> dict[str, Any]:
    """Returns the row of a run's failure of this name; InputError where the run has
    none."""
    rows = {rollout_key(row): row for row in read_rows(run / TABLE) if is_failure(row)}
    if name not in rows:
        raise InputError(
            f"{name}: none of the {len(rows)} failures of {run}; take a name from its failures.csv"
        )
    return rows[name]


def outcome(before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    """Returns whether a failure, then and now, is the same: with whom the ego collides,
    and when."""
    contacts = ["none", "none"]
    for position, row in enumerate((before, after)):
        if row["cfr"] == 1:
            time = f"{row['contact_time']:.1f} s"
            contacts[position] = f"agent {row['partner']} after {time}"
    if contacts[0] == contacts[1]:
        return f"the same contact: {contacts[0]}"
    return f"another contact: {contacts[1]}; it was {contacts[0]}"


# --- tables


@dataclass(frozen=True)
class Comparison:
    """How the numbers of two tables agree.

    Args:
        equal: how many are equal.
        close: how many differ by CLOSE at most.
        different: (name, then, now) of the others.
    """

    equal: int
    close: int
    different: list[tuple[str, Any, Any]]

    def text(self) -> str:
        """Returns what came of it, in a line for each of the first SHOWN differences."""
        total = self.equal + self.close + len(self.different)
        if self.equal == total:
            return f"all {total:,} numbers of its tables are equal"
        text = f"{self.equal:,} of {total:,} numbers of its tables are equal"
        if self.close:
            text += f", {self.close:,} but for a millionth of them (another machine's rounding)"
        if not self.different:
            return text
        lines = [f"{text}; {len(self.different):,} differ:"]
        for name, *values in self.different[:SHOWN]:
            before, after = (
                f"{value:.6g}" if isinstance(value, float) else value
                for value in values
            )
            lines.append(f"  {name}: {before} then, {after} now")
        if len(self.different) > SHOWN:
            lines.append(f"  and {len(self.different) - SHOWN:,} more")
        return "\n".join(lines)


def compared_with_run(config: DictConfig, folder: Path) -> Comparison:
    """Returns the table in `folder` beside that of the run that it reproduces; also as
    reproduced.json in `folder`."""
    comparison = compare_tables(
        read_metrics(Path(config.reproduce) / METRICS_FILE),
        read_metrics(folder / METRICS_FILE),
    )
    write_json(folder / RESULT, {"run": config.reproduce} | vars(comparison))
    return comparison


def compare_tables(before: Sequence[Mapping], after: Sequence[Mapping]) -> Comparison:
    """Returns how the rows of two metrics.json agree: counts, metrics and paired
    differences, wall times apart."""
    former = numbers_of(before)
    present = numbers_of(after)
    equal = 0
    close = 0
    different = []
    for name in dict.fromkeys([*former, *present]):
        old = former.get(name, "missing")
        new = present.get(name, "missing")
        numbers = all(isinstance(value, int | float) for value in (old, new))
        if old == new or (numbers and math.isnan(old) and math.isnan(new)):
            equal += 1
        elif numbers and math.isclose(old, new, rel_tol=CLOSE, abs_tol=1e-12):
            close += 1
        else:
            different.append((name, old, new))
    return Comparison(equal, close, different=different)


def numbers_of(rows: Sequence[Mapping]) -> dict[str, Any]:
    """Returns {name: value} of every number of some rows."""
    numbers = {}
    for row in rows:
        identity = " ".join(str(row[name]) for name in IDENTITY if name in row)
        parts = {name: row[name] for name in COUNTS if name in row}
        parts |= {"metrics": row["metrics"], "paired": row["paired"]}
        for name, value in leaves(parts):
            if TIME not in name:
                numbers[f"{identity}: {name.removeprefix('metrics.')}"] = value
    return numbers
