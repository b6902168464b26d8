"""Closed-loop evaluation: `python evaluate.py [data=...] [ego=...] [eta=...]` prints and saves a metric table."""

from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from e2rl.errors import InputError, stop
from e2rl.evaluation.avoidable import search_effort
from e2rl.evaluation.build import build_ego, build_prior, build_sim, build_synthesizer, caption, check_protocol, set_up
from e2rl.evaluation.protocol import Method, run_protocol
from e2rl.report.tables import metric_tables, save_tables
from e2rl.scene.source import load_scenes


def evaluate(config: DictConfig, folder: Path) -> list[dict]:
    """Run the methods of a configuration and return the rows of metrics.json."""
    set_up(config)
    check_protocol(config)
    scenes = load_scenes(config.data, config.num_scenes)
    prior, origin = build_prior(config, config.device)
    synthesizer, ego, sim = build_synthesizer(config, prior), build_ego(config), build_sim(config)
    methods = [Method(name, synthesizer, 0.0 if name == "nominal" else config.eta)
               for name in dict.fromkeys(config.methods)]
    name = HydraConfig.get().runtime.choices["ego"]
    rows = run_protocol(scenes, methods, ego, name, list(config.seeds), sim, folder, config.batch, config.device)
    dropped = "".join(f"; left out: {count} scenes ({reason})" for reason, count in scenes.dropped.items())
    effort = search_effort(scenes.scenes["logged"].shape[1] - 1)
    tables = metric_tables(rows, f"{caption(config, origin)}; {effort}{dropped}")
    save_tables(folder / "tables.md", tables)
    print("\n\n".join(table.text() for table in tables))
    print(f"\nwritten to {folder}")
    return rows


@hydra.main(version_base="1.3", config_path="conf", config_name="evaluate")
def main(config: DictConfig) -> None:
    try:
        evaluate(config, Path(HydraConfig.get().runtime.output_dir))
    except InputError as error:
        stop(error)


if __name__ == "__main__":
    main()
