"""The before/after table of an evolution run: the same scenes and seeds, nominal and adversarial, for both policies."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from torch import Tensor

from e2rl.evaluation.protocol import Method, Setup, run_protocol
from e2rl.evaluation.rollout_files import METRICS_FILE, read_metrics, write_metrics
from e2rl.evaluation.rollout_reader import as_rollout_dict, read_rollouts
from e2rl.metrics.score import score_rollouts
from e2rl.metrics.statistics import paired_differences
from e2rl.planners.ego import Ego
from e2rl.run.parts import Parts
from e2rl.run.processes import Processes
from e2rl.run.run import origin_of


@dataclass
class BeforeAfter:
    """Evaluates an ego and keeps the rows of both stages in folder/metrics.json."""

    setup: Setup
    methods: Sequence[Method]
    seeds: Sequence[int]
    folder: Path
    processes: Processes = 1

    def __call__(self, stage: str, ego: Ego, rounds: int) -> list[dict]:
        """Evaluate an ego as `stage` (before or after) that was trained for some rounds; returns the rows of all stages
        so far. A measurement that was cut off goes on.

        The rows of stage `after` are paired with the same method before, under the name `before`.
        """
        setup, folder = replace(self.setup, ego=ego), self.folder / stage
        kept = Parts(self.folder, stage, f"after {rounds} rounds")
        given = {"processes": self.processes, "parts": kept, "stage": stage, **origin_of(self.folder)}
        rows = run_protocol(setup, self.methods, self.seeds, folder, **given)
        if stage == "after":
            for row in rows:
                row["paired"]["before"] = paired_differences(*self._scored("after", row), *self._scored("before", row))
        file = self.folder / METRICS_FILE
        earlier = [row for row in (read_metrics(file) if file.exists() else []) if row.get("stage") != stage]
        write_metrics(file, earlier + rows)
        return read_metrics(file)

    def _scored(self, stage: str, row: dict) -> tuple[list[dict], list[dict[str, Tensor]]]:
        """Rows and realism samples of a stage's rollouts of a row's method, from their files."""
        found = [
            rollout
            for rollout in read_rollouts(self.folder / stage)
            if rollout["method"] == row["method"] and math.isclose(rollout["eta"], row["eta"])
        ]
        return score_rollouts(as_rollout_dict(found))
