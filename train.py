"""Training: `python train.py` runs evolution rounds; `stage=prior` trains a prior, `stage=imitation` an actor."""

import sys
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from e2rl.errors import InputError
from e2rl.evaluation.build import set_up
from e2rl.evaluation.prior_stage import run_prior_stage
from e2rl.report.tables import metric_tables, print_tables


def train_prior(config: DictConfig, folder: Path) -> None:
    """Train a prior and print its nominal closed loop on held-out logs."""
    path, rows = run_prior_stage(config, folder)
    print_tables(metric_tables(rows, f"nominal closed loop of {path.name} on held-out logs, ego replayed"))
    print(f"\ncheckpoint: {path}\nuse it with prior.checkpoint={path}")


STAGES = {"prior": train_prior}


@hydra.main(version_base="1.3", config_path="conf", config_name="train")
def main(config: DictConfig) -> None:
    folder = Path(HydraConfig.get().runtime.output_dir)
    try:
        if config.stage not in STAGES:
            raise InputError(f"stage={config.stage}: choose one of {', '.join(STAGES)}")
        set_up(config)
        STAGES[config.stage](config, folder)
    except InputError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
