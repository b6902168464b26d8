"""Training: `python train.py` runs evolution rounds; `stage=prior` trains a prior, `stage=imitation` an actor,
`stage=bits` the ego bits."""

import sys
from contextlib import nullcontext
from functools import partial
from math import nan

import hydra
from omegaconf import DictConfig
from tqdm import tqdm

from e2rl.evaluation.methods import build_ego, build_prior, build_traffic, caption
from e2rl.evaluation.rollout_files import ENDED_FILE, add_ended
from e2rl.learning.build import build_evolution, build_logger, build_measure, check_training, run_bits, run_imitation
from e2rl.learning.prior_training.distributed import follower_overrides, follows, started_by_torchrun
from e2rl.learning.prior_training.stage import run_prior_stage
from e2rl.learning.run_checkpoint import checkpoints, load_checkpoint, save_checkpoint
from e2rl.report.rounds import draw_round, round_line
from e2rl.report.tables import metric_tables, print_tables, save_tables
from e2rl.run.config import resolved, run_command, set_up
from e2rl.run.endings import ending
from e2rl.run.errors import InputError
from e2rl.run.files import alone_in
from e2rl.run.run import Run, how_to_go_on
from e2rl.scenes.scene_list import listed
from e2rl.scenes.source import load_scenes

MAY_CHANGE = ("rounds", "device", "threads", "launcher")  # when a run is resumed


def evolve(task: Run) -> None:
    """Rounds of Algorithm 1: synthesize D' against the current ego, improve the ego on it, move the curriculum."""
    config, folder = task.config, task.folder
    prior, origin = build_prior(config, config.device)  # before the scenes, which take longer than a wrong path
    traffic, ego = build_traffic(config.synthesizer, prior), build_ego(config)
    scenes = load_scenes(config.data, config.num_scenes, split="train", scenes=config.scenes)
    run, logger = build_evolution(config, scenes, ego, traffic, folder=folder), build_logger(config, folder)
    measure = build_measure(config, ego, task.choices["ego"], traffic, prior, folder)
    task.begin({"scenes": listed(scenes), "measured scenes": listed(measure.setup.scenes)})
    begun = config.resume and checkpoints(config.resume)  # a run can be cut off in the measurement before
    done = load_checkpoint(config.resume, run) if begun else 0
    logger.forget(done)
    if done == 0:
        measure("before", run.ego, 0)
        save_checkpoint(folder, run, resolved(config), config.keep_last)
    bar = tqdm(range(done, config.rounds), "evolution", config.rounds, initial=done, unit="round", disable=None)
    for number in bar:
        metrics = run.run_round()
        logger.log(metrics, number, run.choices)
        add_ended(folder / ENDED_FILE, number, run.ended)
        save_checkpoint(folder, run, resolved(config), config.keep_last)
        draw_round(run, scenes, config.synthesizer.name, folder, logger, config.logger.replays)
        bar.set_postfix(eta=f"{metrics['synthesizer/eta']:.2f}", hit=f"{metrics.get('synthesizer/contact', nan):.0%}")
        with tqdm.external_write_mode():
            print(round_line(metrics, number + 1, config.rounds), flush=True)
    logger.close()
    tables = metric_tables(measure("after", run.ego, run.round), caption(config, origin))
    save_tables(folder / "tables.md", tables)
    print_tables(tables)
    print(f"\nwritten to {folder}; {run.improve.outcome(folder)}")


def train_prior(task: Run) -> None:
    """Train a prior and print its nominal closed loop on held-out logs."""
    outcome = run_prior_stage(task.config, task.folder, task.begin)
    if outcome is None:
        return  # another process of torchrun is the leader and reports
    path, rows = outcome
    print_tables(metric_tables(rows, f"nominal closed loop of {path.name} on held-out logs, ego replayed"))
    print(f"\ncheckpoint: {path}\nuse it with prior.checkpoint={path}")


def imitate(task: Run) -> None:
    """Warm-start the actor from the recorded egos."""
    config, folder = task.config, task.folder
    ego = build_ego(config)
    scenes = load_scenes(config.data, config.num_scenes, split="train", scenes=config.scenes)
    begin = partial(task.begin, {"scenes": listed(scenes)})
    losses = run_imitation(config, scenes, ego, folder, build_logger(config, folder), begin)
    print(", ".join(f"{name} {value:.4f}" for name, value in losses.items() if value == value))  # NaN: none held out
    print(f"start evolution rounds from it with ego.checkpoint={folder}")


def train_bits(task: Run) -> None:
    """Train the ego bits on recorded vehicles, in a minute or two: a resumed run begins anew."""
    config, folder = task.config, task.folder
    scenes = load_scenes(config.data, config.num_scenes, split="train", scenes=config.scenes)
    task.begin({"scenes": listed(scenes)})
    losses = run_bits(config, scenes, folder, build_logger(config, folder))
    print(", ".join(f"{name} {value:.4f}" for name, value in losses.items() if value == value))  # NaN: none held out
    print(f"drive with it by ego=bits ego.checkpoint={folder}")


STAGES = {"evolution": evolve, "prior": train_prior, "imitation": imitate, "bits": train_bits}


@hydra.main(version_base="1.3", config_path="conf", config_name="train")
def run(config: DictConfig) -> None:
    """One stage of training, as configured."""
    with ending(lambda: how_to_go_on(config)):
        task = Run.of(config, MAY_CHANGE)
        config = task.config
        if config.stage not in STAGES:
            raise InputError(f"stage={config.stage}: choose one of {', '.join(STAGES)}")
        if started_by_torchrun() and config.stage != "prior":
            raise InputError(f"torchrun: stage={config.stage} runs in one process, started with python")
        set_up(config)
        check_training(config)
        with nullcontext() if follows() else alone_in(task.folder):
            STAGES[config.stage](task)


def main() -> None:
    """The command, in this process or in one of torchrun's."""
    sys.argv += follower_overrides()
    run_command(run, "train")


if __name__ == "__main__":
    main()
