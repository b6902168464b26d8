"""Rates of failures in traffic as the prior has it: as files, in words, as tables, and
as the page of their failures. All of it is told from `rates.json`."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import torch
from scipy import stats

from e2rl.driving.setup import Scored
from e2rl.evaluation.rollout_files import NUMBER, nans, read_json, write_json
from e2rl.report.tables import UNKNOWN, Table
from e2rl.run.errors import InputError
from e2rl.run.files import csv_text, misfit, write_atomically
from e2rl.tail.interval import LEVEL, Bounds, Side, ratio_of_ratios
from e2rl.tail.population import ALONE
from e2rl.tail.sampler import EXTINCT, LEAST, REACHED, SPENT
from e2rl.tail.summary import UNITS, SceneRate, as_json, rates_of, unresolved_in

RATES_FILE = "rates.json"
TAIL_FILE = "tail.csv"
LIKELIEST = 10  # scenes whose failures are named
BUDGETS = (5, 10, 20, 50)  # nats
ENDS = {
    REACHED: "failures drawn",
    LEAST: "less likely than rate.least",
    SPENT: "rate.rollouts spent before one was drawn",
    EXTINCT: "all rollouts come equally near, so no further draws",
    ALONE: "nothing is left to chance",
}
WORDS = {"contact": "contacts", "preventable": "preventable failures"}  # of targets
NOTE = (
    "p is that of the prior, which is no road: what it makes of speeds, gaps and routes "
    "beside recordings stands in docs/results/prior.md."
)
BOUNDS = {"value": NUMBER, "low": NUMBER, "high": NUMBER}
SCENE = {
    "scene_id": str,
    "probability": NUMBER,
    "low": NUMBER,
    "high": NUMBER,
    "nats": NUMBER,
    "at_most": NUMBER,
    "km": NUMBER,
    "repetitions": {...: [(int, float)]},
    "rollouts": int,
    "end": str,
    "failures": int,
}
ENTRY = {
    "ego": str,
    "target": str,
    "least": NUMBER,
    "unresolved": NUMBER,
    "rates": {...: {...: BOUNDS}},
    "scenes": [SCENE],
}


@dataclass(frozen=True)
class EgoRates:
    """What was estimated of an ego.

    Args:
        ego: its name.
        target: of the populations.
        least: probability below which it was not looked for.
        unresolved: `summary.unresolved_in` its scenes.
        rates: bounds of each unit of each event.
        scenes: as `summary.as_json` has them, the likeliest failure first.
    """

    ego: str
    target: str
    least: float
    unresolved: float
    rates: Mapping[str, Mapping[str, Bounds]]
    scenes: Sequence[Mapping[str, Any]]

    @classmethod
    def of(
        cls,
        ego: str,
        scenes: Sequence[SceneRate],
        *,
        target: str,
        least: float,
        steps: int,
    ) -> "EgoRates":
        """Returns those of an ego.

        Args:
            ego: its name.
            scenes: the likeliest failure first.
            target: of the populations.
            least: probability below which it was not looked for.
            steps: of a scene.
        """
        rows = [nans(as_json(scene)) for scene in scenes]
        return cls(
            ego,
            target,
            least=least,
            unresolved=unresolved_in(scenes),
            rates=rates_of(scenes, steps),
            scenes=rows,
        )

    @classmethod
    def read(cls, run: Path) -> "list[EgoRates]":
        """Returns those of a run of `e2rl rate`; InputError where its file is
        damaged."""
        entries = read_json(run / RATES_FILE, lambda content: misfit(content, [ENTRY]))
        return [
            cls(
                entry["ego"],
                entry["target"],
                least=entry["least"],
                unresolved=entry["unresolved"],
                rates={
                    event: {
                        unit: Bounds(**nans(bounds)) for unit, bounds in units.items()
                    }
                    for event, units in entry["rates"].items()
                },
                scenes=[nans(scene) for scene in entry["scenes"]],
            )
            for entry in entries
        ]

    def side(self, event: str, scenes: Sequence[str]) -> Side:
        """Returns the estimates of an event in some scenes, and the km driven there.
        Raises InputError where these are not known."""
        by_id = {scene["scene_id"]: scene for scene in self.scenes}
        if set(by_id) != set(scenes):
            raise InputError(
                f"{self.ego}: its scenes are others than those of the run that it is "
                "compared with; rate both in the same scenes"
            )
        rows = [by_id[name] for name in scenes]
        if any(event not in row["repetitions"] for row in rows):
            raise InputError(f"{self.ego}: knows no rate of {event}")
        return Side(
            [torch.tensor(row["repetitions"][event]).double() for row in rows],
            torch.tensor([row["km"] for row in rows], dtype=torch.float64),
            self.unresolved,
        )

    def ratio_to(self, other: "EgoRates", event: str) -> Bounds:
        """Returns its rate of an event per km over another ego's, paired by scene;
        raises as `side`."""
        scenes = [scene["scene_id"] for scene in self.scenes]
        return ratio_of_ratios(self.side(event, scenes), other.side(event, scenes))


def write_rates(folder: Path, egos: Sequence[EgoRates], failures: Scored) -> None:
    """Writes rates.json, and tail.csv with the failures' weights, into a run's
    folder."""
    entries = [
        {
            "ego": ego.ego,
            "target": ego.target,
            "least": ego.least,
            "unresolved": ego.unresolved,
            "rates": {
                event: {unit: bounds._asdict() for unit, bounds in units.items()}
                for event, units in ego.rates.items()
            },
            "scenes": ego.scenes,
        }
        for ego in egos
    ]
    write_json(folder / RATES_FILE, entries)
    columns = ("ego_policy", "scene_id", "seed", "weight", "transport")
    lines = [[row[name] for name in columns] for row in failures.rows]
    write_atomically(folder / TAIL_FILE, csv_text([columns, *lines]))


def summary_lines(ego: EgoRates) -> list[str]:
    """Returns what the run says of an ego, in sentences."""
    rollouts = sum(scene["rollouts"] for scene in ego.scenes)
    reached = sum(scene["end"] == REACHED for scene in ego.scenes)
    rate = ego.rates[ego.target]["1000km"]
    return [
        f"{ego.ego} in traffic as the prior has it: {text(rate)} {WORDS[ego.target]} "
        "per 1,000 km.",
        f"They were drawn in {reached} of {len(ego.scenes)} scenes, by {rollouts:,} "
        "rollouts.",
    ]


def rate_tables(egos: Sequence[EgoRates]) -> list[Table]:
    """Returns the tables of rates, ratios, nats, likeliest failures and ends."""
    rates = [
        [ego.ego, event, *(text(units[unit]) for unit in UNITS)]
        for ego in egos
        for event, units in ego.rates.items()
    ]
    tables = [
        Table(
            f"Rates [95% interval, over scenes and repetitions]. {NOTE}",
            ["ego", "event", "a scene", "an hour", "1,000 km"],
            rows=rates,
        )
    ]
    pairs = [
        [first.ego, second.ego, event, text(first.ratio_to(second, event))]
        for first, second in combinations(egos, 2)
        for event in dict.fromkeys(("contact", first.target))
    ]
    if pairs:
        head = ["ego", "over", "event", "ratio per km"]
        tables.append(Table("Ratios of rates, paired by scene.", head, rows=pairs))
    tables.append(nats_table(egos))
    tables += [table for table in map(likeliest_table, egos) if table.rows]
    ends = [
        [ego.ego, ENDS.get(end, end), str(count)]
        for ego in egos
        for end, count in Counter(scene["end"] for scene in ego.scenes).items()
    ]
    tables.append(
        Table("How the first populations ended.", ["ego", "end", "scenes"], rows=ends)
    )
    return tables


def nats_table(egos: Sequence[EgoRates]) -> Table:
    """Returns in how many scenes a failure costs at most some nats."""
    rows = []
    for ego in egos:
        count = len(ego.scenes)
        for budget in BUDGETS:
            if math.exp(-budget) < ego.least:
                break
            hits = sum(scene["nats"] <= budget for scene in ego.scenes)
            interval = stats.binomtest(hits, count).proportion_ci(LEVEL, "wilson")
            share = f"{hits / count:.0%} [{interval.low:.0%}, {interval.high:.0%}]"
            rows.append([ego.ego, str(budget), f"{hits} of {count}", share])
    return Table(
        "Scenes in which a failure costs at most so many nats, -log p: the least that any "
        "control of the traffic spends on it.",
        ["ego", "nats", "scenes", "share"],
        rows=rows,
    )


def likeliest_table(ego: EgoRates) -> Table:
    """Returns the scenes with an ego's likeliest failures."""
    total = sum(scene["probability"] for scene in ego.scenes)
    rows = [
        [
            scene["scene_id"],
            text(Bounds(scene["probability"], scene["low"], scene["high"])),
            f"{abs(scene['nats']):.1f}",
            f"{scene['probability'] / total:.0%}",
            str(scene["failures"]),
            str(scene["rollouts"]),
        ]
        for scene in ego.scenes[:LIKELIEST]
        if scene["probability"] > 0
    ]
    return Table(
        f"{ego.ego}: where {WORDS[ego.target]} are likeliest; share of all scenes' "
        "probability.",
        ["scene", "p", "nats", "share", "failures drawn", "rollouts"],
        rows=rows,
    )


def text(bounds: Bounds) -> str:
    """Returns an estimate with its interval."""
    if math.isnan(bounds.value):
        return UNKNOWN
    value = number(bounds.value, digits=3)
    if math.isnan(bounds.low):
        return value
    return f"{value} [{number(bounds.low)}, {number(bounds.high)}]"


def number(value: float, digits: int = 2) -> str:
    """Returns a number with some digits, from 100 on with all before the point."""
    return f"{value:,.0f}" if 100 <= value < math.inf else f"{value:.{digits}g}"
