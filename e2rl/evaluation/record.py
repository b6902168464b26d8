"""The closed-loop protocol: methods x scenes x seeds with one ego, and the files of a
run (docs/reference/metrics.md)."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from e2rl.driving.batches import Work, drive_all
from e2rl.driving.setup import Method, Scored, Setup
from e2rl.evaluation.modes import find_atlas, find_modes
from e2rl.evaluation.rollout_files import write_rollouts, write_tables
from e2rl.evaluation.summary import empty_rows, group_of, metric_rows
from e2rl.run.parts import NO_PARTS, Parts
from e2rl.sim.rollout_file import ROLLOUTS
from e2rl.traffic.attempt import count_reasons


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
    return record(scored, folder, partial(metric_rows, **fields))


def record(
    scored: Scored, folder: Path | None, summarise: Callable[..., list[dict]]
) -> list[dict]:
    """Returns the rows of metrics.json: summarise(rows, samples), with the counts of
    what errored where they have none.

    Writes rollouts.csv, modes.json, atlas.json, metrics.json and, where rollouts
    errored, errored.json into a folder. A method of which the traffic lost all rollouts
    has a row too, without metrics. Raises InputError where it lost those of all.
    """
    modes = find_modes(scored.rows)
    write_rollouts(folder, scored.rows, scored.errored)
    summary = summarise(scored.rows, scored.samples)
    rows = []
    for row in [*summary, *empty_rows(summary, scored.errored)]:
        errored = [
            attempt for attempt in scored.errored if group_of(attempt) == group_of(row)
        ]
        rows.append({"errored": count_reasons(errored)} | row)
    if folder is not None:
        write_tables(folder, rows, modes=modes, atlas=find_atlas(scored.rows))
    return rows
