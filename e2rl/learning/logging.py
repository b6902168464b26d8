"""Logs scalars of a run to CSV files or an offline wandb run, in named groups."""

import math
from collections.abc import Mapping
from pathlib import Path

from torchrl.record.loggers import CSVLogger, WandbLogger

from e2rl.errors import InputError

GROUPS = ("train", "eval", "curriculum", "synthesizer", "time")
KINDS = ("csv", "wandb", "none")


class RunLogger:
    """Writes {group/name: number} at steps; NaN is omitted."""

    def __init__(self, kind: str, folder: Path, project: str = "e2rl", name: str | None = None) -> None:
        """kind: csv (folder/logs/scalars/<group>/<name>.csv), wandb (offline, folder/wandb), none."""
        if kind not in KINDS:
            raise InputError(f"logger.kind={kind}: choose one of {', '.join(KINDS)}")
        folder, self._logger = Path(folder), None
        if kind == "csv":
            self._logger = CSVLogger("logs", log_dir=str(folder))
        elif kind == "wandb":
            self._logger = WandbLogger(
                name or folder.name, offline=True, save_dir=str(folder), project=project, log_env_packages=False
            )

    def log(self, metrics: Mapping[str, float], step: int) -> None:
        """Write the metrics of a step; raises InputError for a name outside GROUPS."""
        wrong = [name for name in metrics if name.split("/")[0] not in GROUPS or "/" not in name]
        if wrong:
            raise InputError(f"metrics {', '.join(wrong)}: begin each with {'/, '.join(GROUPS)}/")
        if self._logger is not None:
            for name, value in metrics.items():
                if not math.isnan(value):
                    self._logger.log_scalar(name, float(value), step=step)

    def close(self) -> None:
        """Finish the wandb run."""
        if isinstance(self._logger, WandbLogger):
            self._logger.experiment.finish()
