"""Failure modes of a run: modes.json, the column `mode` of rollouts.csv
(docs/reference/metrics.md)."""

from collections.abc import Iterable, Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from statistics import fmean
from types import NoneType

from e2rl.evaluation.rollout_files import read_json
from e2rl.metrics.errored import lost
from e2rl.metrics.failure_modes import (
    FEATURES,
    Row,
    cluster_failures,
    is_failure,
    known_features,
    large_modes,
    medoid,
    mode_name,
)
from e2rl.run.files import misfit
from e2rl.sim.rollout_file import rollout_name

GROUP = ("dataset", "split", "method", "ego_policy", "eta")
key_of = itemgetter(*GROUP)  # of a row of rollouts.csv
OTHER = 0  # number of the small modes together
VERDICTS = (
    "counted",
    "preventable",
    "at_fault",
    "avoidable",
)  # fractions of a mode's failures
MEANS = ("ego_speed", "partner_speed", "relvel")  # m/s
TYPICAL = ("method", "eta", "scene_id", "seed")
NUMBER = (int, float)
SHAPE = {  # what readers of modes.json need
    "failures": int,
    "rollouts": int,
    "unknown": [str],
    "groups": [
        {
            **dict.fromkeys(("dataset", "split", "method", "ego_policy"), str),
            "eta": NUMBER,
        }
        | dict.fromkeys(("rollouts", "failures", "modes"), int)
    ],
    "modes": [
        {
            "mode": int,
            "name": str,
            "count": int,
            "groups": [{"count": int, "fraction": (*NUMBER, NoneType)}],
        }
        | dict.fromkeys((*VERDICTS, *MEANS), (*NUMBER, NoneType))
        | {"typical": {"file": str}}
    ],
}


def find_modes(rows: Sequence[dict]) -> dict:
    """Group the failures among all rows of a run into modes, and return the content of
    modes.json.

    Adds `mode`, the number of the mode, to the rows of failures, in place. Modes that
    are too small are gathered as `other`, number 0. Columns that no failure knows, such
    as `duty`, are named under `unknown` and play no part.
    """
    failures = [row for row in rows if is_failure(row)]
    numbers = cluster_failures(failures)
    for row, number in zip(failures, numbers, strict=True):
        row["mode"] = number
    large = large_modes(numbers)
    used = known_features(failures)
    members = {
        number: [row for row in failures if row["mode"] == number] for number in large
    }
    if len(large) < len(set(numbers)):
        members[OTHER] = [row for row in failures if row["mode"] not in large]
    groups = [
        dict(zip(GROUP, key, strict=True))
        for key in dict.fromkeys(key_of(row) for row in rows)
    ]
    counts = [group_counts(group, rows, members=members) for group in groups]
    return {
        "failures": len(failures),
        "rollouts": sum(not lost(row) for row in rows),
        "unknown": [column for column in FEATURES if failures and column not in used],
        "groups": counts,
        "modes": [
            describe(number, ours, groups=counts) for number, ours in members.items()
        ],
    }


def group_counts(
    group: dict,
    rows: Sequence[Row],
    members: Mapping[int, Sequence[Row]],
) -> dict:
    """A group (dataset, split, method, ego_policy, eta) with its rollouts, failures,
    and modes other than the small ones that have one of its failures."""
    key = key_of(group)
    ours = {
        number: sum(key_of(row) == key for row in failures)
        for number, failures in members.items()
    }
    modes = sum(count > 0 for number, count in ours.items() if number != OTHER)
    rollouts = sum(key_of(row) == key and not lost(row) for row in rows)
    return group | {
        "rollouts": rollouts,
        "failures": sum(ours.values()),
        "modes": modes,
    }


def describe(mode: int, members: Sequence[Row], groups: Sequence[dict]) -> dict:
    """A mode of modes.json: its number, name, failures and their fraction of each
    group's, verdicts, mean speeds [m/s], and its most typical rollout. Fractions and
    means are over the members that know the value, None without any."""
    keys = [key_of(row) for row in members]
    by_group = [keys.count(key_of(group)) for group in groups]
    counting = [
        key for key, row in zip(keys, members, strict=True) if row.get("counted") == 1
    ]
    counts = [counting.count(key_of(group)) for group in groups]
    total = sum(group["failures"] for group in groups)
    typical = members[medoid(members)]
    return {
        "mode": mode,
        "name": "other" if mode == OTHER else mode_name(members),
        "count": len(members),
        "fraction": len(members) / total,
        "groups": [
            {
                "method": group["method"],
                "ego_policy": group["ego_policy"],
                "eta": group["eta"],
                "count": count,
            }
            | {
                "fraction": count / group["failures"] if group["failures"] else None,
                "counted": counted,
            }
            for group, count, counted in zip(groups, by_group, counts, strict=True)
        ],
        **{name: known_mean(members, name) for name in (*VERDICTS, *MEANS)},
        "typical": {name: typical[name] for name in TYPICAL}
        | {"file": rollout_name(typical)},
    }


def known_mean(rows: Iterable[Row], column: str) -> float | None:
    """Mean of a column over the rows that know it."""
    values = [
        float(row[column])
        for row in rows
        if column in row and row[column] == row[column]
    ]
    return fmean(values) if values else None


def _mismatch(found: dict) -> str | None:
    """Which mode does not say what it is of each group, or names a file elsewhere;
    None: none."""
    for mode in found["modes"]:
        if len(mode["groups"]) != len(found["groups"]):
            return f"mode {mode['mode']} is not of the {len(found['groups'])} groups"
        if Path(mode["typical"]["file"]).name != mode["typical"]["file"]:
            return (
                f"mode {mode['mode']} names the file {mode['typical']['file'][:60]!r}"
            )
    return None


def read_modes(path: Path) -> dict:
    """The content of a modes.json; raises InputError where it is none."""
    return read_json(path, lambda found: misfit(found, SHAPE) or _mismatch(found))
