"""Logs a run's scalars to CSV files or an offline wandb run, in named groups, and its curriculum's choices to a CSV."""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from torchrl.record.loggers import CSVLogger, WandbLogger

from e2rl.errors import InputError
from e2rl.files import write_atomically
from e2rl.learning.curriculum.outcomes import COLUMNS, Choice

GROUPS = ("train", "eval", "curriculum", "synthesizer", "time")
KINDS = ("csv", "wandb", "none")
CHOICES = "curriculum.csv"


class RunLogger:
    """Writes {group/name: number} at steps; NaN is omitted."""

    def __init__(self, kind: str, folder: Path, project: str = "e2rl", name: str | None = None) -> None:
        """kind: csv (folder/logs/scalars/<group>/<name>.csv), wandb (offline, folder/wandb), none. Choices are in
        folder/curriculum.csv in either case but none."""
        if kind not in KINDS:
            raise InputError(f"logger.kind={kind}: choose one of {', '.join(KINDS)}")
        self._folder = folder = Path(folder)
        self._logger: CSVLogger | WandbLogger | None = None
        if kind == "csv":
            self._logger = CSVLogger("logs", log_dir=str(folder))
        elif kind == "wandb":
            self._logger = WandbLogger(
                name or folder.name, offline=True, save_dir=str(folder), project=project, log_env_packages=False
            )

    def log(self, metrics: Mapping[str, float], step: int, choices: Sequence[Choice] = ()) -> None:
        """Write the metrics of a step, and the rows of a round's choices beside those of earlier rounds; raises
        InputError for a name outside GROUPS."""
        wrong = [name for name in metrics if name.split("/")[0] not in GROUPS or "/" not in name]
        if wrong:
            raise InputError(f"metrics {', '.join(wrong)}: begin each with {'/, '.join(GROUPS)}/")
        if self._logger is not None:
            for name, value in metrics.items():
                if not math.isnan(value):
                    self._logger.log_scalar(name, float(value), step=step)
            if choices:
                path = self._folder / CHOICES
                earlier = [row for row in read_choices(path) if int(row["round"]) < step]  # a resumed run repeats some
                write_choices(path, [*earlier, *choices])

    def close(self) -> None:
        """Finish the wandb run."""
        if isinstance(self._logger, WandbLogger):
            self._logger.experiment.finish()


def write_choices(path: Path, rows: Sequence[Choice]) -> None:
    """Write the table of a curriculum's choices; unknown numbers stay empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in rows:
        writer.writerow(["" if row[name] != row[name] else row[name] for name in COLUMNS])
    write_atomically(path, text.getvalue())


def read_choices(path: Path) -> list[Choice]:
    """The rows of a curriculum's choices, numbers but for the template; [] without the file.

    Raises InputError for a file that is no such table.
    """
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    try:
        return [{name: kind(row[name] or "nan") for name, kind in COLUMNS.items()} for row in rows]
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(f"{path}: no table of a curriculum's choices ({error}); remove it") from None
