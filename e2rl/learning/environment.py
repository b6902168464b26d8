"""The environment that learners from elsewhere train in: DrivingEnv with traffic that is replanned as they drive."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torchrl.envs import TransformedEnv

from e2rl.run.errors import InputError
from e2rl.scenes.scene import SceneSet
from e2rl.sim.env import DrivingEnv, SimSettings
from e2rl.traffic.pool import TrafficPool
from e2rl.traffic.traffic import Traffic
from e2rl.traffic.transform import AdversarialSynthesizer

SEEDS = 256  # of the noise, for each scene and intensity


class EpisodeDraw:
    """Draws scene, intensity and noise of new episodes, each evenly: rows of a pool of `scenes` scenes, repeated.

    chosen: scenes of the next episodes [count], -1 where one is drawn; None: all are drawn.
    """

    def __init__(self, scenes: int, repeats: int, seed: int) -> None:
        self.scenes, self.repeats, self.generator = scenes, repeats, torch.Generator().manual_seed(seed)
        self.chosen: Tensor | None = None

    def __call__(self, count: int) -> Tensor:
        """Pool rows [count]."""
        scene, repeat = (torch.randint(n, (count,), generator=self.generator) for n in (self.scenes, self.repeats))
        if self.chosen is not None:
            scene = torch.where(self.chosen < 0, scene, self.chosen)
        return repeat * self.scenes + scene


def training_env(
    scenes: SceneSet, traffic: Traffic, sim: SimSettings, num_envs: int, eta: Sequence[float], hold: int, seed: int
) -> TransformedEnv:
    """Returns environments [num_envs] in which `traffic` is replanned every 0.5 s against whoever drives.

    eta: intensities, one of which is drawn for each episode. Raises InputError where there is none, no environment, or
    traffic that asks for the ego's plan, which such learners do not have.
    """
    if not eta or num_envs < 1:
        raise InputError(f"num_envs={num_envs}, eta={list(eta)}: give at least one environment and one intensity")
    if traffic.knowledge == "plan":
        raise InputError("knowledge=plan: a policy has no plan to tell; set knowledge=predicted in its settings")
    repeats = len(eta) * SEEDS
    index, row = torch.arange(len(scenes)).repeat(repeats), torch.arange(len(scenes) * repeats)
    intensity = torch.tensor(eta, dtype=torch.float32).repeat_interleave(len(scenes) * SEEDS)
    draw = EpisodeDraw(len(scenes), repeats, seed)
    synthesizer = AdversarialSynthesizer(TrafficPool.live(index, intensity, row), draw, traffic)
    return TransformedEnv(DrivingEnv(scenes, sim, num_envs, hold=hold), synthesizer)
