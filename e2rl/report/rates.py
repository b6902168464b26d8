"""Rates of failures in traffic as the prior has it: in words, as tables, and as
files."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

from tabulate import tabulate

from e2rl.evaluation.rollout_files import TABLE, write_json, write_rows
from e2rl.run.files import csv_text, write_atomically
from e2rl.tail.interval import Bounds
from e2rl.tail.rate import ALONE
from e2rl.tail.sampler import EXTINCT, LEAST, REACHED, SPENT
from e2rl.tail.summary import UNITS, SceneRate, as_json, rates_of, ratio

RATES_FILE = "rates.json"
TABLES_FILE = "rates.md"
TAIL_FILE = "tail.csv"
LIKELIEST = 10  # scenes whose failures are named
ENDS = {
    REACHED: "failures drawn",
    LEAST: "less likely than rate.least",
    SPENT: "rate.rollouts spent before one was drawn",
    EXTINCT: "all rollouts come equally near, so no further draws",
    ALONE: "nothing is left to chance",
}
NOTE = (
    "p is that of the prior, which is no road: what it makes of speeds, gaps and routes "
    "beside recordings stands in docs/reference/prior.md."
)


@dataclass(frozen=True)
class EgoRates:
    """What was found of an ego.

    Args:
        ego: its name.
        scenes: the likeliest failure first.
        target: of the populations.
        steps: of a scene.
    """

    ego: str
    scenes: Sequence[SceneRate]
    target: str
    steps: int


def write_rates(folder: Path, egos: Sequence[EgoRates]) -> None:
    """Writes rates.json, rates.md, tail.csv and rollouts.csv into a run's folder."""
    entries = [
        {
            "ego": ego.ego,
            "target": ego.target,
            "rates": {
                rate.event: {
                    unit: bounds._asdict() | {"unresolved": rate.unresolved[unit]}
                    for unit, bounds in rate.bounds.items()
                }
                for rate in rates_of(ego.scenes, ego.steps)
            },
            "scenes": [as_json(scene) for scene in ego.scenes],
        }
        for ego in egos
    ]
    write_json(folder / RATES_FILE, entries)
    write_atomically(folder / TABLES_FILE, ("\n".join(tables(egos)) + "\n").encode())
    rows = [row for ego in egos for scene in ego.scenes for row in scene.failures]
    columns = ("ego_policy", "scene_id", "seed", "weight", "nats")
    lines = [
        [
            row["ego_policy"],
            row["scene_id"],
            row["seed"],
            row["weight"],
            scene.nats,
        ]
        for ego in egos
        for scene in ego.scenes
        for row in scene.failures
    ]
    write_atomically(folder / TAIL_FILE, csv_text([columns, *lines]))
    write_rows(folder / TABLE, rows)


def rate_lines(egos: Sequence[EgoRates]) -> list[str]:
    """Returns what is printed of some egos."""
    lines = []
    for ego in egos:
        rollouts = sum(scene.rollouts for scene in ego.scenes)
        reached = sum(scene.end == REACHED for scene in ego.scenes)
        lines.append(
            f"{ego.ego} in traffic as the prior has it: {ego.target} failures were drawn "
            f"in {reached} of {len(ego.scenes)} scenes, {rollouts:,} rollouts."
        )
    return [*lines, "", *tables(egos), "", NOTE]


def tables(egos: Sequence[EgoRates]) -> list[str]:
    """Returns the tables of rates, ratios, likeliest failures and ends."""
    rates = [
        [
            ego.ego,
            rate.event,
            *(text(rate.bounds[unit]) for unit in UNITS),
            f"at most about {rate.unresolved['1000km']:.2g} more",
        ]
        for ego in egos
        for rate in rates_of(ego.scenes, ego.steps)
    ]
    head = ["ego", "event", "a scene", "an hour", "1,000 km", "unresolved, 1,000 km"]
    lines = [markdown(rates, head), ""]
    pairs = [
        [first.ego, second.ego, event, text(ratio(first.scenes, second.scenes, event))]
        for first, second in combinations(egos, 2)
        for event in ("contact", first.target)
    ]
    if pairs:
        lines += [markdown(pairs, ["ego", "over", "event", "ratio per km"]), ""]
    for ego in egos:
        lines += [markdown(likeliest(ego), LIKELIEST_HEAD), ""]
        ends = [scene.end for scene in ego.scenes]
        counts = [[ENDS[end], ends.count(end)] for end in dict.fromkeys(ends)]
        lines += [markdown(counts, [f"{ego.ego}: populations ended", "scenes"]), ""]
    return lines[:-1]


LIKELIEST_HEAD = ["scene", "p", "nats", "share", "failures drawn", "rollouts"]


def likeliest(ego: EgoRates) -> list[list[str]]:
    """Returns the lines of the scenes with the likeliest failures."""
    total = sum(scene.bounds.value for scene in ego.scenes)
    return [
        [
            scene.scene_id,
            text(scene.bounds),
            f"{scene.nats:.1f}",
            f"{scene.bounds.value / total:.0%}",
            str(len(scene.failures)),
            str(scene.rollouts),
        ]
        for scene in ego.scenes[:LIKELIEST]
        if scene.bounds.value > 0
    ]


def text(bounds: Bounds) -> str:
    """Returns an estimate with its interval."""
    if math.isnan(bounds.low):
        return f"{bounds.value:.3g}"
    return f"{bounds.value:.3g} [{bounds.low:.2g}, {bounds.high:.2g}]"


def markdown(rows: Sequence[Sequence[object]], head: Sequence[str]) -> str:
    """Returns a table in Markdown."""
    return tabulate(rows, head, "pipe", disable_numparse=True)
