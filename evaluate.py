"""Closed-loop evaluation: `python evaluate.py [data=...] [ego=...] [eta=...]` prints and saves metric tables."""

from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from e2rl import build
from e2rl.errors import InputError, stop
from e2rl.evaluation.avoidable import search_effort
from e2rl.evaluation.chains import LongestChain
from e2rl.evaluation.files import METRICS_FILE, write_metrics
from e2rl.evaluation.ladders import intensity_ladder
from e2rl.evaluation.modes import MODES_FILE, read_modes
from e2rl.evaluation.open_loop import open_loop_rows
from e2rl.evaluation.protocol import Setup, run_protocol
from e2rl.evaluation.realism_meta import meta_rows
from e2rl.report.drawing import save_picture
from e2rl.report.intensity import intensity_figure
from e2rl.report.modes import mode_tables
from e2rl.report.skeleton import skeleton_figure
from e2rl.report.tables import metric_tables, print_tables, save_tables
from e2rl.scene.source import load_scenes


def evaluate(config: DictConfig, folder: Path) -> list[dict]:
    """Run the methods of a configuration and return the rows of metrics.json."""
    build.set_up(config)
    build.check_evaluation(config)
    scenes = load_scenes(config.data, config.num_scenes)
    prior, origin = build.build_prior(config, config.device)
    methods, name = build.build_methods(config, prior), HydraConfig.get().runtime.choices["ego"]
    setup = Setup(scenes, build.build_ego(config), name, build.build_sim(config), config.batch, config.device)
    if config.tuning is not None:
        return build.tune(config, setup, methods, folder)["trials"]
    only = None if config.scene is None else [scenes.index(config.scene)]
    chain = LongestChain(methods[0]) if config.figure == "skeleton" else None
    rows = []
    if config.open_loop_samples:
        rows += open_loop_rows(scenes, methods, config.open_loop_samples, config.device)
    rows += run_protocol(setup, methods, config.seeds, folder, config.save_rollouts, build.processes_of(config), only)
    if config.meta_rollouts:
        rows += meta_rows(setup, methods, config.meta_rollouts)
    write_metrics(folder / METRICS_FILE, rows)
    dropped = "".join(f"; left out: {count} scenes ({reason})" for reason, count in scenes.dropped.items())
    effort = search_effort(scenes.scenes["logged"].shape[1] - 1)
    tables = metric_tables(rows, f"{build.caption(config, origin, methods)}; {effort}{dropped}", config.metrics)
    tables += mode_tables(read_modes(folder / MODES_FILE))
    save_tables(folder / "tables.md", tables)
    print_tables(tables)
    if config.figure == "intensity":
        save_picture(folder / "intensity.png", intensity_figure(intensity_ladder(folder)))
    if chain:
        rollout = chain.rollout(scenes, name, folder)
        save_picture(folder / "skeleton.png", skeleton_figure(rollout, chain.selection, chain.topology))
    print(f"\nwritten to {folder}")
    return rows


@hydra.main(version_base="1.3", config_path="conf", config_name="evaluate")
def main(config: DictConfig) -> None:
    """The command."""
    try:
        evaluate(config, Path(HydraConfig.get().runtime.output_dir))
    except InputError as error:
        stop(error)


if __name__ == "__main__":
    main()
