"""Training: `python train.py [data=...] [synthesizer=...] [learner=...]` hardens an ego
in rounds of Algorithm 1.

`stage=prior` trains a prior, `stage=imitation` the start of an actor, `stage=bits` the
driver bits.
"""

import e2rl.run.early  # noqa: F401 - first: from here on Ctrl-C ends in one line

# isort: split
import math

from e2rl.evaluation.build import build_ego, build_prior
from e2rl.evaluation.rollout_files import ERRORED_FILE, add_errored
from e2rl.learning.pretraining.bits import run_bits_stage
from e2rl.learning.pretraining.imitation import run_imitation_stage
from e2rl.learning.pretraining.prior.stage import run_prior_stage
from e2rl.learning.rounds.build import (
    build_attackers,
    build_evolution,
    build_logger,
    build_measure,
    build_progress,
    check_training,
    rollouts_of,
)
from e2rl.learning.rounds.checkpoint import (
    load_checkpoint,
    rounds_done,
    save_checkpoint,
)
from e2rl.learning.rounds.evolution import Evolution
from e2rl.learning.rounds.progress import round_line
from e2rl.report.before_after import compared_answer
from e2rl.report.caption import caption
from e2rl.report.tables import metric_tables, print_tables, save_tables
from e2rl.run.command import run_command
from e2rl.run.machine import set_up
from e2rl.run.run import Run
from e2rl.scenes.scene_list import listed
from e2rl.scenes.source import load_scenes
from e2rl.traffic.fusing import prepare_fused

MAY_CHANGE = ("rounds", "device", "threads")  # when a run is resumed


def train_round(run: Evolution) -> dict[str, float]:
    """One round of Algorithm 1; returns its metrics."""
    order = run.draw()  # scenes and their intensities, by the curriculum
    attack = run.roll_out(order)  # on the current policy; D' has what is avoidable
    run.prefetch()  # the next round's attack, in another process meanwhile
    learned = run.learn(attack)  # episodes in D' and updates of the policy, in turn
    return run.move_on(order, attack, learned)  # the curriculum, by the failures


def evolve(task: Run) -> None:
    """Harden an ego: measure it, train it for `rounds` rounds, measure it again."""
    config = task.config
    folder = task.folder
    done = rounds_done(config.resume)
    progress = build_progress(config, done)
    prior, origin = build_prior(config, config.device)  # a wrong path fails early
    attackers = build_attackers(config, prior)
    ego = build_ego(config)
    scenes = load_scenes(
        config.data, config.num_scenes, split="train", scenes=config.scenes
    )
    run = build_evolution(
        config,
        scenes,
        ego=ego,
        attackers=attackers,
        folder=folder,
    )
    logger = build_logger(config, folder)
    measure = build_measure(
        config,
        ego,
        ego_name=task.choices["ego"],
        traffic=attackers[0],
        prior=prior,
        folder=folder,
    )
    measured = measure.setup.scenes
    task.begin({"scenes": listed(scenes), "measured scenes": listed(measured)})
    logger.forget(load_checkpoint(config.resume, run) if done else 0)
    progress.say(
        f"{len(scenes)} scenes to train on, {len(measured)} to measure on, in {folder}"
    )
    if (task.choices["data"], task.choices["experiment"]) == ("bundled", "harden"):
        progress.say(
            "these are the bundled scenes: experiment=harden is for logs of your own "
            "(data=, data.path=)"
        )
    if not done:
        with progress.phase("measurement"):
            measure("before", run.ego, 0)
        progress.say("measured before training")
        save_checkpoint(folder, run, config.keep_last)
    for number in range(run.round, config.rounds):
        with progress.phase("round"):
            metrics = train_round(run)
            logger.log(metrics, number, run.choices)
            add_errored(folder / ERRORED_FILE, number, run.errored)
            save_checkpoint(folder, run, config.keep_last)
        progress.say(round_line(metrics, number + 1, config.rounds))
    logger.close()
    with progress.phase("measurement"):
        rows = measure("after", run.ego, run.round)
    save_tables(folder / "tables.md", metric_tables(rows, caption(config, origin)))
    answer = compared_answer(
        [row for row in rows if row["stage"] == "before"],
        [row for row in rows if row["stage"] == "after"],
        atlases=measure.atlases(),
        rates=measure.ego_rates(),
        folder=folder,
    )
    print("", *answer, run.improve.outcome(folder), sep="\n")


def train_prior(task: Run) -> None:
    """Train a prior and print its nominal closed loop on held-out logs."""
    path, rows = run_prior_stage(task, build_logger(task.config, task.folder))
    print_tables(
        metric_tables(
            rows, f"nominal closed loop of {path.name} on held-out logs, ego replayed"
        )
    )
    print(f"\ncheckpoint: {path}\nuse it with prior.checkpoint={path}")


def imitate(task: Run) -> None:
    """Warm-start the actor from the recorded egos."""
    print(
        losses_line(run_imitation_stage(task, build_logger(task.config, task.folder)))
    )
    print(f"start evolution rounds from it with ego.checkpoint={task.folder}")


def train_bits(task: Run) -> None:
    """Train the driver bits on recorded vehicles."""
    print(losses_line(run_bits_stage(task, build_logger(task.config, task.folder))))
    print(f"drive with it by ego=bits ego.checkpoint={task.folder}")


def losses_line(row: dict[str, float]) -> str:
    """The losses of a training's chosen turn."""
    return ", ".join(
        f"{name} {value:.4f}"
        for name, value in row.items()
        if not math.isnan(value)  # NaN: none held out
    )


def purpose(task: Run) -> str:
    """What a stage does, in a line."""
    config = task.config
    data = task.choices["data"]
    if config.stage.name != "evolution":
        return f"Trains {config.stage.name} on {data} logs, into {task.folder}."
    return (
        f"Hardens {task.choices['ego']} against {config.synthesizer.name} in {data} "
        f"scenes: measures it, trains it for {config.rounds} rounds, and measures it "
        f"again, into {task.folder}."
    )


STAGES = {
    "evolution": evolve,
    "prior": train_prior,
    "imitation": imitate,
    "bits": train_bits,
}


def train(task: Run) -> None:
    """One stage of training, as configured."""
    config = task.config
    set_up(config)
    check_training(config)
    print(purpose(task), flush=True)
    prepare_fused(config, rollouts_of(config))
    STAGES[config.stage.name](task)


def main() -> None:
    """The command."""
    run_command("train", train, MAY_CHANGE)


if __name__ == "__main__":
    main()
