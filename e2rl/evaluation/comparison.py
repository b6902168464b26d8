"""Two egos in the same scenes, seeds and traffic, of two runs or of one: which failures
are new, gone, moved.

A search goes on by what it has found, so its tries are no pairs. Of a run with a
budget, scenes are: one fails where a try ends in a preventable failure, and has moved
where the two searches share no way of failing (cell of the atlas).
"""

import math
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from e2rl.evaluation.rollout_files import TABLE, cell, read_run
from e2rl.evaluation.summary import scene_rows
from e2rl.metrics.atlas import cell_of
from e2rl.metrics.catalogue import LATER, METRICS
from e2rl.metrics.errored import lost, raised
from e2rl.metrics.failure_modes import Row, is_failure
from e2rl.metrics.realism import NO_SAMPLES
from e2rl.metrics.statistics import paired_differences
from e2rl.run.errors import InputError
from e2rl.run.run import changed, read_provenance
from e2rl.scenes.scene_list import SCENES, read_list
from e2rl.search.tries import TRIES
from e2rl.search.tries_file import TRIES_FILE

PAIR = ("method", "eta", "scene_id", "seed")
CHANGES = ("new", "gone", "moved", "same")
SHARED = (  # settings and inputs without which rollouts are no pairs
    *(
        "scenes",
        "scene",
        "seeds",
        "eta",
        "methods",
        "variants",
        "tries",
        "budget",
        "budget_unit",
    ),
    *("prior", "sim", "synthesizer", "search"),
)
SHOWN = 3  # rollouts that a message names
DELAY = 0.5  # s from which on a contact has moved: a replan
RATES = {  # what is compared, and the columns of the tables
    **{
        "contacts": "cfr",
        "counted": "cfr_counted",
        "preventable": "cfr_preventable",
        "clean": "cfr_clean",
    },
    **{
        "contacts_vru": "cfr_vru",
        "contacts_object": "cfr_object",
        "progress": "progress",
    },
}
OTHERS = (
    "cfr_vru",
    "cfr_object",
)  # contacts with others than vehicles, compared where there are any


class Driven(NamedTuple):
    """The rollouts of one ego in one run; searched: they are the tries of searches."""

    run: Path
    ego: str
    rows: list[dict]
    searched: bool

    @classmethod
    def read(cls, run: Path, ego: str | None = None) -> "Driven":
        """The rollouts of a run's ego, None: of its only one; InputError where it is
        not there, and where the run's table lacks rollouts or holds values that no
        rollout has."""
        rows = read_run(run)
        check_values(run, rows)
        egos = list(dict.fromkeys(row["ego_policy"] for row in rows))
        if ego not in egos and (ego or len(egos) != 1):
            raise InputError(
                f"{run}: has the egos {', '.join(egos) or 'none'}; name one by --ego, "
                "or two by --egos"
            )
        ego = ego or egos[0]
        driven = cls(
            run,
            ego,
            [row for row in rows if row["ego_policy"] == ego],
            (run / TRIES_FILE).is_file(),
        )
        check_complete(driven)
        return driven

    @property
    def unit(self) -> str:
        """What rates are of."""
        return "searches of a scene" if self.searched else "rollouts"

    def traffic(self) -> dict[tuple[str, float], list[dict]]:
        """The rows of rollouts by method and intensity, errored ones, too."""
        groups: dict[tuple[str, float], list[dict]] = {}
        for row in self.rows:
            groups.setdefault((row["method"], row["eta"]), []).append(row)
        return groups

    def rollouts(self) -> dict[tuple, list[dict]]:
        """The rows of each PAIR: one, or of a search its tries; without those that the
        traffic lost."""
        found: dict[tuple, list[dict]] = {}
        for row in (row for row in self.rows if not lost(row)):
            key = (
                row["method"],
                row["eta"],
                row["scene_id"],
                row["seed"] // (TRIES if self.searched else 1),
            )
            found.setdefault(key, []).append(row)
        return found

    def units(self) -> dict[tuple[str, float], list[dict]]:
        """The rows that rates are of, by method and intensity: rollouts that the
        traffic did not lose, or of a search its scenes, 1 where any try has what is
        counted."""
        names = [column for column in RATES.values() if METRICS[column].event]
        if self.searched:
            return {
                key: scene_rows(rows, names) for key, rows in self.traffic().items()
            }
        return {
            key: [row for row in rows if not lost(row)]
            for key, rows in self.traffic().items()
        }


def check_values(run: Path, rows: Sequence[Row]) -> None:
    """Raises InputError, naming it, for a value of RATES that no rollout has: a
    fraction outside of [0, 1], an infinite distance (it is negative where the ego
    reverses), a contact without a verdict; or where no rollout has a value of a column
    that earlier versions wrote, too."""
    ended = [row for row in rows if row["errored"] != 1]
    for column in RATES.values():
        low, high = (
            (0.0, 1.0)
            if METRICS[column].fraction
            else (-sys.float_info.max, sys.float_info.max)
        )
        wrong = [
            row
            for row in ended
            if not (low <= row[column] <= high or math.isnan(row[column]))
        ]
        unknown = [
            row
            for row in ended
            if row["cfr"] == 1 and math.isnan(row[column]) and column not in LATER
        ]
        mend = f"restore {TABLE}, or run evaluate.py again"
        for row in (wrong or unknown)[:1]:
            place = f"{row['scene_id']}, seed {row['seed']}"
            raise InputError(
                f"{run / TABLE}: {column} of {place} is {cell(row[column]) or 'empty'}; {mend}"
            )
        if (
            ended
            and column not in LATER
            and all(math.isnan(row[column]) for row in ended)
        ):
            raise InputError(f"{run / TABLE}: the column {column} is empty; {mend}")


def check_complete(driven: Driven) -> None:
    """Raises InputError, naming some, where scenes and seeds of the run are not in its
    table; of a search nothing is known of scenes that it did not come to."""
    settings = read_provenance(driven.run)["settings"]
    if (
        driven.searched
        or settings.get("failure")
        or not (driven.run / SCENES).is_file()
    ):
        return
    scenes = (
        [settings["scene"]]
        if settings.get("scene")
        else [line.scene_id for line in read_list(driven.run)]
    )
    for (method, eta), rows in driven.traffic().items():
        known = {(row["scene_id"], row["seed"]) for row in rows}
        absent = [
            (scene, seed)
            for scene in scenes
            for seed in settings["seeds"]
            if (scene, seed) not in known
        ]
        if absent:
            shown = ", ".join(f"{scene} seed {seed}" for scene, seed in absent[:SHOWN])
            expected = len(scenes) * len(settings["seeds"])
            count = f"{len(absent)} of {expected} rollouts of {method} η={eta:g}"
            raise InputError(
                f"{driven.run / TABLE}: lacks {count} ({shown}); go on with resume={driven.run}"
            )


def compared(first: Driven, second: Driven) -> tuple[list[dict], list[dict]]:
    """What has changed in each traffic, and the pairs of rollouts of which one has
    failed (`pair_of`), in the order of CHANGES. Raises InputError, saying what differs,
    where the two are no pairs.

    A traffic has the number `of` units that both have, the numbers of CHANGES and of
    `preventable` ones among them, and paired `differences` of RATES, second minus
    first, of OTHERS where one of the two has any.
    """
    check_shared(first, second)
    ours = first.rollouts()
    theirs = second.rollouts()
    others = second.units()
    groups = []
    pairs = [
        pair_of(key, ours[key], others=theirs[key], searched=first.searched)
        for key in ours
        if key in theirs
    ]
    matched = [pair for pair in pairs if pair]
    matched.sort(key=lambda pair: (CHANGES.index(pair["change"]), -pair["preventable"]))
    for (method, eta), rows in first.units().items():
        other = others.get((method, eta), [])
        values = difference(other, rows)
        shown = [
            name
            for name, column in RATES.items()
            if values[column]["n"]
            and (
                column not in OTHERS or any(row[column] == 1 for row in (*rows, *other))
            )
        ]
        own = [
            pair for pair in matched if (pair["method"], pair["eta"]) == (method, eta)
        ]
        changes = [(pair["change"], pair["preventable"]) for pair in own]
        groups.append(
            {"method": method, "eta": eta, "unit": first.unit}
            | {"of": sum(key[:2] == (method, eta) and key in theirs for key in ours)}
            | {name: sum(change == name for change, _ in changes) for name in CHANGES}
            | {"preventable": {name: changes.count((name, True)) for name in CHANGES}}
            | {"differences": {name: values[RATES[name]] for name in shown}}
        )
    return groups, matched


def difference(
    rows: Sequence[Row], others: Sequence[Row]
) -> dict[str, dict[str, float]]:
    """Paired differences of all metrics that need no samples (`paired_differences`)."""
    samples = [[NO_SAMPLES] * len(each) for each in (rows, others)]
    return paired_differences(
        rows, samples[0], other_rows=others, other_samples=samples[1], realism_draws=0
    )


def check_shared(first: Driven, second: Driven) -> None:
    """Raises InputError, saying what differs, where the rollouts of two runs are no
    pairs."""
    provenances = [read_provenance(one.run) for one in (first, second)]
    inputs_of_runs = [{**one["settings"], **one["inputs"]} for one in provenances]
    names = [
        name
        for name in changed(*inputs_of_runs)
        if re.split("[.=]", name)[0] in SHARED and not name.startswith("scenes=")
    ]
    names.sort(key=lambda name: SHARED.index(re.split("[.=]", name)[0]))
    differences = [
        f"{name} ({' and '.join(str(one.get(name))[:20] for one in inputs_of_runs)})"
        for name in names
    ]
    if names[:1] == ["scenes"]:
        ours, theirs = (
            {row["scene_id"] for row in one.rows} for one in (first, second)
        )
        differences[0] = (
            f"scenes ({len(ours)} and {len(theirs)}, {len(ours & theirs)} of one id)"
        )
    if differences:
        mend = "run both with the same scenes, seeds, traffic and prior"
        raise InputError(
            f"{second.run}: no pairs with {first.run}, which has other "
            f"{', '.join(differences)}; {mend}"
        )


def nearness(row: Row) -> tuple[bool, float]:
    """Sorts tries of a scene: the nearest to a preventable failure last, those that
    errored first."""
    return row["margin"] == row["margin"], row["margin"]


def pair_of(
    key: Sequence, tries: Sequence[Row], others: Sequence[Row], searched: bool
) -> dict[str, Any] | None:
    """Two rollouts of one PAIR of which one has failed, None: none has; of a search the
    tries that are nearest to a preventable failure. `change` is of CHANGES, `what`
    differs between two failures: verdict, side of the ego, counterpart, time by DELAY;
    of searches way; ending, where the planner raised in one of them. `preventable`:
    whether one is, as one in which the planner raised is."""
    first, second = (max(each, key=nearness) for each in (tries, others))
    ways = [{cell_of(row) for row in each} - {None} for each in (tries, others)]
    crashed = [any(map(raised, each)) for each in (tries, others)]
    failing = (
        [bool(each) for each in ways]
        if searched
        else [is_failure(first), is_failure(second)]
    )
    failed = [one or other for one, other in zip(failing, crashed, strict=True)]
    differs = {
        "verdict": any(
            cell(first[name]) != cell(second[name])
            for name in ("counted", "at_fault", "preventable")
        ),
        "side": first["contact_type"] != second["contact_type"],
        "counterpart": first["partner"] != second["partner"],
        "time": abs(first["contact_time"] - second["contact_time"]) > DELAY + 1e-9,
    }
    if searched:
        differs = {"way": all(ways) and not ways[0] & ways[1]}
    if any(crashed):
        differs = {
            "ending": crashed[0] != crashed[1],
            "way": searched and differs["way"],
        }
    changes = [name for name, there in differs.items() if there] if all(failed) else []
    change = (
        ("moved" if changes else "same")
        if all(failed)
        else "gone"
        if failed[0]
        else "new"
    )
    preventable = any(map(bool, ways)) or any(crashed)
    about = {
        "change": change,
        "what": changes,
        "preventable": preventable,
        **dict(zip(PAIR, key, strict=True)),
    }
    return about | {"first": first, "second": second} if any(failed) else None
