"""Rollouts of some methods with one ego, driven and recorded in one call."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from e2rl.driving.batches import Work, drive_all
from e2rl.driving.setup import Method, Setup
from e2rl.evaluation.record import record
from e2rl.run.parts import NO_PARTS, Parts
from e2rl.sim.rollout_file import ROLLOUTS


def run_protocol(
    setup: Setup,
    methods: Sequence[Method],
    *,
    seeds: Sequence[int],
    folder: Path | None = None,
    processes: int = 1,
    parts: Parts = NO_PARTS,
    **fields: Any,
) -> list[dict]:
    """Returns the rows of metrics.json of every method on every (scene, seed):
    `drive_all`, then `record`.

    Args:
        setup: scenes, ego and simulator.
        methods: of the traffic.
        seeds: of the noise.
        folder: of the run's files (None: nothing is written).
        processes: over which the batches are spread.
        parts: the batches that are on disk.
        fields: added to each row, or further arguments of `metric_rows`.

    Raises:
        InputError: where the traffic lost all rollouts.
    """
    into = folder and folder / ROLLOUTS
    work = Work(into=into, processes=processes, parts=parts)
    scored = drive_all([setup], methods, seeds=seeds, work=work)
    return record(scored, folder, **fields).metrics
