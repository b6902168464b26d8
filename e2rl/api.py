"""The library in a notebook: scenes, prior, traffic and ego by the names of their files in conf/, rollouts and rows.

    import e2rl

    scenes = e2rl.load_scenes("bundled", num_scenes=8)
    prior = e2rl.load_prior()
    traffic = e2rl.make_traffic("e2", prior, support="topology")
    rollouts = e2rl.roll_out(scenes, e2rl.make_ego("lane_graph"), traffic, eta=2.0)
    rows = e2rl.score(rollouts)
    print(sum(row["cfr"] for row in rows) / len(rows))

Keyword arguments are keys of the file, nested ones as mappings. Everything runs in this process.
"""

from collections.abc import Sequence
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from e2rl.evaluation.methods import build_ego, build_sim, build_traffic
from e2rl.evaluation.protocol import scene_seed
from e2rl.metrics.score import score_rollouts
from e2rl.planners.ego import Ego
from e2rl.prior.bounds import BoundSettings
from e2rl.prior.checkpoint import load_prior as _load_prior
from e2rl.prior.prior import Prior
from e2rl.prior.sde import SamplerSettings
from e2rl.run.config import load_choice, load_config
from e2rl.run.errors import InputError
from e2rl.run.settings import settings_of
from e2rl.scenes import source
from e2rl.scenes.scene import SceneSet
from e2rl.sim.rollouts import Rollouts
from e2rl.traffic import rollout
from e2rl.traffic.traffic import Traffic


def load_scenes(
    data: str = "bundled", num_scenes: int | None = None, scenes: str | None = None, **settings: Any
) -> SceneSet:
    """At most num_scenes scenes of conf/data/<data>.yaml, such as load_scenes("scenarionet", path="logs.zip"); scenes:
    a list or the folder of a run, whose scenes are taken."""
    return source.load_scenes(_choice("data", data, {"workers": 1} | settings), num_scenes, scenes=scenes)


def load_prior(checkpoint: str = "bundled", device: str = "cpu", **settings: Any) -> Prior:
    """The frozen prior of a checkpoint; settings: conf/prior/default.yaml, such as sampler={"steps": 8}."""
    config = _choice("prior", "default", settings)
    sampler = settings_of(SamplerSettings, config.sampler, "prior.sampler")
    return _load_prior(checkpoint, sampler, settings_of(BoundSettings, config.bounds, "prior.bounds"), device)[0]


def make_traffic(name: str, prior: Prior, **settings: Any) -> Traffic:
    """The traffic method of conf/synthesizer/<name>.yaml on a prior."""
    return build_traffic(_choice("synthesizer", name, settings), prior)


def make_ego(name: str, **settings: Any) -> Ego:
    """The ego of conf/ego/<name>.yaml."""
    shared = {"sim": load_choice("sim", "default"), "device": "cpu"}  # that some egos refer to
    return build_ego(OmegaConf.create(shared | {"ego": _choice("ego", name, settings)}))


def roll_out(
    scenes: SceneSet, ego: Ego, traffic: Traffic, eta: float = 0.0, seeds: Sequence[int] = (0,), device: str = "cpu"
) -> Rollouts:
    """The rollouts of every scene under every sampling seed, as `python evaluate.py` rolls them out; all are simulated
    at once."""
    tasks = [(scene, seed) for seed in seeds for scene in range(len(scenes))]
    index = torch.tensor([scene for scene, _ in tasks])
    noise = torch.tensor([scene_seed(scenes.number[scene], seed) for scene, seed in tasks])
    sim = build_sim(load_config("evaluate"))
    etas = torch.full((len(tasks),), float(eta), dtype=torch.float64)
    rollouts = rollout.roll_out(scenes, index, noise, etas, ego, traffic, sim, device)
    rollouts.seed = torch.tensor([seed for _, seed in tasks])
    return rollouts


def score(rollouts: Rollouts) -> list[dict]:
    """One row of metrics per rollout (docs/method.md, section 10)."""
    return score_rollouts(rollouts)[0]


def _choice(group: str, name: str, settings: dict[str, Any]) -> DictConfig:
    """A file of the configuration with changes."""
    config = load_choice(group, name)
    OmegaConf.set_struct(config, True)
    try:
        for key, value in settings.items():
            OmegaConf.update(config, key, value, merge=True)
    except OmegaConfBaseException as error:
        raise InputError(f"{group}={name}: {str(error).splitlines()[0]}; compare it with conf/{group}") from error
    return config
