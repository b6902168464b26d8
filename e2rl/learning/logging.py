"""Logs a run's scalars to CSV files, TensorBoard, Trackio or offline wandb, and a
curriculum's choices."""

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from torchrl.record.loggers import CSVLogger, TensorboardLogger, WandbLogger
from torchrl.record.loggers.common import Logger
from torchrl.record.loggers.trackio import TrackioLogger

from e2rl.run.config import check_choice, library
from e2rl.run.errors import InputError
from e2rl.run.files import csv_text, write_atomically

GROUPS = ("train", "eval", "curriculum", "synthesizer", "time")
KINDS = ("csv", "tensorboard", "trackio", "wandb", "none")
CHOICES = "curriculum.csv"


class RunLogger:
    """Writes {group/name: number} at steps; NaN is omitted."""

    def __init__(
        self,
        kind: str,
        folder: Path,
        project: str = "e2rl",
        name: str | None = None,
    ) -> None:
        """kind: csv (folder/logs/scalars/<group>/<name>.csv), tensorboard
        (folder/tensorboard), trackio (folder/trackio), wandb (offline, folder/wandb),
        none. Choices are in folder/curriculum.csv in either case but none."""
        self._folder = Path(folder)
        self._logger = _logger(kind, self._folder, project=project, name=name)

    def log(
        self,
        metrics: Mapping[str, float],
        step: int,
        choices: Sequence[Mapping[str, float]] = (),
    ) -> None:
        """Write the metrics of a step, and the rows of a round's choices, which have
        the same columns, below those of earlier rounds; raises InputError for a name
        outside GROUPS."""
        wrong = [
            name
            for name in metrics
            if name.split("/")[0] not in GROUPS or "/" not in name
        ]
        if wrong:
            raise InputError(
                f"metrics {', '.join(wrong)}: begin each with {'/, '.join(GROUPS)}/"
            )
        if self._logger is None:
            return
        numbers = {
            name: float(value)
            for name, value in metrics.items()
            if not math.isnan(value)
        }
        if isinstance(self._logger, WandbLogger):
            # wandb's own step has to be told: by default TorchRL counts steps of each
            # group beside it, and wandb takes every number for a row of its own.
            self._logger.log_metrics(numbers, step=step, override_global_step=True)
        else:
            for name, value in numbers.items():
                self._logger.log_scalar(name, value, step=step)
        if choices:
            path = self._folder / CHOICES
            earlier = lines_before(path, step) if path.is_file() else []
            header = ",".join(choices[0]) + "\n"
            rows = [
                ["" if math.isnan(value) else value for value in row.values()]
                for row in choices
            ]
            write_atomically(path, "".join([header, *earlier, csv_text(rows)]))

    def forget(self, step: int) -> None:
        """Remove the scalars of a step and of later ones from the CSV files, and a line
        that was cut off: a resumed run logs them again."""
        for file in sorted((self._folder / "logs").rglob("*.csv")):
            write_atomically(file, "".join(lines_before(file, step)))

    def close(self) -> None:
        """Finish the run of wandb or Trackio, and write what TensorBoard holds back."""
        if isinstance(self._logger, WandbLogger | TrackioLogger):
            self._logger.experiment.finish()
        elif isinstance(self._logger, TensorboardLogger):
            self._logger.experiment.close()


def _logger(kind: str, folder: Path, project: str, name: str | None) -> Logger | None:
    """TorchRL's logger of a kind; None for none. Raises InputError for one that is
    unknown or not installed."""
    check_choice("logger.kind", kind, choices=KINDS)
    if kind == "csv":
        return CSVLogger("logs", log_dir=str(folder))
    if kind == "wandb":
        return WandbLogger(
            name or folder.name,
            offline=True,
            save_dir=str(folder),
            project=project,
            log_env_packages=False,
        )
    if kind == "tensorboard":
        library("tensorboard", "logger=tensorboard", extra="tensorboard")
        return TensorboardLogger("tensorboard", log_dir=str(folder))
    if kind == "trackio":
        os.environ["TRACKIO_DIR"] = str(folder / "trackio")  # read as it is imported
        library("trackio", "logger=trackio", extra="trackio")
        return TrackioLogger(name or folder.name, project)
    return None


def lines_before(file: Path, step: int) -> list[str]:
    """The whole lines of a CSV file whose first cell is a step before `step`."""
    lines = file.read_text().splitlines(keepends=True)
    whole = [(line.split(",")[0], line) for line in lines if line.endswith("\n")]
    return [line for first, line in whole if first.isdecimal() and int(first) < step]
