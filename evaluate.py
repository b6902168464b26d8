"""Closed-loop evaluation: `python evaluate.py [data=...] [ego=...] [eta=...]` prints and saves metric tables."""

from pathlib import Path

import hydra
from omegaconf import DictConfig

from e2rl.evaluation import methods as build_objects
from e2rl.evaluation import provenance
from e2rl.evaluation.capacity import check_fits, evaluation_need
from e2rl.evaluation.displacement_table import open_loop_rows
from e2rl.evaluation.ego_set import EgoSet, build_egos, curve_runs, recorded_acceleration, run_egos, setups_of
from e2rl.evaluation.meta_table import meta_rows
from e2rl.evaluation.modes import MODES_FILE, read_modes
from e2rl.evaluation.protocol import Method, Setup, drive_all, run_protocol
from e2rl.evaluation.reproduce import compared_with_run, files_of_run, reproduction_of
from e2rl.evaluation.resume import Run, resume_command, run_of
from e2rl.evaluation.rollout_files import METRICS_FILE, ROLLOUTS, write_metrics
from e2rl.evaluation.tuning_run import run_tuning, tuning_of
from e2rl.metrics.evasion import search_effort
from e2rl.report.comparison_tables import (
    EGOS,
    METHODS,
    ego_tables,
    guard_table,
    method_tables,
    planner_tables,
    save_compared,
)
from e2rl.report.curves import points_of_rows, save_curves
from e2rl.report.drawing import save_figure
from e2rl.report.html import report_command
from e2rl.report.intensity import intensity_figure, intensity_ladder
from e2rl.report.mode_table import mode_tables
from e2rl.report.plots import collision_bars, learning_curves
from e2rl.report.skeleton_figure import LongestChain, skeleton_figure
from e2rl.report.tables import Table, metric_tables, print_tables, save_tables
from e2rl.report.tuning_curve import save_tuning_curve
from e2rl.run import config as build_config
from e2rl.run.config import run_command
from e2rl.run.files import alone_in
from e2rl.run.parts import Kept
from e2rl.run.processes import ending
from e2rl.scenes.scene import SceneSet
from e2rl.scenes.source import load_scenes

MAY_CHANGE = ("processes", "launcher", "share")  # when a run is resumed
NOMINAL = "nominal"  # traffic without an attack, which every attack is compared with


def evaluate(run: Run) -> list[dict]:
    """Run the methods of a configuration and return the rows of metrics.json."""
    config, folder = run.config, run.folder
    build_config.set_up(config)
    build_objects.check_evaluation(config)
    egos, task = build_egos(config), tuning_of(config)
    prior, origin = build_objects.build_prior(
        config, config.device
    )  # before the scenes, which take longer than a wrong path
    methods, name = build_objects.build_methods(config, prior), run.choices["ego"]
    name, ego = next(iter(egos.egos.items())) if egos else (name, build_objects.build_ego(config))
    sim = build_objects.build_sim(config)
    scenes = load_scenes(config.data, config.num_scenes, scenes=config.scenes, files=files_of_run(config))
    only = None if config.scene is None else [scenes.index(config.scene)]
    provenance.begin_run(folder, config, MAY_CHANGE, {"scenes": scenes})
    kept = Kept(None if config.figure == "skeleton" else folder)  # that figure listens to every rollout
    setup = Setup(scenes, ego, name, sim, config.batch, config.device)
    processes, count = build_objects.processes_of(config), len(egos.egos) if egos else 1
    if str(config.device) == "cpu" and isinstance(processes, int):
        check_fits(evaluation_need(scenes, methods, len(config.seeds), count, config.batch, processes))
    if task is not None:
        result = run_tuning(config, task, setup, methods, prior, folder)
        if task.group == "synthesizer":
            save_tuning_curve(folder, result["trials"], config.synthesizer.name)
        return result["trials"]
    if (share := build_objects.share_of(config)) is not None:
        setups, into = setups_of(setup, egos) if egos else [setup], folder / ROLLOUTS if config.save_rollouts else None
        drive_all(setups, methods, config.seeds, into, processes, only, kept, share)
        print(f"\nshare {share[0]} of {share[1]} written to {folder}; python -m e2rl.report.merge joins shares")
        return []
    chain = LongestChain(methods[0]) if config.figure == "skeleton" else None
    rows = []
    if config.open_loop_samples:
        rows += open_loop_rows(scenes, methods, config.open_loop_samples, config.device, kept)
    how = (methods, config.seeds, folder, config.save_rollouts, processes, only, kept)
    rows += run_egos(setup, egos, *how) if egos else run_protocol(setup, *how, references=references(config))
    if config.meta_rollouts:
        rows += meta_rows(setup, methods, config.meta_rollouts, kept)
    rows = [row | provenance.origin_of(folder) for row in rows]
    write_metrics(folder / METRICS_FILE, rows)
    dropped = "".join(f"; left out: {count} scenes ({reason})" for reason, count in scenes.dropped.items())
    effort = search_effort(scenes.steps)
    caption = f"{build_objects.caption(config, origin, methods)}; {effort}{dropped}"
    tables = metric_tables(rows, caption, config.metrics)
    if config.compare is not None or config.figure == "curves":
        tables = compared_tables(config, methods, egos, rows, caption, folder)
    tables += mode_tables(read_modes(folder / MODES_FILE))
    if egos and config.compare is None:
        tables += report_egos(config, egos, rows, scenes, caption, folder)
    save_tables(folder / "tables.md", tables)
    print_tables(tables)
    if config.figure == "curves":
        save_curves(folder, points_of_rows(rows))
    if config.figure == "intensity":
        save_figure(folder / "intensity.png", intensity_figure(intensity_ladder(folder)))
    if chain:
        rollout = chain.rollout(scenes, name, folder)
        save_figure(folder / "skeleton.png", skeleton_figure(rollout, chain.selection, chain.topology))
    print(f"\nwritten to {folder}")
    if config.reproduce:
        print(f"{config.reproduce}: {compared_with_run(config, folder).text()}")
    if command := report_command(folder):
        print(f"watch its failures: {command}")
    return rows


def references(config: DictConfig) -> tuple[str, ...] | None:
    """The methods that all are compared with; None: each with every other."""
    if config.compare is None and config.figure != "curves":
        return None
    return (*build_objects.compare_names(config), NOMINAL)


def compared_tables(
    config: DictConfig, methods: list[Method], egos: EgoSet | None, rows: list[dict], caption: str, folder: Path
) -> list[Table]:
    """The tables with a row a method, or where there are several egos a row an ego; also as files of their own."""
    others = build_objects.compare_names(config) or [NOMINAL]
    if egos:
        tables = planner_tables(rows, egos.names, others[0], caption, config.metrics)
    else:
        tables = method_tables(rows, build_objects.terms_by_method(methods), others, caption, config.metrics)
    save_compared(folder, tables, EGOS if egos else METHODS)
    return tables


def report_egos(
    config: DictConfig, egos: EgoSet, rows: list[dict], scenes: SceneSet, caption: str, folder: Path
) -> list[Table]:
    """The tables that compare the egos; with `policy_learning` also its guards and figures."""
    roles = config.policy_learning
    if roles is None:
        return ego_tables(rows, egos.names, egos.pairs, "Egos", caption)
    tables = ego_tables(rows, egos.names, egos.pairs, "Policy learning", caption)
    tables.append(guard_table(rows, roles.before, roles.after, roles.planner, recorded_acceleration(scenes)))
    save_figure(folder / "policy_learning.png", collision_bars(rows, egos.names, config.synthesizer.name))
    if runs := curve_runs(config):
        save_figure(folder / "curves.png", learning_curves(runs))
    return tables


@hydra.main(version_base="1.3", config_path="conf", config_name="evaluate")
def run(config: DictConfig) -> None:
    """An evaluation, as configured."""
    with ending(resume_command(config)):
        anew = config.reproduce and not config.resume
        task = reproduction_of(config) if anew else run_of(config, MAY_CHANGE)
        with alone_in(task.folder):
            evaluate(task)


def main() -> None:
    """The command."""
    run_command(run, "evaluate")


if __name__ == "__main__":
    main()
