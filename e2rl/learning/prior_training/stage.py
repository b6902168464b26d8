"""`python train.py stage=prior`: train a prior on the user's data and measure its closed loop on held-out logs."""

import hashlib
import time
from copy import deepcopy
from pathlib import Path

from omegaconf import DictConfig

from e2rl.ego.replay import ReplayEgo
from e2rl.errors import InputError
from e2rl.evaluation.files import command_line, git_commit
from e2rl.evaluation.protocol import Method, run_protocol
from e2rl.learning.prior_training.distributed import joined
from e2rl.learning.prior_training.settings import TrainingSettings
from e2rl.learning.prior_training.training import ClosedLoop, held_out, train_prior
from e2rl.prior.bounds import BoundSettings
from e2rl.prior.denoiser import DenoiserSettings
from e2rl.prior.prior import Prior, SamplerSettings
from e2rl.scene.scene import SceneSet
from e2rl.scene.source import load_scenes
from e2rl.settings import settings_of
from e2rl.sim.env import SimSettings
from e2rl.synthesizer.synthesizer import Synthesizer

FIGURES = ("real", "aor_step", "cfr_bg")  # of the closed loop at a validation


def run_prior_stage(config: DictConfig, folder: Path) -> tuple[Path, list[dict]] | None:
    """The checkpoint's path and the metrics rows of the nominal closed loop on held-out scenes, the ego replayed; None
    in processes of torchrun other than the leader."""
    settings = settings_of(TrainingSettings, {**config.prior.training, "seed": config.seed}, "prior.training")
    with joined(config.device) as (processes, device):
        folder = processes.from_leader(lambda: folder)
        network = _network(config).to(device)
        begin = time.perf_counter()
        scenes = processes.leader_first(
            lambda: load_scenes(config.data, config.num_scenes, "train", list(settings.starts))
        )
        origin = _origin(scenes, settings, time.perf_counter() - begin)
        path = train_prior(network, scenes, settings, folder, origin, _closed_loop(scenes, settings, device), processes)
        if path is None:
            return None
        return path, _nominal(network, _first_starts(scenes), device, folder, stage="prior")


def _network(config: DictConfig) -> Prior:
    """An untrained prior; its first weights follow the run's seed."""
    network = settings_of(DenoiserSettings, config.prior.network, "prior.network")
    if not isinstance(network.dropout, int | float) or not 0 <= network.dropout < 1:
        raise InputError(f"prior.network.dropout={network.dropout}: expected a share of at least 0 and below 1")
    for name, value in vars(network).items():
        if name != "dropout" and (type(value) is not int or value < 1):
            raise InputError(f"prior.network.{name}={value}: expected a whole number of at least 1")
    if network.width % network.heads:
        raise InputError(f"prior.network.width={network.width}: expected a multiple of heads={network.heads}")
    return Prior(
        network,
        settings_of(SamplerSettings, config.prior.sampler, "prior.sampler"),
        settings_of(BoundSettings, config.prior.bounds, "prior.bounds"),
        config.prior.free_space,
    )


def _origin(scenes: SceneSet, settings: TrainingSettings, seconds: float) -> dict:
    """What a checkpoint says of the data and the command that made it."""
    return {
        "data": f"{scenes.dataset}/{scenes.split}",
        "scenes": len(scenes),
        "fingerprint": fingerprint(scenes),
        "git": git_commit(),
        "command": command_line(),
        "settings": vars(settings),
        "seconds": {"scenes": round(seconds, 1)},
    }


def _nominal(prior: Prior, scenes: SceneSet, device: str, folder: Path | None, **fields) -> list[dict]:
    """Metrics rows of the unguided prior as traffic round the replayed ego."""
    return run_protocol(
        scenes,
        [Method("nominal", Synthesizer(prior), 0.0)],
        ReplayEgo(),
        "replay",
        [0],
        SimSettings(replay_ego=True),
        folder,
        device=device,
        **fields,
    )


def _closed_loop(scenes: SceneSet, settings: TrainingSettings, device: str) -> ClosedLoop:
    """FIGURES of a prior on at most `closed_loop_scenes` held-out scenes, spread over the places: always the same
    scenes and noise, so that validations differ by the weights alone."""
    first = _first_starts(scenes)
    count = min(settings.closed_loop_scenes, len(first))
    some = _chosen(first, [k * len(first) // count for k in range(count)])

    def closed_loop(prior: Prior) -> dict[str, float]:
        metrics = _nominal(deepcopy(prior), some, device, None)[0]["metrics"]  # a synthesizer freezes its prior
        return {name: round(metrics[name]["mean"], 4) for name in FIGURES}

    return closed_loop


def _first_starts(scenes: SceneSet) -> SceneSet:
    """The held-out scenes, of each log the one at its earliest start frame: with the most recorded seconds ahead."""
    first: dict[str, tuple[int, int]] = {}
    for index, (name, out) in enumerate(zip(scenes.scene_id, held_out(scenes).tolist(), strict=True)):
        if out:
            log, _, start = name.rpartition("@")
            first[log] = min(first.get(log, (int(start), index)), (int(start), index))
    return _chosen(scenes, [index for _, index in first.values()])


def _chosen(scenes: SceneSet, keep: list[int]) -> SceneSet:
    return SceneSet(
        scenes.batch(keep),
        [scenes.scene_id[i] for i in keep],
        [scenes.location[i] for i in keep],
        scenes.dataset,
        f"{scenes.split}-held-out",
        {},
    )


def fingerprint(scenes: SceneSet) -> str:
    """Hash of what the scenes hold, to tell checkpoints of different data apart."""
    digest = hashlib.sha256("\n".join(scenes.scene_id).encode())
    digest.update(scenes.scenes["logged"].numpy().tobytes())
    return digest.hexdigest()[:16]
