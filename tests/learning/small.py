"""Small parts for the learning tests: a few agents, a trivial synthesizer, quick settings."""

import torch

from e2rl.ego.actor import ActorEgo
from e2rl.learning.curriculum import CurriculumScheduler, CurriculumSettings
from e2rl.learning.evolution import Evolution, RoundSettings
from e2rl.learning.improvement import CollectSettings, PolicyImprovement
from e2rl.learning.update import UpdateSettings
from e2rl.sim.env import SimSettings
from tests.synthetic import make_scenes


def small_scenes(num_scenes=4, steps=20, **kwargs):
    sizes = {"max_vehicles": 4, "max_agents": 5, "num_routes": 1, "num_points": 120, "num_vehicles": 3, "num_vrus": 1}
    return make_scenes(num_scenes, steps=steps, **(sizes | kwargs))


def brake_check(scenes):
    """A trivial synthesizer: vehicle 1 is put into the ego's lane `40 / (1 + eta)` m ahead, at half the ego's speed."""

    def synthesize(ego, index, eta, seed):
        scene = scenes.batch(index)
        states, valid = scene["logged"].clone(), scene["logged_valid"].clone()
        time = 0.1 * torch.arange(states.shape[1])
        speed = states[:, :1, 0, 3] / 2
        states[:, :, 1, 0] = states[:, :1, 0, 0] + 40 / (1 + eta) + speed * time
        states[:, :, 1, 1], states[:, :, 1, 3] = 0.0, speed
        adversaries = torch.zeros(len(index), states.shape[2], dtype=torch.bool)
        adversaries[:, 1] = eta > 0
        return {
            "scene_index": index,
            "states": states,
            "valid": valid,
            "adversaries": adversaries,
            "contact": torch.full((len(index),), eta > 1),
        }

    return synthesize


def small_run(seed=0, hidden=(16,), nominal="log", rounds=4, scenes=None, collect=None, measure=None, **update):
    torch.manual_seed(seed)
    scenes = scenes or small_scenes()
    improve = PolicyImprovement(
        ActorEgo(hidden=hidden),
        scenes,
        SimSettings(),
        UpdateSettings(**({"minibatch": 64, "epochs": 2, "critic_warmup": 0, "target_kl": 1.0} | update)),
        collect or CollectSettings(batch=4, steps=20, iterations=2),
        seed=seed,
    )
    curriculum = CurriculumScheduler(len(scenes), rounds, CurriculumSettings(), seed)
    return Evolution(curriculum, improve, brake_check(scenes), RoundSettings(scenes=3, nominal=nominal), seed, measure)
