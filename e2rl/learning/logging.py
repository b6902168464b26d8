"""Logs a run's scalars and pictures to CSV files, TensorBoard or an offline wandb run, in named groups, and its
curriculum's choices to a CSV.
"""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

from PIL import Image
from torchrl.record.loggers import CSVLogger, TensorboardLogger, WandbLogger
from torchrl.record.loggers.common import Logger

from e2rl.learning.scheduler import COLUMNS, Choice
from e2rl.run.errors import InputError
from e2rl.run.files import write_atomically

GROUPS = ("train", "eval", "curriculum", "synthesizer", "time")
KINDS = ("csv", "tensorboard", "wandb", "none")
CHOICES = "curriculum.csv"


class RunLogger:
    """Writes {group/name: number} at steps, and pictures; NaN is omitted."""

    def __init__(self, kind: str, folder: Path, project: str = "e2rl", name: str | None = None) -> None:
        """kind: csv (folder/logs/scalars/<group>/<name>.csv), tensorboard (folder/tensorboard), wandb (offline,
        folder/wandb), none. Choices are in folder/curriculum.csv in either case but none."""
        self._folder = Path(folder)
        self._logger = _logger(kind, self._folder, project, name)

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

    def show(self, name: str, path: Path, step: int) -> None:
        """Put a picture (PNG) or film (GIF) on the dashboard, if there is one; name: as of a scalar."""
        if isinstance(self._logger, WandbLogger):
            import wandb

            film = path.suffix == ".gif"
            shown = wandb.Video(str(path), format="gif") if film else wandb.Image(str(path))
            self._logger.experiment.log({name: shown}, step=step)
        elif isinstance(self._logger, TensorboardLogger):
            from tensorboard.compat.proto.summary_pb2 import Summary

            with Image.open(path) as image:  # its bytes as they are, since a film moves there, too
                given = {"width": image.width, "height": image.height, "colorspace": 3}
            value = Summary.Value(tag=name, image=Summary.Image(encoded_image_string=path.read_bytes(), **given))
            self._logger.experiment.file_writer.add_summary(Summary(value=[value]), step)

    def forget(self, step: int) -> None:
        """Remove the scalars of a step and of later ones from the CSV files, and a line that was cut off: a resumed run
        logs them again."""
        for file in sorted((self._folder / "logs").rglob("*.csv")):
            whole = [line for line in file.read_text().splitlines(keepends=True) if line.endswith("\n")]
            write_atomically(file, "".join(line for line in whole if int(line.split(",")[0]) < step))

    def close(self) -> None:
        """Finish the wandb run, and write what TensorBoard holds back."""
        if isinstance(self._logger, WandbLogger):
            self._logger.experiment.finish()
        elif isinstance(self._logger, TensorboardLogger):
            self._logger.experiment.close()


def _logger(kind: str, folder: Path, project: str, name: str | None) -> Logger | None:
    """TorchRL's logger of a kind; None for none. Raises InputError for one that is unknown or not installed."""
    if kind not in KINDS:
        raise InputError(f"logger.kind={kind}: choose one of {', '.join(KINDS)}")
    if kind == "csv":
        return CSVLogger("logs", log_dir=str(folder))
    if kind == "wandb":
        given = {"offline": True, "save_dir": str(folder), "project": project, "log_env_packages": False}
        return WandbLogger(name or folder.name, **given)
    if kind == "tensorboard":
        if find_spec("tensorboard") is None:
            raise InputError(
                "logger=tensorboard: tensorboard is not installed; install e2rl with its extra: pip install "
                "'e2rl[tensorboard]'"
            )
        return TensorboardLogger("tensorboard", log_dir=str(folder))
    return None


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
    try:
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file, strict=True))
        return [{name: kind(row[name] or "nan") for name, kind in COLUMNS.items()} for row in rows]
    except (KeyError, ValueError, TypeError, csv.Error) as error:
        raise InputError(f"{path}: no table of a curriculum's choices ({error}); remove it") from None
