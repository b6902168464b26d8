"""What an evolution run changes: the same scenes and seeds, nominal and adversarial,
for the policies before and after it; the atlas of what a search finds against each; and
how often each fails in traffic as the prior has it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from e2rl.driving.batches import Work, drive_all
from e2rl.driving.scored import Scored
from e2rl.driving.setup import Method, Setup
from e2rl.evaluation.atlas import read_atlas
from e2rl.evaluation.rates import EgoRates, write_rates
from e2rl.evaluation.record import record
from e2rl.evaluation.rollout_files import (
    ATLAS_FILE,
    METRICS_FILE,
    read_metrics,
    write_json,
)
from e2rl.metrics.realism import Samples
from e2rl.metrics.statistics import paired_differences
from e2rl.planners.ego import Ego
from e2rl.run.parts import Parts
from e2rl.run.run import origin_of
from e2rl.search.spending import SearchMethod, search_all
from e2rl.search.tries import SEARCH, TRIES_FILE
from e2rl.search.tries_file import write_tries
from e2rl.sim.rollout_file import ROLLOUTS
from e2rl.tail.rate import Rating
from e2rl.tail.settings import RateSettings
from e2rl.tail.summary import scene_rates
from e2rl.traffic.nominal import NominalTraffic

RATES = "rates"  # folder of a stage


@dataclass
class BeforeAfter:
    """Evaluates an ego and keeps the rows of both stages in folder/metrics.json.

    search: what is tried with `budget` NFE a scene, from the first of the seeds; None:
    there is no search. rates: what is estimated of `prior_traffic`, from the first of
    the seeds; None: nothing.
    """

    setup: Setup
    methods: Sequence[Method]
    seeds: Sequence[int]
    folder: Path
    processes: int = 1
    search: SearchMethod | None = None
    budget: float = 0.0
    rates: RateSettings | None = None
    prior_traffic: NominalTraffic | None = None

    def __call__(self, stage: str, ego: Ego, rounds: int) -> list[dict]:
        """Evaluate an ego as `stage` (before or after) that was trained for some
        rounds; returns the rows of all stages so far. A measurement that was cut off
        goes on.

        The rows of stage `after` are paired with the same method before, under the name
        `before`.
        """
        setup = replace(self.setup, ego=ego)
        folder = self.folder / stage
        parts = Parts(self.folder, stage, about=f"after {rounds} rounds")
        measured = Parts(self.folder, "measured")
        work = Work(folder / ROLLOUTS, self.processes, parts=parts)
        scored = drive_all([setup], self.methods, seeds=self.seeds, work=work)
        if self.search is not None:
            self._search(self.search, setup, work=work, folder=folder / SEARCH)
        if self.rates is not None:
            self._rate(self.rates, setup, work=work, folder=folder / RATES)
        fields: dict[str, Any] = {"stage": stage, **origin_of(self.folder)}
        rows = record(scored, folder, **fields).metrics
        if stage == "before":
            measured.save(stage, None, (scored.rows, scored.samples))
        elif (before := measured.load("before", None)) is not None:
            scores, samples = before
            for row in rows:
                row["paired"]["before"] = paired_differences(
                    *_of_row(row, scored.rows, scored.samples),
                    *_of_row(row, scores, samples),
                )
        file = self.folder / METRICS_FILE
        earlier = read_metrics(file) if file.exists() else []
        others = [row for row in earlier if row.get("stage") != stage]
        write_json(file, others + rows)
        return others + rows

    def _search(
        self,
        method: SearchMethod,
        setup: Setup,
        work: Work,
        folder: Path,
    ) -> None:
        """Write the tries of a stage, their rollouts and their atlas into a folder."""
        work = replace(work, into=folder / ROLLOUTS)
        spent = search_all(
            [setup],
            [method],
            budget=self.budget,
            unit="nfe",
            seeds=self.seeds[:1],
            work=work,
        )
        record(spent.scored, folder, searched=True)
        write_tries(folder / TRIES_FILE, spent.tries)

    def _rate(
        self,
        settings: RateSettings,
        setup: Setup,
        work: Work,
        folder: Path,
    ) -> None:
        """Write how often an ego fails in the prior's traffic into a folder."""
        assert self.prior_traffic is not None
        rating = Rating(setup, self.prior_traffic, settings, seed=self.seeds[0])
        estimates = rating.estimates(replace(work, into=None))
        rates = EgoRates.of(
            setup.ego_name,
            scene_rates(estimates, setup.scenes, target=settings.target),
            target=settings.target,
            least=settings.least,
            steps=setup.scenes.steps,
        )
        folder.mkdir(parents=True, exist_ok=True)
        write_rates(folder, [rates], Scored())

    def ego_rates(self) -> tuple[EgoRates, EgoRates] | None:
        """The rates before and after; None where none were estimated."""
        if self.rates is None:
            return None
        before, after = (
            EgoRates.read(self.folder / stage / RATES)[0]
            for stage in ("before", "after")
        )
        return before, after

    def atlases(self) -> tuple[dict, dict] | None:
        """The atlas before and after (`evaluation.atlas.group_atlas`); None without a
        search."""
        if self.search is None:
            return None
        return self._atlas("before"), self._atlas("after")

    def _atlas(self, stage: str) -> dict:
        return read_atlas(self.folder / stage / SEARCH / ATLAS_FILE)


def _of_row(
    row: dict,
    scores: list[dict],
    samples: list[Samples],
) -> tuple[list[dict], list[Samples]]:
    """What the rollouts of a row of metrics.json scored."""
    places = [
        place
        for place, score in enumerate(scores)
        if (score["method"], score["eta"]) == (row["method"], row["eta"])
    ]
    return [scores[k] for k in places], [samples[k] for k in places]
