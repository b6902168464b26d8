"""`reproduce=RUN_DIR`: the table of a run made again in a new folder, with its
configuration, scenes and weights; with `failure=NAME` one of its failures alone.

The folder may be a stranger's, so what holds for `resume` holds here, too: no code of
its takes part that the command line does not name. Where data and weights lie, and what
fits a machine, is the command line's own.
"""

import json
import math
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
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
from e2rl.run.run import Run, changed, inputs, read_provenance, versions
from e2rl.run.trust import ALWAYS, WRITTEN, check_written, leaves, saved_configuration
from e2rl.scenes.scene_list import SCENES
from e2rl.sim.rollout_file import rollout_key

HERE = (
    "processes",
    "data.cache",
    "data.cache_gb",
    "data.workers",
)  # of this machine: always the command line's
MOVED = (
    "device",
    "data.path",
    *HERE,
)  # what the command line may set, besides files of weights
RESULT = "reproduced.json"
LISTED = "scenes"  # the name of the scenes in provenance.json
IDENTITY = (
    "stage",
    "dataset",
    "split",
    "method",
    "ego",
    "eta",
    "training",
)  # of a row, as far as it has them
COUNTS = ("n_scenes", "n_seeds", "n_rollouts", "errored")
CLOSE = 1e-6  # relative difference: rounding of another machine
TIME = "seconds_per_rollout"  # the metric of wall time, which is never the same
SHOWN = 10  # differences in a text


def run_of(config: DictConfig, free: Sequence[str]) -> Run:
    """Returns the run that the command line asks for; with `config.reproduce` the
    configuration of that run, in a new folder.

    Tells on stderr where versions differ. Raises InputError where there is no finished
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
    old = Path(config.reproduce).resolve()
    whole = config.copy()
    whole.failure = None
    saved = saved_configuration(whole, old, where=where)
    provenance = read_provenance(old)
    if missing := [
        name for name in (METRICS_FILE, SCENES) if not (old / name).is_file()
    ]:
        raise InputError(
            f"{where}: {missing[0]} is missing; give a finished run of evaluate.py that has tables"
        )
    read_metrics(old / METRICS_FILE)  # what is damaged is told now, and not at the end
    files = {
        name: value
        for name, value in provenance["inputs"].items()
        if "=" in name and isinstance(value, str)
    }
    _move(
        config,
        saved,
        files=[_key(name) for name in files],
        choices=provenance["choices"],
        where=where,
    )
    check_written(saved, old, where, config, load_config())
    saved.plugins = config.plugins
    saved.resume = None
    saved.reproduce = str(old)
    saved.scenes = str(old / SCENES)
    saved.failure = config.failure or saved.failure
    _check_weights(config, saved, files=files, where=where)
    _tell_versions(saved, provenance, where=where)
    return Run(saved, Run.of(config).folder, choices=provenance["choices"])


def files_of_run(run: Path) -> str:
    """Returns the SHA-256 of a run's data files, "" where it is not known."""
    return str(read_provenance(run)["files"].get(LISTED, ""))


def _move(
    config: DictConfig,
    saved: DictConfig,
    files: Collection[str],
    choices: Mapping[str, str],
    where: str,
) -> None:
    """Set in `saved` what the command line may set anew."""
    changed_keys = [
        item.lstrip("+~").partition("=")[::2]
        for item in HydraConfig.get().overrides.task
    ]
    free = ("reproduce", "failure", *ALWAYS)
    names = [
        name
        for name, value in changed_keys
        if name not in free and choices.get(name) != value
    ]
    if wrong := [name for name in names if name not in (*MOVED, *WRITTEN, *files)]:
        raise InputError(
            f"{where}: is made again as it was; leave out {', '.join(wrong)} (only "
            f"{', '.join(MOVED)} and files of "
            "weights can be others)"
        )
    if (
        "data.path" in names and OmegaConf.select(saved, "data.split") is None
    ):  # which names the split otherwise
        saved.data.split = Path(str(saved.data.path)).stem
    for name in {
        *names,
        *(key for key in HERE if OmegaConf.select(saved, key) is not None),
    }:
        OmegaConf.update(saved, name, OmegaConf.select(config, name))


def _key(name: str) -> str:
    """The key of the configuration in the name of an input; of a list's entry the
    list's."""
    key = name.partition("=")[0]
    parent, _, last = key.rpartition(".")
    return parent if last.isdigit() else key


def _check_weights(
    config: DictConfig, saved: DictConfig, files: Mapping[str, str], where: str
) -> None:
    """InputError where a file that the run's configuration named is another one now, or
    not there; files: hash of each {key=path: SHA-256}."""
    present = {name.partition("=")[0]: value for name, value in inputs(saved)}
    for name, value in files.items():
        key = name.partition("=")[0]
        setting = _key(name)
        if key == LISTED:
            continue
        mend = (
            f"{'++' if OmegaConf.select(config, setting) is None else ''}{setting}=FILE"
        )
        if key not in present:
            raise InputError(
                f"{where}: {name}: not there; say where the file lies that the run used, by {mend}"
            )
        if present[key] != value:
            raise InputError(
                f"{where}: {key} is another file than the run's {name} (SHA-256 "
                f"{_short(present[key])} instead of "
                f"{_short(value)}); give the one that it used, by {mend}"
            )


def _tell_versions(saved: DictConfig, known: Mapping[str, Any], where: str) -> None:
    """Tell on stderr which versions, and which files in conf/ of methods and egos, are
    others than the run's."""
    recorded = known["versions"][-1]
    installed = versions(saved)
    differing = [
        f"{name} {_short(recorded.get(name))} then, {_short(installed.get(name))} now"
        for name in changed(recorded, installed)
    ]
    before = {
        name: value
        for name, value in known["inputs"].items()
        if not isinstance(value, str)
    }
    here = json.loads(json.dumps(dict(inputs(saved))))
    differing += [
        f"conf/{name.replace('=', '/')}.yaml"
        for name, value in before.items()
        if here.get(name) != value
    ]
    if differing:
        print(f"{where}: versions differ: {'; '.join(differing)}", file=sys.stderr)


def _short(value: Any) -> str:
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


def outcome(*rows: Mapping[str, Any]) -> str:
    """Returns whether a failure, then and now, is the same: with whom the ego collides,
    and when."""
    hits = [
        f"agent {row['partner']} after {row['contact_time']:.1f} s"
        if row["cfr"] == 1
        else "none"
        for row in rows
    ]
    return (
        f"the same contact: {hits[0]}"
        if hits[0] == hits[1]
        else f"another contact: {hits[1]}; it was {hits[0]}"
    )


# --- tables


@dataclass(frozen=True)
class Comparison:
    """Numbers that are equal, that differ by CLOSE at most, and [name, then, now] of
    those that differ more."""

    equal: int
    close: int
    different: list[tuple[str, Any, Any]]

    def text(self) -> str:
        """Returns what came of it, in a line for each of the first SHOWN differences."""
        total = self.equal + self.close + len(self.different)
        if self.equal == total:
            return f"all {total:,} numbers of its tables are equal"
        said = f"{self.equal:,} of {total:,} numbers of its tables are equal"
        if self.close:
            said += f", {self.close:,} but for a millionth of them (another machine's rounding)"
        if not self.different:
            return said
        lines = [
            f"  {name}: {_shown(then)} then, {_shown(now)} now"
            for name, then, now in self.different[:SHOWN]
        ]
        left_over = len(self.different) - len(lines)
        return "\n".join(
            [
                f"{said}; {len(self.different):,} differ:",
                *lines,
                *([f"  and {left_over:,} more"] * (left_over > 0)),
            ]
        )


def compared_with_run(config: DictConfig, folder: Path) -> Comparison:
    """Returns the table in `folder` beside that of the run that it reproduces; also as
    reproduced.json in `folder`."""
    comparison = compare_tables(
        read_metrics(Path(config.reproduce) / METRICS_FILE),
        read_metrics(folder / METRICS_FILE),
    )
    content = {
        "run": config.reproduce,
        "equal": comparison.equal,
        "close": comparison.close,
        "different": comparison.different,
    }
    write_json(folder / RESULT, content)
    return comparison


def compare_tables(then: Sequence[Mapping], now: Sequence[Mapping]) -> Comparison:
    """Returns how the rows of two metrics.json agree: counts, metrics and paired
    differences, wall times apart."""
    before, after = (
        dict(number for row in rows for number in _numbers(row)) for rows in (then, now)
    )
    equal = close = 0
    different = []
    for name in dict.fromkeys([*before, *after]):
        old = before.get(name, "missing")
        new = after.get(name, "missing")
        both = all(isinstance(value, int | float) for value in (old, new))
        if old == new or (both and math.isnan(old) and math.isnan(new)):
            equal += 1
        elif both and math.isclose(old, new, rel_tol=CLOSE, abs_tol=1e-12):
            close += 1
        else:
            different.append((name, old, new))
    return Comparison(equal, close, different=different)


def _numbers(row: Mapping) -> Iterator[tuple[str, Any]]:
    """(name, value) of every number of a row."""
    named = " ".join(str(row[key]) for key in IDENTITY if key in row)
    parts = {key: row[key] for key in COUNTS if key in row} | {
        "metrics": row["metrics"],
        "paired": row["paired"],
    }
    for key, value in leaves(parts):
        if TIME not in key:
            yield f"{named}: {key.removeprefix('metrics.')}", value


def _shown(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
