"""`python train.py stage=prior`: train a prior on the user's data and measure its
closed loop on held-out logs."""

import hashlib
from pathlib import Path
from typing import Any

from e2rl.driving.setup import Method, Setup
from e2rl.evaluation.protocol import run_protocol
from e2rl.learning.logging import RunLogger
from e2rl.learning.pretraining.prior.training import (
    TrainingSettings,
    held_out,
    train_prior,
)
from e2rl.learning.pretraining.supervised import stage_settings
from e2rl.planners.log_replay import ReplayEgo
from e2rl.prior.bounds import BoundSettings
from e2rl.prior.denoiser import DenoiserSettings
from e2rl.prior.prior import Prior
from e2rl.prior.sde import SamplerSettings
from e2rl.run.config import settings_of
from e2rl.run.parts import Parts
from e2rl.run.run import Run, origin_of
from e2rl.scenes.scene import SceneSet
from e2rl.scenes.scene_list import listed, scene_hashes
from e2rl.scenes.source import load_scenes
from e2rl.sim.settings import SimSettings
from e2rl.traffic.nominal import NominalTraffic


def run_prior_stage(run: Run, logger: RunLogger) -> tuple[Path, list[dict]]:
    """Train a prior; returns its checkpoint's path and the metrics rows of the nominal
    closed loop on held-out scenes, the ego replayed."""
    config = run.config
    settings = stage_settings(config, TrainingSettings)
    folder = run.folder
    options = config.prior
    prior = Prior(  # whose first weights follow the run's seed
        settings_of(DenoiserSettings, options.network, where="prior.network"),
        settings_of(SamplerSettings, options.sampler, where="prior.sampler"),
        bounds=settings_of(BoundSettings, options.bounds, where="prior.bounds"),
    ).to(config.device)
    scenes = load_scenes(
        config.data,
        config.num_scenes,
        split="train",
        starts=list(settings.starts),
        scenes=config.scenes,
    )
    run.begin({"scenes": listed(scenes)})
    data = hashlib.sha256("\n".join(scene_hashes(scenes)).encode()).hexdigest()[:16]
    about = {
        "data": f"{scenes.dataset}/{scenes.split}",
        "scenes": len(scenes),
        "fingerprint": data,
    }
    path = train_prior(
        prior,
        scenes,
        settings=settings,
        folder=folder,
        origin=about | origin_of(folder) | {"settings": vars(settings)},
        logger=logger,
        parts=Parts(folder, "training", about=data),
    )
    fields: dict[str, Any] = {
        "stage": "prior",
        "parts": Parts(folder, "prior", about=path.name),
        **origin_of(folder),
    }
    setup = Setup(
        _first_starts(scenes),
        ReplayEgo(),
        ego_name="replay",
        sim=SimSettings(),
        device=config.device,
    )
    return path, run_protocol(
        setup,
        [Method("nominal", NominalTraffic(prior))],
        seeds=[0],
        folder=folder,
        **fields,
    )


def _first_starts(scenes: SceneSet) -> SceneSet:
    """Of each held-out log the scene with the earliest start frame, i.e. the longest
    recorded future."""
    first: dict[str, tuple[int, int]] = {}
    for index in held_out(scenes).nonzero()[:, 0].tolist():
        log, _, start = scenes.scene_id[index].rpartition("@")
        first[log] = min(first.get(log, (int(start), index)), (int(start), index))
    keep = [index for _, index in first.values()]
    names, places = (
        [values[i] for i in keep] for values in (scenes.scene_id, scenes.location)
    )
    return SceneSet(
        scenes.batch(keep),
        names,
        location=places,
        dataset=scenes.dataset,
        split=f"{scenes.split}-held-out",
        dropped={},
    )
