"""Two egos in the same scenes, seeds and traffic, of two runs or of one: which failures are new, gone, moved.

A search goes on by what it has found, so its tries are no pairs. Of a run with a budget, scenes are: one has failed
where a try ends in a preventable failure, and has moved where the two searches share no way of failing (cell of the
atlas).
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from e2rl.evaluation.budget import TRIES_FILE, scene_rows
from e2rl.evaluation.rollout_files import TABLE, cell, read_rows
from e2rl.metrics.atlas import by_likelihood, cell_of
from e2rl.metrics.failure_modes import Row, is_failure
from e2rl.metrics.realism import NO_SAMPLES
from e2rl.metrics.statistics import paired_differences
from e2rl.run.errors import InputError
from e2rl.run.run import read_provenance
from e2rl.search.tries import TRIES

PAIR = ("method", "eta", "scene_id", "seed")
CHANGES = ("new", "gone", "moved", "same")
SHARED = ("sim", "prior", "synthesizer", "search", "variants", "methods", "tries", "budget", "budget_unit", "eta")
SHARED += ("seeds", "scene")  # settings without which rollouts are no pairs
OF_FILES = ("prior", "synthesizer")  # inputs without which they are none
VERDICT = ("counted", "at_fault", "preventable")
LATER = 0.5  # s from which on a contact has moved: a replan
RATES = {  # what gates and comparisons tell, by the names that they have there
    "contacts": "cfr",
    "counted": "cfr_counted",
    "preventable": "cfr_preventable",
    "clean": "cfr_clean",
    "progress": "progress",
}
Traffic = tuple[str, float]  # method and intensity


class Driven(NamedTuple):
    """The rollouts of one ego in one run; searched: they are the tries of searches."""

    run: Path
    ego: str
    rows: list[dict]
    searched: bool

    @classmethod
    def read(cls, run: Path, ego: str | None = None) -> "Driven":
        """The rollouts of a run's ego, or of its only one. Raises InputError where it is not there."""
        rows = read_rows(run / TABLE)
        egos = list(dict.fromkeys(row["ego_policy"] for row in rows))
        if ego not in (egos if ego or len(egos) != 1 else [None]):
            raise InputError(f"{run}: {f'has no ego {ego}' if ego else 'which ego'}? choose of {', '.join(egos)}")
        ours = [row for row in rows if ego in (None, row["ego_policy"])]
        return cls(run, ego or egos[0], ours, (run / TRIES_FILE).is_file())

    def units(self) -> dict[Traffic, list[dict]]:
        """The rows that rates are made of, by traffic: rollouts, or of searches whether any try in a scene has it."""
        events = [name for name in RATES.values() if name != "progress"]
        groups: dict[Traffic, list[dict]] = {}
        for row in scene_rows(self.rows, events) if self.searched else self.rows:
            groups.setdefault((row["method"], row["eta"]), []).append(row)
        return groups

    def tries(self) -> dict[tuple, list[dict]]:
        """The rollouts of each (method, eta, scene, seed); several of a search."""
        found: dict[tuple, list[dict]] = {}
        for row in self.rows:
            seed = row["seed"] // TRIES if self.searched else row["seed"]
            found.setdefault((row["method"], row["eta"], row["scene_id"], seed), []).append(row)
        return found


def check_pairs(first: Driven, second: Driven) -> None:
    """Raises InputError, saying what differs, where rollouts of two runs are no pairs."""
    known = [read_provenance(each.run) for each in (first, second)]
    shared = [{name: each["settings"].get(name) for name in SHARED} for each in known]
    files = [{name: value for name, value in each["inputs"].items() if name.startswith(OF_FILES)} for each in known]
    found = [*unlike(*shared), *unlike(*files)]
    if known[0]["inputs"].get("scenes") != known[1]["inputs"].get("scenes"):
        ours, theirs = ({row["scene_id"] for row in each.rows} for each in (first, second))
        found.insert(0, f"scenes ({len(ours)} and {len(theirs)}, {len(ours & theirs)} of one id; contents differ)")
    if found:
        more = f" and {len(found) - 3} more" if len(found) > 3 else ""
        raise InputError(
            f"{second.run}: no pairs with {first.run}, which has other {'; '.join(found[:3])}{more}; run evaluate.py "
            "again with the same scenes, seeds, traffic and prior"
        )


def unlike(first: Any, second: Any, name: str = "") -> Iterator[str]:
    """Each value of nested settings that differs, such as "seeds ([0] and [1])"."""
    if isinstance(first, Mapping) and isinstance(second, Mapping):
        for key in sorted({*first, *second}):
            yield from unlike(first.get(key), second.get(key), f"{name}.{key}" if name else key)
    elif first != second:
        yield f"{name} ({first} and {second})"


def pairs_of(first: Driven, second: Driven) -> list[dict[str, Any]]:
    """Each (method, eta, scene, seed) that both have driven and one has failed: its `change` of CHANGES, `what` has
    moved, and the row of each, `a` and `b`: of a search that of the likeliest failure, or of the try that came nearest
    to one."""
    theirs, searched, found = second.tries(), first.searched, []
    for key, tries in first.tries().items():
        if key not in theirs:
            continue
        rows = [shown(each, searched) for each in (tries, theirs[key])]
        failed = [bool(cell_of(row)) if searched else is_failure(row) for row in rows]
        if any(failed):
            what = (ways_moved(tries, theirs[key]) if searched else moved(*rows)) if all(failed) else []
            change = ("moved" if what else "same") if all(failed) else "gone" if failed[0] else "new"
            about = dict(zip(PAIR, key, strict=True))
            found.append({"change": change, "what": what, **about, "a": rows[0], "b": rows[1]})
    return found


def shown(tries: Sequence[Row], searched: bool) -> Row:
    """The row that stands for the tries of a scene."""
    failures = [row for row in tries if searched and cell_of(row)]
    return min(failures, key=by_likelihood) if failures else max(tries, key=lambda row: row["margin"])


def moved(first: Row, second: Row) -> list[str]:
    """In what two failures of a scene and seed differ: verdict, side of the ego, counterpart, time by LATER."""
    differs = {
        "verdict": [cell(first[name]) for name in VERDICT] != [cell(second[name]) for name in VERDICT],
        "side": first["contact_type"] != second["contact_type"],
        "counterpart": first["partner"] != second["partner"],
        "time": abs(first["contact_time"] - second["contact_time"]) > LATER + 1e-9,
    }
    return [name for name, there in differs.items() if there]


def ways_moved(tries: Sequence[Row], others: Sequence[Row]) -> list[str]:
    """Whether searches of a scene that have both found preventable failures share no way of failing."""
    first, second = ({cell_of(row) for row in each} - {None} for each in (tries, others))
    return [] if first & second else ["way"]


def groups_of(first: Driven, second: Driven, pairs: Sequence[Mapping]) -> list[dict[str, Any]]:
    """What has changed in each traffic that both have driven: the numbers of CHANGES, and the paired differences of
    RATES, second minus first. Raises InputError where they share none."""
    ours, theirs, found = first.units(), second.units(), []
    for (method, eta), rows in ours.items():
        others = theirs.get((method, eta), [])
        same = {(row["scene_id"], row["seed"]) for row in rows} & {(row["scene_id"], row["seed"]) for row in others}
        if not same:
            continue
        changes = [pair["change"] for pair in pairs if (pair["method"], pair["eta"]) == (method, eta)]
        nothing = ([NO_SAMPLES] * len(others), [NO_SAMPLES] * len(rows))
        differences = paired_differences(others, nothing[0], rows, nothing[1], realism_draws=0)
        names = {name: column for name, column in RATES.items() if differences[column]["n"]}
        found.append(
            {"method": method, "eta": eta, "pairs": len(same), "unit": "scenes" if first.searched else "rollouts"}
            | {"unpaired": len(rows) + len(others) - 2 * len(same)}
            | {name: changes.count(name) for name in CHANGES}
            | {"differences": {name: differences[column] for name, column in names.items()}}
        )
    if not found:
        raise InputError(f"{second.run}: no rollout of a scene and seed that {first.run} has, too")
    return found
