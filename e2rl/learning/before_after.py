"""The before/after table of an evolution run: the same scenes and seeds, nominal and adversarial, for both policies."""

import math
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from e2rl.ego.base import Ego
from e2rl.evaluation.files import METRICS_FILE, read_metrics, write_metrics
from e2rl.evaluation.protocol import Method, run_protocol
from e2rl.evaluation.rollout_reader import as_rollout_dict, read_rollouts
from e2rl.metrics.score import score_rollouts
from e2rl.metrics.statistics import paired_differences
from e2rl.scene.scene import SceneSet
from e2rl.scene.source import load_scenes
from e2rl.sim.env import SimSettings
from e2rl.synthesizer.synthesizer import Synthesizer


class BeforeAfter:
    """Measures an ego on the scenes of `config.measure`, and keeps the rows of both stages in metrics.json.

    The bundled and procedural sources are measured on their tune split; a path's scenes on `measure.path`, or, where
    there is none, on the first of the training scenes (the row's split says which).
    """

    def __init__(self, config: DictConfig, name: str, synthesizer: Synthesizer, sim: SimSettings, folder: Path):
        """name: of the ego in tables and files."""
        self.config, self.name, self.sim, self.folder = config, name, sim, folder
        self.methods = [Method("nominal", synthesizer, 0.0), Method("e2", synthesizer, config.measure.eta)]

    def scenes(self) -> SceneSet:
        """The scenes that are measured on."""
        data = self.config.data
        if self.config.measure.path:
            data = OmegaConf.merge(data, {"path": self.config.measure.path, "split": None})
        return load_scenes(data, self.config.measure.scenes, split="tune")

    def __call__(self, stage: str, ego: Ego) -> list[dict]:
        """Measure an ego as `stage` (before or after); returns the rows of all stages so far.

        The rows of stage `after` are paired with the same method before, under the name `before`.
        """
        options = self.config.measure
        rows = run_protocol(
            self.scenes(),
            self.methods,
            ego,
            self.name,
            list(options.seeds),
            self.sim,
            self.folder / stage,
            self.config.batch,
            self.config.device,
            stage=stage,
        )
        if stage == "after":
            for row in rows:
                row["paired"]["before"] = paired_differences(*self._scored("after", row), *self._scored("before", row))
        file = self.folder / METRICS_FILE
        earlier = [row for row in (read_metrics(file) if file.exists() else []) if row.get("stage") != stage]
        write_metrics(file, earlier + rows)
        return read_metrics(file)

    def _scored(self, stage: str, row: dict) -> tuple[list[dict], list[dict]]:
        """Rows and realism samples of a stage's rollouts of a row's method, from their files."""
        found = [
            rollout
            for rollout in read_rollouts(self.folder / stage)
            if rollout["method"] == row["method"] and math.isclose(rollout["eta"], row["eta"])
        ]
        return score_rollouts(as_rollout_dict(found))
