"""What searches found within several budgets: budget.csv and budget.md
(docs/guide/evaluate.md).

Intervals are of places. A search with several seeds is the mean of its seeds.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

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
)
from e2rl.report.headline import grouped
from e2rl.report.tables import Table, save_tables
from e2rl.run.files import csv_text, write_atomically
from e2rl.search.tries import TRIES

ABOUT = {  # a value of a row: its column, and digits
    "scenes": ("scenes with a preventable failure, %", 1),
    "cells": ("cells of the atlas", 1),
    "failures": ("preventable failures a scene", 2),
    "clean": ("clean failures a scene", 2),
    "real_adv": ("realism of adversaries", 3),
}
CAPTION = (
    "95% intervals by place; those of numbers of cells, of which a draw of places has "
    "fewer than all places, are of a jackknife. A cell is approach, partner's "
    "manoeuvre, broken duty, side of contact and the ego's speed in bands of 5 m/s. A "
    "scene in which the planner raised has failed; of several seeds the mean. Rates of "
    "tries are no rates of the planner's: tries go where failures are."
)
Scene = tuple[str, str]  # location, scene_id
TryKey = tuple[str, str, str, int]  # ego_policy, method, scene_id, seed
Estimate = dict[str, float]  # mean, low, high
UNTRIED = dict.fromkeys(("mean", "low", "high"), math.nan)


def seed_of(row: Mapping) -> int:
    """The seed of the search that a try is of."""
    return row["seed"] // TRIES


def findings(
    tries: Sequence[dict],
    seeds: Sequence[int],
    *,
    scenes: Sequence[Scene],
    samples: Mapping[TryKey, Samples],
) -> dict[str, Estimate]:
    """What the tries of one method against one ego found, by ABOUT.

    Args:
        tries: rows of tries.csv.
        seeds: of all searches, those without a try too.
        scenes: that the searches had.
        samples: realism samples of tries.

    Returns:
        Means and intervals: exact, or none, where few places have or lack a failure;
        NaN where nothing was tried.
    """
    if not tries:
        return dict.fromkeys(ABOUT, UNTRIED)
    place, places = cluster_index(*zip(*scenes, strict=True))
    number = {scene: index for index, (_, scene) in enumerate(scenes)}
    draws = bootstrap_draws(places)
    weight = draws @ torch.bincount(place, minlength=places).double()
    counts = torch.zeros(len(seeds), 3, len(scenes), dtype=torch.float64)
    alone = torch.zeros(1 + places, dtype=torch.float64)  # cells without each place
    for seed, count in zip(seeds, counts, strict=True):
        cells: dict[str, set[int]] = {}  # and the places that have them
        for row in tries:
            if seed_of(row) != seed:
                continue
            scene = number[row["scene_id"]]
            if row["cell"] or row.get("raised"):
                count[0, scene] = 100
            if row["cell"]:
                count[1, scene] += 1
                count[2, scene] += row["clean"]
                cells.setdefault(row["cell"], set()).add(int(place[scene]))
        left = torch.full((1 + places,), len(cells))
        for owners in cells.values():
            if len(owners) == 1:
                left[1 + owners.pop()] -= 1
        alone += left / len(seeds)
    totals = torch.zeros(len(seeds), 3, places, dtype=torch.float64)
    totals.index_add_(2, place, counts)
    means = torch.zeros(3, len(draws), dtype=torch.float64)
    for total in totals:
        means += (total @ draws.T) / weight / len(seeds)
    having = (totals > 0).any(0).sum(1).tolist()
    lacking = len(place[(counts[:, 0] == 0).any(0)].unique())
    rare = [min(having[0], lacking) < LEAST, *(count < LEAST for count in having[1:])]
    estimates = {
        name: interval(mean, 0 if few else places)
        for name, mean, few in zip(
            ("scenes", "failures", "clean"), means, rare, strict=True
        )
    }
    if rare[0] and places >= LEAST:
        low, high = exact_interval(estimates["scenes"]["mean"] / 100, places)
        estimates["scenes"] |= {"low": 100 * low, "high": 100 * high}
    cells_found = jackknife(alone)
    estimates["cells"] = cells_found | {"low": max(cells_found["low"], 0.0)}
    sampled = [row for row in tries if key_of(row) in samples]
    cluster = place[[number[row["scene_id"]] for row in sampled]]
    values = realism(
        [samples[key_of(row)] for row in sampled],
        cluster,
        draws=bootstrap_draws(places, REALISM_DRAWS),
    )
    estimates["real_adv"] = interval(values["real_adv"], len(cluster.unique()))
    return {name: estimates[name] for name in ABOUT}


def key_of(row: Mapping) -> TryKey:
    return row["ego_policy"], row["method"], row["scene_id"], row["seed"]


def budget_rows(
    tries: Sequence[dict],
    scenes: Sequence[Scene],
    *,
    budgets: Sequence[float],
    unit: str,
    samples: Mapping[TryKey, Samples],
    plans: Sequence[str],
) -> list[dict[str, Any]]:
    """A row for each ego, plan and budget.

    Args:
        tries: rows of tries.csv.
        scenes: that the searches had.
        budgets: of each scene, in `unit`.
        unit: one of SPENT.
        samples: realism samples of the tries.
        plans: names of the methods.

    Returns:
        SPENT a scene, the scenes tried, and `findings`.
    """
    rows = []
    for ego in dict.fromkeys(row["ego_policy"] for row in tries):
        for budget in budgets:
            for plan in plans:
                planned = [
                    row
                    for row in tries
                    if (row["ego_policy"], row["method"]) == (ego, plan)
                ]
                within = [row for row in planned if row[unit] <= budget * (1 + 1e-9)]
                seeds = sorted(set(map(seed_of, planned)))
                searches = grouped(within, seed_of)
                row = {"ego": ego, "method": plan, "budget": budget, "unit": unit}
                for name in SPENT:
                    row[f"{name}_a_scene"] = sum(
                        (
                            max(entry[name] for entry in searches[seed]) / len(seeds)
                            for seed in seeds
                            if seed in searches
                        ),
                        start=0.0,
                    )
                tried = {(entry["scene_id"], seed_of(entry)) for entry in within}
                row["tried"] = len(tried) / max(len(seeds), 1)
                row |= findings(within, seeds, scenes=scenes, samples=samples)
                rows.append(row)
    return rows


def budget_tables(rows: Sequence[dict], scenes: int, knowledge: str) -> list[Table]:
    """A table for each ego, a row for each method and budget."""
    tables = []
    titles = [title for title, _ in ABOUT.values()]
    for ego, group in grouped(rows, lambda row: row["ego"]).items():
        unit = group[0]["unit"]
        lines = []
        for row in group:
            some = f" in {row['tried']:.0f} scenes" if row["tried"] < scenes else ""
            lines.append(
                [
                    row["method"],
                    f"{row['budget']:g}",
                    f"{row['tries_a_scene']:.1f}{some}",
                    f"{row['nfe_a_scene']:.0f}",
                    f"{row['seconds_a_scene']:.1f}",
                    *(cell(row[name], digits) for name, (_, digits) in ABOUT.items()),
                ]
            )
        tables.append(
            Table(
                f"{scenes} scenes. {CAPTION} {knowledge}",
                ["method", unit, "tries", "NFE", "s", *titles],
                rows=lines,
                title=f"Failures of {ego} within a budget, in {unit} a scene",
            )
        )
    return tables


def cell(value: Estimate, digits: int) -> str:
    """A value with its interval, as text."""
    mean, low, high = (f"{value[end]:.{digits}f}" for end in UNTRIED)
    if not math.isfinite(value["mean"]):
        return "–"
    known = math.isfinite(value["low"]) and math.isfinite(value["high"])
    return f"{mean} [{low}, {high}]" if known else mean


def knowledge_text(plans: Sequence[Plan]) -> str:
    """Which plans, and of several families which, are told the ego's plan."""
    names = []
    for plan in plans:
        families = [
            family.name
            for family in plan.families
            if plan.traffic[family.name].traffic.knowledge == "plan"
        ]
        if len(families) == len(plan.families):
            names.append(plan.name)
        elif families:
            names.append(f"{plan.name} ({', '.join(families)})")
    return f"Told the ego's plan: {'; '.join(names) or 'nobody'}."


def write_budget(path: Path, rows: Sequence[Mapping]) -> None:
    """Write the rows as CSV: a value's interval in NAME_low and NAME_high."""
    lines = [dict(flat(row)) for row in rows]
    write_atomically(path, csv_text([lines[0], *(line.values() for line in lines)]))


def flat(row: Mapping) -> Iterator[tuple[str, Any]]:
    """(column, number) of all values of a row, and of the ends of their intervals."""
    for name, value in row.items():
        if name in ABOUT:
            yield name, value["mean"]
            yield f"{name}_low", value["low"]
            yield f"{name}_high", value["high"]
        else:
            yield name, value


def save_budget(
    folder: Path,
    plan: Evaluation,
    *,
    tries: Sequence[dict],
    rows: Sequence[Mapping],
    samples: Sequence[Samples],
) -> None:
    """Write tries.csv, budget.csv and budget.md of a run's searches; print where they
    lie.

    Args:
        folder: of the run.
        plan: what was searched.
        tries: rows of tries.csv.
        rows: of the tries' rollouts (`Scored`).
        samples: realism samples of `rows`.
    """
    scenes = plan.scenes
    chosen = range(len(scenes)) if plan.only is None else plan.only
    values = budget_rows(
        tries,
        [(scenes.location[scene], scenes.scene_id[scene]) for scene in chosen],
        budgets=plan.asked.budget,
        unit=plan.asked.budget_unit,
        samples=dict(zip(map(key_of, rows), samples, strict=True)),
        plans=[search.name for search in plan.searches],
    )
    write_tries(folder / TRIES_FILE, tries)
    write_budget(folder / "budget.csv", values)
    knowledge = knowledge_text(plan.searches)
    tables = budget_tables(values, len(chosen), knowledge=knowledge)
    save_tables(folder / "budget.md", tables)
    print("", f"all budgets, with intervals: {folder / 'budget.md'}", sep="\n")
