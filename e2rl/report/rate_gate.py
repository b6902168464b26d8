"""Rules on rates of `e2rl rate`, or on their ratio to those of a former run
(docs/guide/rate.md)."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from e2rl.evaluation.rollout_files import NUMBER, nans, read_json
from e2rl.report.gate import FAILED, PASSED, UNDECIDED
from e2rl.report.rates import RATES_FILE, text
from e2rl.run.errors import InputError
from e2rl.run.files import misfit
from e2rl.tail.interval import Bounds, ratio_of_ratios
from e2rl.tail.summary import EVENTS, UNITS

PATTERN = re.compile(
    rf"(?P<event>{'|'.join(EVENTS)})_per_(?P<unit>{'|'.join(UNITS)})"
    r"\s*<=\s*(?P<ratio>x?)(?P<limit>\d*\.?\d+(?:e-?\d+)?)"
)
BOUNDS = {"value": NUMBER, "low": NUMBER, "high": NUMBER, "unresolved": NUMBER}
SCENE = {"scene_id": str, "km": NUMBER, "repetitions": {...: [(int, float)]}}
ENTRY = {"ego": str, "target": str, "rates": {...: {...: BOUNDS}}, "scenes": [SCENE]}
Side = tuple[Sequence[torch.Tensor], torch.Tensor]


@dataclass(frozen=True)
class RateRun:
    """One ego of a run of `e2rl rate`; entry: of its rates.json."""

    run: Path
    entry: Mapping[str, Any]

    @classmethod
    def read(cls, run: Path, ego: str | None) -> "RateRun":
        """Returns the run's only ego, or the one of a name. Raises InputError where
        there is none, or the file is damaged."""
        entries = read_json(run / RATES_FILE, lambda content: misfit(content, [ENTRY]))
        chosen = [entry for entry in entries if ego in (None, entry["ego"])]
        if len(chosen) != 1:
            names = ", ".join(entry["ego"] for entry in entries)
            raise InputError(f"{run}: has {names}; name one of them by --ego")
        return cls(run, chosen[0])

    def side(self, event: str, scenes: Sequence[str]) -> Side:
        """Returns the estimates of an event in some scenes, and the km driven there.
        Raises InputError where these are not known."""
        by_id = {scene["scene_id"]: scene for scene in self.entry["scenes"]}
        missing = [name for name in scenes if name not in by_id]
        if missing or set(by_id) != set(scenes):
            raise InputError(
                f"{self.run}: its scenes are others than those of the run that it is "
                "compared with; rate both in the same scenes"
            )
        rows = [by_id[name] for name in scenes]
        if any(event not in row["repetitions"] for row in rows):
            raise InputError(f"{self.run}: knows no rate of {event}")
        return (
            [torch.tensor(row["repetitions"][event]).double() for row in rows],
            torch.tensor([float(row["km"]) for row in rows], dtype=torch.float64),
        )

    @property
    def scenes(self) -> list[str]:
        """Their ids."""
        return [scene["scene_id"] for scene in self.entry["scenes"]]


def judged_rate(rule: str, run: RateRun, former: RateRun | None) -> dict[str, Any]:
    """Returns what becomes of a rule such as 'preventable_per_1000km<=2', or with a
    `former` run 'preventable_per_1000km<=x1.2', a limit on the ratio to it: `outcome`,
    `reason`, value and interval.

    Raises InputError where it is no rule, or on what the run does not know.
    """
    match = PATTERN.fullmatch(rule.strip())
    if match is None or bool(match["ratio"]) > (former is not None):
        events = ", ".join(EVENTS)
        raise InputError(
            f"{rule!r}: no rule on a run of e2rl rate; write EVENT_per_UNIT<=LIMIT, such "
            "as 'preventable_per_1000km<=2', or with --against RUN a limit on the ratio, "
            f"'preventable_per_1000km<=x1.2'; events: {events}; units: {', '.join(UNITS)}"
        )
    event = match["event"]
    limit = float(match["limit"])
    if match["ratio"] and former is not None:
        sides = [part.side(event, run.scenes) for part in (run, former)]
        bounds = ratio_of_ratios(sides[0], sides[1])
    else:
        rates = run.entry["rates"].get(event)
        if rates is None:
            raise InputError(
                f"{rule}: {run.run} knows no rate of {event}; its target was "
                f"{run.entry['target']}"
            )
        values = nans(rates[match["unit"]])
        high = values["high"] + values["unresolved"]
        bounds = Bounds(values["value"], values["low"], high=high)
    outcome = UNDECIDED
    if bounds.high <= limit:
        outcome = PASSED
    elif bounds.low > limit:
        outcome = FAILED
    reason = f"{rule}: found {text(bounds)}, {len(run.scenes)} scenes"
    if outcome == UNDECIDED and bounds.value != limit and math.isfinite(bounds.value):
        end = bounds.high if bounds.value < limit else bounds.low
        factor = ((end - bounds.value) / (limit - bounds.value)) ** 2
        more = math.ceil(len(run.scenes) * max(factor - 1, 0))
        reason += f"; about {more} more scenes would tell" if more else ""
    return {
        "rule": rule,
        "outcome": outcome,
        "reason": f"{outcome}: {reason}",
        "value": bounds.value,
        "low": bounds.low,
        "high": bounds.high,
        "n": len(run.scenes),
    }
