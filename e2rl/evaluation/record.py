"""What a run leaves: the rows of its tables, written as they come, and read again by
other commands (docs/reference/metrics.md)."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from e2rl.driving.scored import Scored
from e2rl.evaluation.atlas import find_atlas
from e2rl.evaluation.modes import find_modes, key_of, read_modes
from e2rl.evaluation.rollout_files import (
    ERRORED_FILE,
    METRICS_FILE,
    MODES_FILE,
    TABLE,
    read_metrics,
    read_rows,
    write_tables,
)
from e2rl.evaluation.summary import metric_row, metric_rows
from e2rl.metrics.errored import errored_row
from e2rl.run.errors import InputError
from e2rl.run.parts import read_state
from e2rl.run.run import PARTS, origin_of
from e2rl.run.trust import CONFIG, read_yaml
from e2rl.search.tries import TRIES_FILE


@dataclass(frozen=True)
class Record:
    """What a run found.

    Args:
        rollouts: rows of rollouts.csv.
        metrics: rows of metrics.json.
        modes: content of modes.json.
        searched: the rollouts are tries.
        config: of the evaluation, if it is one.
    """

    rollouts: list[dict]
    metrics: list[dict]
    modes: dict
    searched: bool = False
    config: DictConfig | None = None

    @classmethod
    def read(cls, run: Path) -> "Record":
        """Returns the record in a run's folder; InputError where files are missing or
        damaged."""
        if not (run / METRICS_FILE).is_file():
            raise InputError(
                f"{run}: no {METRICS_FILE}: the run is not finished, or none of its "
                f"rollouts could be scored, as {ERRORED_FILE} says then; `e2rl gate` "
                f"and `e2rl compare` read its {TABLE}"
            )
        return cls(
            metrics=read_metrics(run / METRICS_FILE),
            modes=read_modes(run / MODES_FILE),
            rollouts=read_rows(run / TABLE),
            searched=(run / TRIES_FILE).is_file(),
            config=read_yaml(run / CONFIG) if (run / CONFIG).is_file() else None,
        )

    @classmethod
    def so_far(
        cls,
        run: Path,
        rows: Sequence[dict],
        config: DictConfig | None,
        *,
        searched: bool,
    ) -> "Record":
        """Returns the record of the rows that a run has so far; its metrics have no
        values."""
        rows = [dict(row) for row in rows]  # which `find_modes` changes
        modes = find_modes(rows)
        scenes = len({row["scene_id"] for row in rows})
        origin = origin_of(run)
        metrics = [
            metric_row(
                key_of(group),
                scenes=scenes,
                seeds=0,
                rollouts=group["rollouts"],
                metrics={},
                **origin,
            )
            for group in modes["groups"]
        ]
        return cls(rows, metrics, modes=modes, searched=searched, config=config)

    @classmethod
    def of_parts(cls, run: Path) -> "Record":
        """Returns the record so far of an evaluation that is not finished; InputError
        where its parts are damaged."""
        rows: list[dict] = []
        files = part_files(run)
        try:
            for file in files:
                part, _, errored = read_state(file, run)["value"]
                rows += [*part, *map(errored_row, errored)]
            config = read_yaml(run / CONFIG)
            searched = files[0].parent != run / PARTS
            return cls.so_far(run, rows, config, searched=searched)
        except (ValueError, TypeError, LookupError, AttributeError) as error:
            raise InputError(
                f"{run}: not finished, and its parts are damaged ({error}); go on with "
                f"it by e2rl evaluate resume={run}"
            ) from error


def part_files(run: Path) -> list[Path]:
    """Returns the files of the parts of an evaluation: its rollouts, or tries."""
    tries = sorted((run / PARTS).glob("search-*/tries-*.pt"))
    return tries or sorted((run / PARTS).glob("rollouts-*.pt"))


def record(
    scored: Scored,
    folder: Path | None,
    *,
    config: DictConfig | None = None,
    searched: bool = False,
    **fields: Any,
) -> Record:
    """Returns what rollouts come to, and writes it into a folder: rollouts.csv,
    errored.json where rollouts errored, metrics.json, modes.json, atlas.json.

    Args:
        scored: of all rollouts.
        folder: of the files (None: nothing is written).
        config: of the evaluation, if it is one.
        searched: the rollouts are tries.
        fields: further arguments of `metric_rows`.

    Raises:
        InputError: where the traffic lost all rollouts.
    """
    modes = find_modes(scored.rows)
    metrics = metric_rows(
        scored.rows,
        scored.samples,
        errored=scored.errored,
        searched=searched,
        **fields,
    )
    rollouts = write_tables(
        folder,
        scored.rows,
        scored.errored,
        modes=modes,
        atlas=find_atlas(scored.rows),
        metrics=metrics,
    )
    return Record(rollouts, metrics, modes=modes, searched=searched, config=config)
