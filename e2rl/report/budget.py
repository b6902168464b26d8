"""What searches found within several budgets: budget.csv, budget.md and the picture
(docs/search.md).

Intervals are of places. A search with several seeds is the mean of its seeds.
"""

import math
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from e2rl.evaluation.budget import SPENT, TRIES_FILE, Plan, write_tries
from e2rl.evaluation.plan import Evaluation
from e2rl.metrics.realism import Samples, realism
from e2rl.metrics.statistics import (
    LEAST,
    REALISM_DRAWS,
    bootstrap_draws,
    cluster_index,
    exact_interval,
    interval,
    jackknife,
    ratios,
)
from e2rl.report.comparison_tables import searched_table
from e2rl.report.drawing import new_figure, save_figure, without_formulas
from e2rl.report.tables import Table, save_tables
from e2rl.run.files import csv_text, write_atomically
from e2rl.search.tries import TRIES

PANEL = 250  # points, a side
FOUND = ("scenes", "cells", "failures", "clean")
COMPARED = ("scenes", "cells", "clean")  # whose ratios are told
ABOUT = {
    "scenes": "scenes with a preventable failure, %",
    "cells": "cells of the atlas",
    "failures": "preventable failures a scene",
    "clean": "clean failures a scene",
    "real_adv": "realism of adversaries",
}
CAPTION = (
    "95% intervals by place; those of numbers of cells, of which a draw of places has fewer than all places, are of a "
    "jackknife. A cell is approach, partner's manoeuvre, broken duty, side of contact and the ego's speed in bands of "
    "5 m/s. A scene in which the planner raised has failed; of several seeds the mean. Ratios are the "
    "first method's over each other's, in the same draws. Rates of tries are no rates of the planner's: tries go where "
    "failures are."
)


class Found:
    """Resampled values [1 + draws] of what one plan found against one ego within one
    budget; of the cells, what is left without each place [1 + places].

    Args:
        told: lines of tries.csv of one plan and ego, in their order, of all seeds.
        scenes: (location, scene_id) of all scenes.
        budget, unit: see `spend`.
        samples: realism samples of the tries, by (scene_id, seed).
    """

    def __init__(
        self,
        told: Sequence[Mapping],
        scenes: Sequence[tuple[str, str]],
        budget: float,
        unit: str,
        samples: Mapping[tuple[str, int], Samples],
    ) -> None:
        within = [row for row in told if row[unit] <= budget * (1 + 1e-9)]
        place, count = cluster_index(*zip(*scenes, strict=True))
        draws = bootstrap_draws(count)
        number = {scene: k for k, (_, scene) in enumerate(scenes)}
        seeds = sorted({row["seed"] // TRIES for row in told})
        self.spent = dict.fromkeys(SPENT, 0.0)
        self.tried = len(
            {(row["scene_id"], row["seed"] // TRIES) for row in within}
        ) / max(len(seeds), 1)  # scenes
        self.places = dict.fromkeys((*FOUND, "real_adv"), count)
        occurs = {
            name: torch.zeros(count, dtype=torch.bool) for name in (*FOUND, "without")
        }  # at a place
        self.draws: dict[str, Tensor] = {
            name: torch.zeros(len(draws), dtype=torch.float64) for name in FOUND
        }
        self.draws["cells"] = torch.zeros(1 + count, dtype=torch.float64)
        weight = draws @ torch.bincount(place, minlength=count).double()
        for seed in seeds:
            tried = [row for row in within if row["seed"] // TRIES == seed]
            for name in SPENT:
                self.spent[name] += max(
                    (row[name] for row in tried), default=0.0
                ) / len(seeds)
            own = [row for row in tried if row["cell"]]
            at = torch.tensor(
                [number[row["scene_id"]] for row in own], dtype=torch.int64
            )
            crashed = [number[row["scene_id"]] for row in tried if row.get("raised")]
            per_scene = torch.bincount(at, minlength=len(scenes)).double()
            failed = (
                torch.bincount(
                    torch.tensor(crashed, dtype=torch.int64), minlength=len(scenes)
                )
                + per_scene
            )
            clean = torch.bincount(
                at, torch.tensor([float(row["clean"]) for row in own]), len(scenes)
            ).double()
            values = {
                "scenes": 100 * (failed > 0).double(),
                "failures": per_scene,
                "clean": clean,
            }
            occurs["without"][place[failed == 0]] = True
            for name, value in values.items():
                occurs[name][place[value > 0]] = True
                of_place = torch.zeros(count, dtype=torch.float64).index_add(
                    0, place, value
                )
                self.draws[name] += (draws @ of_place) / weight / len(seeds)
            cells = sorted({row["cell"] for row in own})
            there = torch.zeros(count, len(cells), dtype=torch.int64)
            there[
                place[at],
                torch.tensor(
                    [cells.index(row["cell"]) for row in own], dtype=torch.int64
                ),
            ] = 1
            alone = (there * (there.sum(0) == 1)).sum(
                1
            )  # cells that no other place has
            self.draws["cells"] += (
                len(cells) - torch.cat([alone.new_zeros(1), alone])
            ) / len(seeds)
        self.occurs = {name: int(there.sum()) for name, there in occurs.items()}
        known = [row for row in within if (row["scene_id"], row["seed"]) in samples]
        of = torch.tensor(
            [int(place[number[row["scene_id"]]]) for row in known], dtype=torch.int64
        )
        drawn, self.places["real_adv"] = (
            bootstrap_draws(count, REALISM_DRAWS),
            len(of.unique()),
        )
        theirs = [samples[row["scene_id"], row["seed"]] for row in known]
        self.draws["real_adv"] = realism(theirs, of, draws=drawn)["real_adv"]

    def value(self, name: str) -> dict[str, float]:
        """Mean and interval; exact, or none, where few places have or lack a failure
        (`metrics.statistics`); NaN where nothing was tried."""
        if not self.tried:
            return dict.fromkeys(("mean", "low", "high"), math.nan)
        if name == "cells":
            found = jackknife(self.draws[name])
            return found | {"low": max(found["low"], 0.0)}
        found = interval(
            self.draws[name],
            self.places[name] if name == "real_adv" or not self.rare(name) else 0,
        )
        if name == "scenes" and self.rare(name) and self.places[name] >= LEAST:
            low, high = exact_interval(found["mean"] / 100, self.places[name])
            found |= {"low": 100 * low, "high": 100 * high}
        return found

    def rare(self, name: str) -> bool:
        """Whether few places have what is counted, or, of scenes, lack it."""
        return (
            min(
                self.occurs[name],
                self.occurs["without"] if name == "scenes" else math.inf,
            )
            < LEAST
        )

    def ratio(self, other: "Found", name: str) -> dict[str, float]:
        """Mean and interval of this over the other's; no interval where either is rare,
        NaN where one was not tried."""
        if not self.tried or not other.tried:
            return dict.fromkeys(("mean", "low", "high"), math.nan)
        if name == "cells":
            log = jackknife((self.draws[name] / other.draws[name]).log())
            return {key: math.exp(value) for key, value in log.items()}
        places = (
            self.places[name]
            if min(self.occurs[name], other.occurs[name]) >= LEAST
            else 0
        )
        return interval(
            ratios({name: self.draws[name]}, {name: other.draws[name]})[name], places
        )


def budget_rows(
    told: Sequence[Mapping],
    scenes: Sequence[tuple[str, str]],
    budgets: Sequence[float],
    unit: str,
    samples: Mapping[tuple[str, str, str, int], Samples],
    plans: Sequence[str],
) -> list[dict[str, Any]]:
    """A row for each ego, plan and budget: SPENT a scene, FOUND and `real_adv` with
    intervals, and the ratios of the first plan's COMPARED to it.

    samples: realism samples by (ego_policy, method, scene_id, seed).
    """
    rows = []
    for ego in dict.fromkeys(row["ego_policy"] for row in told):
        for budget in budgets:
            found: dict[str, Found] = {}
            for plan in plans:
                own = [
                    row
                    for row in told
                    if row["ego_policy"] == ego and row["method"] == plan
                ]
                of_plan = {
                    key[2:]: value
                    for key, value in samples.items()
                    if key[:2] == (ego, plan)
                }
                found[plan] = Found(
                    own, scenes, budget=budget, unit=unit, samples=of_plan
                )
            first = next(iter(found.values()))
            for plan, one in found.items():
                values = {name: one.value(name) for name in (*FOUND, "real_adv")}
                values |= {
                    f"{name}_ratio": first.ratio(one, name)
                    for name in COMPARED
                    if one is not first
                }
                about = {"ego": ego, "method": plan, "budget": budget, "unit": unit}
                about |= {f"{name}_a_scene": value for name, value in one.spent.items()}
                rows.append(about | {"tried": one.tried} | values)
    return rows


def cell(value: Mapping[str, float], digits: int) -> str:
    """A value with its interval, as text."""
    if not math.isfinite(value["mean"]):
        return "–"
    text = f"{value['mean']:.{digits}f}"
    known = math.isfinite(value["low"]) and math.isfinite(value["high"])
    return (
        f"{text} [{value['low']:.{digits}f}, {value['high']:.{digits}f}]"
        if known
        else text
    )


def knowledge_text(plans: Sequence[Plan]) -> str:
    """Which plans, and of several families which, are told the ego's plan."""
    names = []
    for plan in plans:
        own = [
            family.name
            for family in plan.families
            if plan.traffic[family.name].traffic.knowledge == "plan"
        ]
        names += (
            [
                plan.name
                if len(own) == len(plan.families)
                else f"{plan.name} ({', '.join(own)})"
            ]
            if own
            else []
        )
    return f"Told the ego's plan: {'; '.join(names) or 'nobody'}."


def budget_tables(rows: Sequence[Mapping], scenes: int, knowledge: str) -> list[Table]:
    """A table for each ego, a row for each method and budget."""
    tables = []
    digits = {"scenes": 1, "cells": 1, "failures": 2, "clean": 2, "real_adv": 3}
    for ego in dict.fromkeys(row["ego"] for row in rows):
        own = [row for row in rows if row["ego"] == ego]
        ratios = (f"ratio of {name}" for name in COMPARED)
        head = ["method", own[0]["unit"], "tries", "NFE", "s", *ABOUT.values(), *ratios]
        lines = []
        for row in own:
            some = f" in {row['tried']:.0f} scenes" if row["tried"] < scenes else ""
            spent = [
                f"{row['tries_a_scene']:.1f}{some}",
                f"{row['nfe_a_scene']:.0f}",
                f"{row['seconds_a_scene']:.1f}",
            ]
            over = [
                cell(row[f"{name}_ratio"], 2) if f"{name}_ratio" in row else "–"
                for name in COMPARED
            ]
            values = [cell(row[name], count) for name, count in digits.items()]
            lines.append([row["method"], f"{row['budget']:g}", *spent, *values, *over])
        title = f"Failures of {ego} within a budget, in {own[0]['unit']} a scene"
        tables.append(
            Table(
                f"{scenes} scenes. {CAPTION} {knowledge}", head, rows=lines, title=title
            )
        )
    return tables


def write_budget(path: Path, rows: Sequence[Mapping]) -> None:
    """Write the rows as CSV: a value's interval in NAME_low and NAME_high."""
    flat = [dict(chain(*(ends_of(*item) for item in row.items()))) for row in rows]
    names = list(dict.fromkeys(chain(*flat)))
    write_atomically(
        path,
        csv_text([names, *([line.get(name, "") for name in names] for line in flat)]),
    )


def ends_of(name: str, value: Any) -> list[tuple[str, Any]]:
    """(column, number) of a value, and of the ends of its interval where it has one."""
    if not isinstance(value, Mapping):
        return [(name, value)]
    return [
        (name if end == "mean" else f"{name}_{end}", value[end])
        for end in ("mean", "low", "high")
    ]


def budget_figure(told: Sequence[Mapping], scenes: int) -> Figure:
    """Scenes with a preventable failure [%], and cells, over each of SPENT a scene: a
    line a method, mean of seeds."""
    egos = list(dict.fromkeys(row["ego_policy"] for row in told))
    figure = new_figure(PANEL * len(SPENT), PANEL * 2 * len(egos))
    axes = figure.subplots(2 * len(egos), len(SPENT), squeeze=False)
    for line, ego in enumerate(egos):
        for column, unit in enumerate(SPENT):
            for row, name in enumerate(("scenes", "cells")):
                axis = axes[2 * line + row][column]
                for plan in dict.fromkeys(each["method"] for each in told):
                    own = [
                        each
                        for each in told
                        if each["ego_policy"] == ego and each["method"] == plan
                    ]
                    axis.plot(
                        *curve(own, unit, name=name, scenes=scenes),
                        label=plan,
                        linewidth=1.2,
                    )
                if any(each[unit] > 0 for each in told):
                    axis.set_xscale("log")
                axis.set_xlabel(f"{unit} a scene")
                axis.set_ylabel(f"{ego}: {ABOUT[name]}")
    axes[0][0].legend(fontsize=7, frameon=False)
    without_formulas(figure)
    figure.tight_layout()
    return figure


def curve(
    told: Sequence[Mapping], unit: str, name: str, scenes: int
) -> tuple[list[float], list[float]]:
    """Budgets, and what the tries of all seeds within each have found in the mean."""
    seeds = sorted({row["seed"] // TRIES for row in told})
    known: set[tuple] = set()
    x = []
    y = []
    for row in sorted(told, key=lambda row: row[unit]):
        if row["cell"] or (name == "scenes" and row.get("raised")):
            known.add(
                (
                    row["seed"] // TRIES,
                    row["scene_id"] if name == "scenes" else row["cell"],
                )
            )
        x.append(row[unit])
        y.append(len(known) / len(seeds) * (100 / scenes if name == "scenes" else 1))
    return x, y


def save_budget(
    folder: Path,
    plan: Evaluation,
    told: Sequence[Mapping],
    rows: Sequence[Mapping],
    samples: Sequence[Samples],
) -> None:
    """Write tries.csv, budget.csv, budget.md and the picture of a run's searches; print
    where they lie.

    rows, samples: of the tries' rollouts (`Scored`).
    """
    scenes = plan.scenes
    chosen = range(len(scenes)) if plan.only is None else plan.only
    places = [(scenes.location[k], scenes.scene_id[k]) for k in chosen]
    keys = [
        tuple(row[name] for name in ("ego_policy", "method", "scene_id", "seed"))
        for row in rows
    ]
    by_try = dict(zip(keys, samples, strict=True))
    names = [each.name for each in plan.searches]
    found = budget_rows(
        told,
        places,
        budgets=plan.asked.budget,
        unit=plan.asked.budget_unit,
        samples=by_try,
        plans=names,
    )
    write_tries(folder / TRIES_FILE, told)
    write_budget(folder / "budget.csv", found)
    tables = budget_tables(found, len(places), knowledge=knowledge_text(plan.searches))
    tables += [searched_table(rows, plan.egos)] if len(plan.egos.egos) > 1 else []
    save_tables(folder / "budget.md", tables)
    save_figure(folder / "budget.png", budget_figure(told, len(places)))
    print("", f"all budgets, with intervals: {folder / 'budget.md'}", sep="\n")
