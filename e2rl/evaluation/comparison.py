"""Two egos in the same scenes, seeds and traffic, of two runs or of one: which failures
are new, gone, moved.

A search goes on by what it has found, so its tries are no pairs. Of a run with a
budget, scenes are: one fails where a try ends in a preventable failure, and has moved
where the two searches share no way of failing (cell of the atlas).
"""

import re
from collections.abc import Sequence
from itertools import product
from math import inf, isnan
from pathlib import Path
from textwrap import shorten
from typing import Any, NamedTuple

from e2rl.evaluation.rollout_files import TABLE, cell, read_rows
from e2rl.evaluation.summary import scene_rows
from e2rl.metrics.atlas import cell_of
from e2rl.metrics.catalogue import METRICS
from e2rl.metrics.errored import lost, raised
from e2rl.metrics.failure_modes import Row, is_failure
from e2rl.metrics.realism import NO_SAMPLES
from e2rl.metrics.statistics import paired_differences
from e2rl.run.errors import InputError
from e2rl.run.run import changed, read_provenance
from e2rl.scenes.scene_list import SCENES, read_list
from e2rl.search.tries import TRIES, TRIES_FILE

PAIR = ("method", "eta", "scene_id", "seed")
CHANGES = ("new", "gone", "moved", "same")
SHARED = (  # settings and inputs without which rollouts are no pairs
    "scenes",
    "scene",
    "seeds",
    "eta",
    "methods",
    "variants",
    "tries",
    "budget",
    "budget_unit",
    "prior",
    "sim",
    "synthesizer",
    "search",
)
SHOWN = 3  # rollouts that a message names
WIDEST = 40  # letters of a value in a message
DELAY = 0.5  # s from which on a contact has moved: a replan
RATES = {  # what is compared, and the columns of the tables
    "contacts": "cfr",
    "counted": "cfr_counted",
    "preventable": "cfr_preventable",
    "clean": "cfr_clean",
    "contacts_vru": "cfr_vru",
    "contacts_object": "cfr_object",
    "progress": "progress",
}
# contacts with others than vehicles, compared where there are any
OTHERS = ("cfr_vru", "cfr_object")


class Driven(NamedTuple):
    """The rollouts of one ego in one run.

    Args:
        run: its folder.
        ego: its name.
        rows: of rollouts.csv.
        searched: the rollouts are tries of searches.
    """

    run: Path
    ego: str
    rows: list[dict]
    searched: bool

    @classmethod
    def read(cls, run: Path, ego: str | None = None) -> "Driven":
        """Returns the rollouts of a run's ego, None: of its only one; InputError where
        it is not there, and where the run's table lacks rollouts or holds values that
        no rollout has."""
        rows = read_rows(run / TABLE)
        check_values(run, rows)
        egos = list(dict.fromkeys(row["ego_policy"] for row in rows))
        if ego not in egos and (ego or len(egos) != 1):
            raise InputError(
                f"{run}: has the egos {', '.join(egos) or 'none'}; name one by --ego, "
                "or two by --egos"
            )
        ego = ego or egos[0]
        rows = [row for row in rows if row["ego_policy"] == ego]
        driven = cls(run, ego, rows, searched=(run / TRIES_FILE).is_file())
        check_complete(driven)
        return driven

    @property
    def unit(self) -> str:
        """What rates are of."""
        return "searches of a scene" if self.searched else "rollouts"

    def traffic(self) -> dict[tuple[str, float], list[dict]]:
        """Returns the rows of rollouts by method and intensity, errored ones, too."""
        groups: dict[tuple[str, float], list[dict]] = {}
        for row in self.rows:
            groups.setdefault((row["method"], row["eta"]), []).append(row)
        return groups

    def rollouts(self) -> dict[tuple, list[dict]]:
        """Returns the rows of each PAIR: one, or of a search its tries; without those
        that the traffic lost."""
        step = TRIES if self.searched else 1
        groups: dict[tuple, list[dict]] = {}
        for row in self.rows:
            if not lost(row):
                key = (*(row[name] for name in PAIR[:3]), row["seed"] // step)
                groups.setdefault(key, []).append(row)
        return groups

    def units(self) -> dict[tuple[str, float], list[dict]]:
        """Returns the rows that rates are of, by method and intensity: rollouts that
        the traffic did not lose, or of a search its scenes, 1 where any try has what is
        counted."""
        names = [column for column in RATES.values() if METRICS[column].event]
        units = {}
        for key, rows in self.traffic().items():
            counted = [row for row in rows if not lost(row)]
            units[key] = scene_rows(rows, names) if self.searched else counted
        return units


def check_values(run: Path, rows: Sequence[Row]) -> None:
    """Raises InputError, naming it, for a value of RATES that no rollout has: a
    fraction outside of [0, 1], an infinite distance (it is negative where the ego
    reverses), a contact without a verdict; or where no rollout has a value."""
    ended = [row for row in rows if row["errored"] != 1]
    mend = f"restore {TABLE}, or run evaluate.py again"
    for column in RATES.values():
        for row in ended:
            value = row[column]
            possible = 0 <= value <= 1 if METRICS[column].fraction else abs(value) < inf
            if isnan(value):
                possible = row["cfr"] != 1
            if not possible:
                raise InputError(
                    f"{run / TABLE}: {column} of {row['scene_id']}, seed {row['seed']} "
                    f"is {cell(value) or 'empty'}; {mend}"
                )
        if ended and all(isnan(row[column]) for row in ended):
            raise InputError(f"{run / TABLE}: the column {column} is empty; {mend}")


def check_complete(driven: Driven) -> None:
    """Raises InputError, naming some, where scenes and seeds of the run are not in its
    table; of a search nothing is known of scenes that it did not come to."""
    settings = read_provenance(driven.run)["settings"]
    listed = (driven.run / SCENES).is_file()
    if driven.searched or settings.get("failure") or not listed:
        return
    scenes = [line.scene_id for line in read_list(driven.run)]
    if settings.get("scene"):
        scenes = [settings["scene"]]
    expected = list(product(scenes, settings["seeds"]))
    for (method, eta), rows in driven.traffic().items():
        present = {(row["scene_id"], row["seed"]) for row in rows}
        absent = [pair for pair in expected if pair not in present]
        if absent:
            shown = ", ".join(f"{scene} seed {seed}" for scene, seed in absent[:SHOWN])
            raise InputError(
                f"{driven.run / TABLE}: lacks {len(absent)} of {len(expected)} rollouts "
                f"of {method} η={eta:g} ({shown}); go on with resume={driven.run}"
            )


def compared(first: Driven, second: Driven) -> tuple[list[dict], list[dict]]:
    """Returns what has changed in each traffic, and the pairs of rollouts of which one
    has failed (`pair_of`), in the order of CHANGES. Raises InputError, saying what
    differs, where the two are no pairs.

    A traffic has the number `of` units that both have, the numbers of CHANGES and of
    `preventable` ones among them, and paired `differences` of RATES, second minus
    first, of OTHERS where one of the two has any.
    """
    check_shared(first, second)
    ours = first.rollouts()
    theirs = second.rollouts()
    shared = [key for key in ours if key in theirs]
    pairs = []
    for key in shared:
        pair = pair_of(key, ours[key], others=theirs[key], searched=first.searched)
        if pair:
            pairs.append(pair)
    pairs.sort(key=lambda pair: (CHANGES.index(pair["change"]), -pair["preventable"]))
    groups = []
    units = second.units()
    for key, rows in first.units().items():
        others = units.get(key, [])
        values = difference(others, rows)
        differences = {}
        for name, column in RATES.items():
            shown = values[column]["n"] > 0
            if column in OTHERS:
                shown &= any(row[column] == 1 for row in (*rows, *others))
            if shown:
                differences[name] = values[column]
        changes = [
            (pair["change"], pair["preventable"])
            for pair in pairs
            if (pair["method"], pair["eta"]) == key
        ]
        group: dict[str, Any] = {
            "method": key[0],
            "eta": key[1],
            "unit": first.unit,
            "of": sum(pair[:2] == key for pair in shared),
        }
        for name in CHANGES:
            group[name] = sum(change == name for change, _ in changes)
        group["preventable"] = {name: changes.count((name, True)) for name in CHANGES}
        groups.append(group | {"differences": differences})
    return groups, pairs


def difference(
    rows: Sequence[Row], others: Sequence[Row]
) -> dict[str, dict[str, float]]:
    """Returns paired differences of all metrics that need no samples (`paired_differences`)."""
    return paired_differences(
        rows,
        [NO_SAMPLES] * len(rows),
        other_rows=others,
        other_samples=[NO_SAMPLES] * len(others),
        realism_draws=0,
    )


def check_shared(first: Driven, second: Driven) -> None:
    """Raises InputError, saying what differs, where the rollouts of two runs are no
    pairs."""
    provenances = [read_provenance(driven.run) for driven in (first, second)]
    ours, theirs = ({**run["settings"], **run["inputs"]} for run in provenances)
    differing = {}
    for name in changed(ours, theirs):
        setting = re.split("[.=]", name)[0]
        if setting in SHARED and not name.startswith("scenes="):
            differing[name] = SHARED.index(setting)
    texts = {
        name: differing_text(name, ours.get(name), theirs.get(name))
        for name in sorted(differing, key=lambda name: differing[name])
    }
    if "scenes" in texts:
        scenes = [
            {row["scene_id"] for row in driven.rows} for driven in (first, second)
        ]
        texts["scenes"] = (
            f"scenes ({len(scenes[0])} and {len(scenes[1])}, "
            f"{len(scenes[0] & scenes[1])} of one id)"
        )
    if texts:
        raise InputError(
            f"{second.run}: no pairs with {first.run}, which has other "
            f"{', '.join(texts.values())}; run both with the same scenes, seeds, traffic "
            "and prior"
        )


def differing_text(name: str, ours: Any, theirs: Any) -> str:
    """Returns what differs between two values of a setting; of groups key by key."""
    if isinstance(ours, dict) and isinstance(theirs, dict):
        return ", ".join(
            differing_text(f"{name}.{key}", ours.get(key), theirs.get(key))
            for key in sorted({*ours, *theirs})
            if ours.get(key) != theirs.get(key)
        )
    texts = [
        f"[{', '.join(map(str, value))}]" if isinstance(value, list) else str(value)
        for value in (ours, theirs)
    ]
    short = [shorten(text, WIDEST, placeholder="...") for text in texts]
    return f"{name} ({' and '.join(short)})"


def nearness(row: Row) -> tuple[bool, float]:
    """Returns what sorts tries of a scene: the nearest to a preventable failure last, those that
    errored first."""
    return row["margin"] == row["margin"], row["margin"]


def pair_of(
    key: Sequence,
    tries: Sequence[Row],
    others: Sequence[Row],
    searched: bool,
) -> dict[str, Any] | None:
    """Returns two rollouts of one PAIR of which one has failed; None: none has.

    `change` is of CHANGES, `what` differs between two failures: verdict, side of the
    ego, counterpart, time by DELAY; of searches way; ending, where the planner raised
    in one of them. `preventable`: whether one is, as one in which the planner raised
    is.

    Args:
        key: values of PAIR.
        tries: of the first; of a search those that are nearest to a preventable failure
            are shown.
        others: of the second.
        searched: the rollouts are tries of searches.
    """
    first = max(tries, key=nearness)
    second = max(others, key=nearness)
    ways = [{cell_of(row) for row in rows} - {None} for rows in (tries, others)]
    crashed = [any(map(raised, rows)) for rows in (tries, others)]
    failing = ways if searched else [is_failure(first), is_failure(second)]
    failed = [bool(failing[k] or crashed[k]) for k in range(2)]
    if not any(failed):
        return None
    way = searched and all(ways) and not ways[0] & ways[1]
    if any(crashed):
        differs = {"ending": crashed[0] != crashed[1], "way": way}
    elif searched:
        differs = {"way": way}
    else:
        verdicts = ("counted", "at_fault", "preventable")
        delay = abs(first["contact_time"] - second["contact_time"])
        differs = {
            "verdict": any(
                cell(first[name]) != cell(second[name]) for name in verdicts
            ),
            "side": first["contact_type"] != second["contact_type"],
            "counterpart": first["partner"] != second["partner"],
            "time": delay > DELAY + 1e-9,
        }
    changes = [name for name, differing in differs.items() if differing]
    if all(failed):
        change = "moved" if changes else "same"
    else:
        change = "gone" if failed[0] else "new"
        changes = []
    return {
        "change": change,
        "what": changes,
        "preventable": any(map(bool, ways)) or any(crashed),
        **dict(zip(PAIR, key, strict=True)),
        "first": first,
        "second": second,
    }
