"""Rates of an ego over scenes, as they are kept in `rates.json`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from e2rl.driving.scored import Scored
from e2rl.evaluation.rollout_files import (
    NUMBER,
    RATES_FILE,
    nans,
    read_json,
    write_json,
)
from e2rl.metrics.statistics import cluster_index
from e2rl.run.errors import InputError
from e2rl.run.files import csv_text, misfit, write_atomically
from e2rl.tail.interval import Bounds, Side, ratio_of_ratios
from e2rl.tail.summary import SceneRate, as_json, rates_of, unresolved_in

TAIL_FILE = "tail.csv"
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

    @property
    def places(self) -> int:
        """Where its scenes are."""
        return place_of(self.scenes)[1]

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
            place_of(rows)[0],
            unresolved=self.unresolved,
        )

    def ratio_to(self, other: "EgoRates", event: str) -> Bounds:
        """Returns its rate of an event per km over another ego's, paired by scene;
        raises as `side`."""
        scenes = [scene["scene_id"] for scene in self.scenes]
        return ratio_of_ratios(self.side(event, scenes), other.side(event, scenes))


def place_of(rows: Sequence[Mapping[str, Any]]) -> tuple[Tensor, int]:
    """Returns the place [S] of scenes in rates.json, 0 .. P - 1, and P."""
    return cluster_index(
        [row.get("location", "") for row in rows], [row["scene_id"] for row in rows]
    )


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
