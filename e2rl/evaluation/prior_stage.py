"""`python train.py stage=prior`: train a prior on the user's data and measure its closed loop on held-out logs."""

import hashlib
from pathlib import Path

from omegaconf import DictConfig

from e2rl.ego.replay import ReplayEgo
from e2rl.evaluation.files import command_line, git_commit
from e2rl.evaluation.protocol import Method, run_protocol
from e2rl.prior.bounds import BoundSettings
from e2rl.prior.denoiser import DenoiserSettings
from e2rl.prior.loss import TrainingSettings
from e2rl.prior.prior import Prior, SamplerSettings
from e2rl.prior.training import held_out, train_prior
from e2rl.scene.scene import SceneSet
from e2rl.scene.source import load_scenes
from e2rl.sim.env import SimSettings
from e2rl.synthesizer.synthesizer import Synthesizer


def run_prior_stage(config: DictConfig, folder: Path) -> tuple[Path, list[dict]]:
    """The checkpoint's path and the metrics rows of the nominal closed loop on held-out scenes, the ego replayed."""
    options = dict(config.prior.training)
    starts, validate_every = list(options.pop("starts")), options.pop("validate_every")
    scenes = load_scenes(config.data, None, _split(config), starts)
    network = Prior(DenoiserSettings(**config.prior.network), SamplerSettings(**config.prior.sampler),
                    BoundSettings(**config.prior.bounds), config.prior.free_space).to(config.device)
    origin = {"data": f"{scenes.dataset}/{scenes.split}", "scenes": len(scenes), "starts": starts,
              "fingerprint": fingerprint(scenes), "git": git_commit(), "command": command_line(),
              "settings": {**options, "seed": config.seed}}
    settings = TrainingSettings(**options, seed=config.seed)
    path = train_prior(network, scenes, settings, validate_every, folder, origin)
    rows = run_protocol(_first_starts(scenes), [Method("nominal", Synthesizer(network), 0.0)], ReplayEgo(), "replay",
                        [0], SimSettings(replay_ego=True), folder, device=config.device, stage="prior")
    return path, rows


def _split(config: DictConfig) -> str | None:
    """The bundled and procedural sources train on their train split; a path's split is the path's own."""
    return None if config.data.source == "scenarionet" else "train"


def _first_starts(scenes: SceneSet) -> SceneSet:
    """The held-out scenes at their earliest start frame: the only one with eight recorded seconds ahead."""
    first = min(int(name.rsplit("@", 1)[1]) for name in scenes.scene_id)
    keep = [index for index, (name, out) in enumerate(zip(scenes.scene_id, held_out(scenes).tolist(), strict=True))
            if out and name.endswith(f"@{first}")]
    return SceneSet(scenes.batch(keep), [scenes.scene_id[i] for i in keep], [scenes.location[i] for i in keep],
                    scenes.dataset, f"{scenes.split}-held-out", {})


def fingerprint(scenes: SceneSet) -> str:
    """Hash of what the scenes hold, to tell checkpoints of different data apart."""
    digest = hashlib.sha256("\n".join(scenes.scene_id).encode())
    digest.update(scenes.scenes["logged"].numpy().tobytes())
    return digest.hexdigest()[:16]
