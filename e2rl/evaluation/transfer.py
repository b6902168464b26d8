"""The matrix of planners and sets of attacks: how often each fails in each
(docs/guide/compare.md)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product, starmap
from pathlib import Path
from statistics import median
from typing import Any

from e2rl.evaluation.attack_set import AttackSet
from e2rl.evaluation.rollout_files import NUMBER, nans, read_json, write_json
from e2rl.evaluation.summary import UNKNOWN
from e2rl.metrics.errored import lost
from e2rl.metrics.realism import NO_SAMPLES
from e2rl.metrics.statistics import summarise
from e2rl.run.files import misfit

CROSS_FILE = "cross.json"
REPLAY = "replay"
AGAIN = "again"
MODES = {REPLAY: "against", AGAIN: "again"}  # how methods' names begin
RATES = {"hit": "cfr", "preventable": "cfr_preventable"}
RATE = dict.fromkeys(("mean", "low", "high", "n"), NUMBER)
MATRIX = {
    "egos": [str],
    "sets": [{"name": str, "ego": str, "attacks": int, "scenes": int, "nats": NUMBER}],
    "cells": [{"mode": str, "set": str, "ego": str, **dict.fromkeys(RATES, RATE)}],
}


@dataclass(frozen=True)
class Matrix:
    """How often every planner fails under the attacks of every set, content of
    CROSS_FILE.

    Args:
        egos: the planners that drive.
        sets: `name`, planner, number of attacks and of their scenes, median of nats.
        cells: RATES of each of `egos` under each set, by mode. Where the set or the ego
            is "": of all together, but for planners under their own attacks.
    """

    egos: list[str]
    sets: list[dict[str, Any]]
    cells: list[dict[str, Any]]

    @classmethod
    def of(
        cls,
        egos: Sequence[str],
        sets: Mapping[str, AttackSet],
        rows: Sequence[Mapping],
    ) -> "Matrix":
        """Returns the matrix of rollouts.

        Args:
            egos: the planners that drive.
            sets: by name.
            rows: of rollouts.csv, their methods named after modes and sets.
        """
        cells = []
        for mode, beginning in MODES.items():
            names = {f"{beginning}-{name}": name for name in sets}
            driven = [
                (names[row["method"]], row["ego_policy"], row)
                for row in rows
                if row["method"] in names and not lost(row)
            ]
            for name, ego in product((*sets, ""), (*egos, "")) if driven else ():
                chosen = [
                    row
                    for source, driver, row in driven
                    if name in ("", source)
                    and ego in ("", driver)
                    and ((name and ego) or sets[source].ego != driver)
                ]
                identity = {"mode": mode, "set": name, "ego": ego}
                cells.append(identity | rates_of(chosen))
        return cls(list(egos), list(starmap(facts_of, sets.items())), cells)

    @classmethod
    def read(cls, run: Path) -> "Matrix":
        """Returns the matrix in a run's folder; InputError where its file is
        damaged."""
        content = read_json(run / CROSS_FILE, lambda value: misfit(value, MATRIX))
        sets, cells = (list(map(nans, content[name])) for name in ("sets", "cells"))
        return cls(content["egos"], sets, cells)

    def write(self, run: Path) -> None:
        """Write CROSS_FILE into a run's folder."""
        write_json(run / CROSS_FILE, vars(self))

    def rate(self, mode: str, name: str, ego: str, event: str) -> dict[str, float]:
        """Returns one of RATES of a cell."""
        for cell in self.cells:
            if (cell["mode"], cell["set"], cell["ego"]) == (mode, name, ego):
                return cell[event]
        return UNKNOWN


def facts_of(name: str, attacks: AttackSet) -> dict[str, Any]:
    """Returns what the matrix says of a set."""
    return {
        "name": name,
        "ego": attacks.ego,
        "attacks": len(attacks.rows),
        "scenes": len(attacks.scenes),
        "nats": median(attacks.tracks.nats.sum(1).tolist()),
        "origin": attacks.origin,
    }


def rates_of(rows: Sequence[Mapping]) -> dict[str, dict[str, float]]:
    """Returns RATES of rollouts with intervals over their places."""
    if not rows:
        return dict.fromkeys(RATES, UNKNOWN)
    metrics = summarise(rows, [NO_SAMPLES] * len(rows), realism_draws=0)
    return {event: metrics[column] for event, column in RATES.items()}
