"""Short episodes on the synthetic road whose ego has somebody to meet, and everything needed to run them."""

import torch

from e2rl.ego.idm import IDMEgo
from e2rl.prior.prior import SamplerSettings
from e2rl.scene.scene import SceneSet
from e2rl.sim.env import SimSettings
from e2rl.synthesizer.synthesizer import Synthesizer, SynthesizerSettings
from e2rl.traffic.rollout import roll_out
from tests.prior.small import small_prior
from tests.synthetic import make_scenes

VEHICLES = [(0, 0, 10.0), (22, 0, 9.0), (10, 1, 10.0), (-20, 0, 11.0), (45, 1, 8.0), (70, 0, 0.0)]
ROWS = 8


def scenes(count: int = 3, steps: int = 20, **options) -> SceneSet:
    """The ego between others in two lanes; vehicle 1 is ahead of it, vehicle 5 is parked far ahead."""
    return make_scenes(count, vehicles=VEHICLES, steps=steps, max_vehicles=ROWS, max_agents=ROWS + 2, **options)


def synthesizer(seed: int = 0, steps: int = 4, **settings) -> Synthesizer:
    """A synthesizer on a small random prior of `steps` denoising steps."""
    return Synthesizer(small_prior(seed, sampler=SamplerSettings(steps=steps)), SynthesizerSettings(**settings))


def drive(scene_set: SceneSet, on: Synthesizer, eta: float, seeds=None, ego=None, **options) -> dict:
    """Rollouts of every scene once."""
    index = torch.arange(len(scene_set))
    seeds = index if seeds is None else torch.tensor(seeds)
    return roll_out(
        scene_set, index, seeds, torch.full((len(index),), eta), ego or IDMEgo(), on, SimSettings(), **options
    )
