"""The before/after table of an evolution run: the same scenes and seeds, nominal and adversarial, for both policies."""

from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from e2rl.ego.base import Ego
from e2rl.evaluation.files import METRICS_FILE, read_metrics, write_metrics
from e2rl.evaluation.protocol import Method, run_protocol
from e2rl.scene.scene import SceneSet
from e2rl.scene.source import load_scenes
from e2rl.sim.env import SimSettings
from e2rl.synthesizer.synthesizer import Synthesizer


class BeforeAfter:
    """Measures an ego on the scenes of `config.measure`, and keeps the rows of both stages in metrics.json.

    The bundled and procedural sources are measured on their tune split; a path's scenes on `measure.path`, or, where
    there is none, on the first of the training scenes (the row's split says which).
    """

    def __init__(self, config: DictConfig, synthesizer: Synthesizer, sim: SimSettings, folder: Path):
        self.config, self.sim, self.folder = config, sim, folder
        self.methods = [Method("nominal", synthesizer, 0.0), Method("e2", synthesizer, config.measure.eta)]

    def scenes(self) -> SceneSet:
        """The scenes that are measured on."""
        data = self.config.data
        if self.config.measure.path:
            data = OmegaConf.merge(data, {"path": self.config.measure.path, "split": None})
        return load_scenes(data, self.config.measure.scenes, split="tune")

    def __call__(self, stage: str, ego: Ego) -> list[dict]:
        """Measure an ego as `stage` (before or after); returns the rows of all stages so far."""
        options = self.config.measure
        folder = self.folder / stage
        rows = run_protocol(self.scenes(), self.methods, ego, f"actor_{stage}", list(options.seeds), self.sim, folder,
                            self.config.batch, self.config.device, stage=stage)
        file = self.folder / METRICS_FILE
        earlier = [row for row in (read_metrics(file) if file.exists() else []) if row.get("stage") != stage]
        write_metrics(file, earlier + rows)
        return read_metrics(file)
