"""Training: `python train.py` runs evolution rounds; `stage=prior` trains a prior, `stage=imitation` an actor,
`stage=bits` the ego bits."""

import sys
from math import nan
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from tqdm import tqdm

from e2rl.build import build_ego, build_prior, build_traffic, caption, resolved, set_up
from e2rl.ending import ending
from e2rl.errors import InputError
from e2rl.learning.build import build_evolution, build_logger, build_measure, check_training, run_bits, run_imitation
from e2rl.learning.checkpoint import checkpoints, load_checkpoint, save_checkpoint
from e2rl.learning.prior_training.distributed import follower_overrides, started_by_torchrun
from e2rl.learning.prior_training.stage import run_prior_stage
from e2rl.learning.resume import resumed
from e2rl.report.rounds import draw_round, round_line
from e2rl.report.tables import metric_tables, print_tables, save_tables
from e2rl.scene.source import load_scenes


def evolve(config: DictConfig, folder: Path) -> None:
    """Rounds of Algorithm 1: synthesize D' against the current ego, improve the ego on it, move the curriculum."""
    prior, origin = build_prior(config, config.device)  # before the scenes, which take longer than a wrong path
    traffic, ego = build_traffic(config.synthesizer, prior), build_ego(config)
    scenes = load_scenes(config.data, config.num_scenes, split="train")
    run, logger = build_evolution(config, scenes, ego, traffic, folder=folder), build_logger(config, folder)
    measure = build_measure(config, ego, HydraConfig.get().runtime.choices["ego"], traffic, prior, folder)
    begun = config.resume and checkpoints(config.resume)  # a run can be cut off in the measurement before
    done = load_checkpoint(config.resume, run) if begun else 0
    if done == 0:
        measure("before", run.ego)
        save_checkpoint(folder, run, resolved(config), config.keep_last)
    bar = tqdm(range(done, config.rounds), "evolution", config.rounds, initial=done, unit="round", disable=None)
    for number in bar:
        metrics = run.run_round()
        logger.log(metrics, number, run.choices)
        save_checkpoint(folder, run, resolved(config), config.keep_last)
        draw_round(run, scenes, config.synthesizer.name, folder, logger, config.logger.replays)
        bar.set_postfix(eta=f"{metrics['synthesizer/eta']:.2f}", hit=f"{metrics.get('synthesizer/contact', nan):.0%}")
        with tqdm.external_write_mode():
            print(round_line(metrics, number + 1, config.rounds), flush=True)
    logger.close()
    tables = metric_tables(measure("after", run.ego), caption(config, origin))
    save_tables(folder / "tables.md", tables)
    print_tables(tables)
    print(f"\nwritten to {folder}; {run.improve.outcome(folder)}")


def train_prior(config: DictConfig, folder: Path) -> None:
    """Train a prior and print its nominal closed loop on held-out logs."""
    outcome = run_prior_stage(config, folder)
    if outcome is None:
        return  # another process of torchrun is the leader and reports
    path, rows = outcome
    print_tables(metric_tables(rows, f"nominal closed loop of {path.name} on held-out logs, ego replayed"))
    print(f"\ncheckpoint: {path}\nuse it with prior.checkpoint={path}")


def imitate(config: DictConfig, folder: Path) -> None:
    """Warm-start the actor from the recorded egos."""
    ego = build_ego(config)
    scenes = load_scenes(config.data, config.num_scenes, split="train")
    losses = run_imitation(config, scenes, ego, folder, build_logger(config, folder))
    print(", ".join(f"{name} {value:.4f}" for name, value in losses.items() if value == value))  # NaN: none held out
    print(f"start evolution rounds from it with ego.checkpoint={folder}")


def train_bits(config: DictConfig, folder: Path) -> None:
    """Train the ego bits on recorded vehicles."""
    scenes = load_scenes(config.data, config.num_scenes, split="train")
    losses = run_bits(config, scenes, folder, build_logger(config, folder))
    print(", ".join(f"{name} {value:.4f}" for name, value in losses.items() if value == value))  # NaN: none held out
    print(f"drive with it by ego=bits ego.checkpoint={folder}")


STAGES = {"evolution": evolve, "prior": train_prior, "imitation": imitate, "bits": train_bits}


@hydra.main(version_base="1.3", config_path="conf", config_name="train")
def run(config: DictConfig) -> None:
    """One stage of training, as configured."""
    begun = config.resume or HydraConfig.get().runtime.output_dir
    with ending(f"run `python train.py resume={begun}`"):
        config, folder = resumed(config, Path(HydraConfig.get().runtime.output_dir))
        if config.stage not in STAGES:
            raise InputError(f"stage={config.stage}: choose one of {', '.join(STAGES)}")
        if started_by_torchrun() and config.stage != "prior":
            raise InputError(f"torchrun: stage={config.stage} runs in one process, started with python")
        set_up(config)
        check_training(config)
        STAGES[config.stage](config, folder)


def main() -> None:
    """The command, in this process or in one of torchrun's."""
    sys.argv += follower_overrides()
    run()


if __name__ == "__main__":
    main()
