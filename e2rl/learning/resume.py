"""`resume=RUN_DIR`: an interrupted run continues in its own folder with its own configuration."""

from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from e2rl.errors import InputError

OVERRIDES = ("rounds", "device", "threads")  # keys that may change when a run is resumed


def resumed(config: DictConfig, folder: Path) -> tuple[DictConfig, Path]:
    """(configuration, folder) of the run `config.resume`, with the OVERRIDES of the command line."""
    if not config.resume:
        return config, folder
    saved_folder = Path(config.resume).resolve()
    file = saved_folder / ".hydra" / "config.yaml"
    if not file.exists():
        raise InputError(
            f"resume={config.resume}: no run found ({file} is missing); give the folder that the "
            "interrupted run printed"
        )
    saved = OmegaConf.load(file)
    assert isinstance(saved, DictConfig)
    given = {item.split("=", 1)[0] for item in HydraConfig.get().overrides.task}
    for key in OVERRIDES:
        if key in given:
            saved[key] = config[key]
    saved.resume = str(saved_folder)
    return saved, saved_folder
