"""What every benchmark shares: the scenes and parts under test, timing, and the row
that is written."""

import os
import platform
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from functools import cached_property
from importlib.metadata import version

import torch
from omegaconf import DictConfig
from tensordict import TensorDict
from torch import Tensor

from e2rl.evaluation.build import build_ego, build_prior, build_sim, build_traffic
from e2rl.planners.ego import Ego
from e2rl.run.config import load_config
from e2rl.scenes.scene import SceneSet
from e2rl.scenes.source import load_scenes
from e2rl.sim.env import DrivingEnv
from e2rl.sim.rollouts import Rollouts
from e2rl.sim.settings import SimSettings
from e2rl.traffic.rollout import roll_out
from e2rl.traffic.traffic import Traffic


def versions() -> dict[str, str]:
    """Of what the figures depend on."""
    return {"python": platform.python_version()} | {
        name: version(name) for name in ("torch", "torchrl", "tensordict")
    }


@dataclass
class Row:
    """A figure. variant: what of the benchmark; batch: scenes at once; agents,
    map_points: rows a scene has; value in unit, None where it could not be measured;
    load: of the machine in the minute before; processes, threads of each."""

    benchmark: str
    variant: str
    batch: int
    agents: int
    map_points: int
    value: float | None
    unit: str
    processes: int = 1
    threads: int = field(default_factory=torch.get_num_threads)
    load: float = field(default_factory=lambda: round(os.getloadavg()[0], 2))
    versions: dict[str, str] = field(default_factory=versions)

    def plain(self) -> dict:
        """As a row of the JSON file."""
        return asdict(self)


@dataclass
class Bench:
    """What is measured: data (a ScenarioNet folder or zip, None: the bundled scenes),
    prior checkpoint, repeats.

    largest: scenes at once at most, None: as many as the benchmark wants; train:
    overrides of conf/train.yaml; compile: measure compiled steps too; peers: the
    interpreter that has the peers; settings: overrides of both configurations.
    """

    data: str | None
    checkpoint: str
    repeats: int
    largest: int | None = None
    train: tuple[str, ...] = ()
    compile: bool = True
    peers: str = sys.executable
    settings: tuple[str, ...] = ()

    @cached_property
    def config(self) -> DictConfig:
        """Of evaluate.py with its defaults."""
        return self.configured("evaluate")

    def configured(self, name: str) -> DictConfig:
        """Configuration `name` on the data and prior under test."""
        overrides = [*self.settings, *(self.train if name == "train" else ())]
        data = (
            ["data=scenarionet", f"data.path={self.data}"]
            if self.data
            else ["data=bundled"]
        )
        return load_config(
            name, [*data, f"prior.checkpoint={self.checkpoint}", *overrides]
        )

    @cached_property
    def scenes(self) -> SceneSet:
        """All scenes of the data."""
        return load_scenes(self.config.data)

    @cached_property
    def traffic(self) -> Traffic:
        """e2 on the prior under test."""
        return build_traffic(self.config.synthesizer, build_prior(self.config)[0])

    @cached_property
    def ego(self) -> Ego:
        """lane_graph."""
        return build_ego(self.config)

    @cached_property
    def sim(self) -> SimSettings:
        """The simulator's defaults."""
        return build_sim(self.config)

    def batches(self, *sizes: int) -> list[int]:
        """The sizes, none above `largest` (once each)."""
        return sorted({min(size, self.largest or size) for size in sizes})

    def pick(self, batch: int, agents: int | None = None) -> Tensor:
        """Scene indices [batch], repeated where there are too few; agents: those with
        nearest to so many first."""
        count = self.scenes.scenes["valid"].sum(1)
        order = (
            torch.arange(len(count))
            if agents is None
            else (count - agents).abs().argsort(stable=True)
        )
        return order[torch.arange(batch) % len(order)]

    def environment(self, index: Tensor) -> DrivingEnv:
        """The simulator at the start of scenes index [B]."""
        env = DrivingEnv(self.scenes, self.sim, len(index))
        env.reset(TensorDict({"scene_index": index[:, None]}, batch_size=[len(index)]))
        return env

    def roll_out(
        self, index: Tensor, eta: Tensor, traffic: Traffic | None = None
    ) -> Rollouts:
        """Rollouts of scenes index [B] at intensities eta [B], in the bench's traffic
        by default; the index is the seed, too."""
        return roll_out(
            self.scenes,
            index,
            index,
            eta,
            ego=self.ego,
            traffic=self.traffic if traffic is None else traffic,
            sim=self.sim,
        )

    def row(
        self,
        benchmark: str,
        variant: str,
        index: Tensor,
        value: float,
        unit: str,
        **fields,
    ) -> Row:
        """A Row whose sizes are those of scenes index [B]: agents present and lane
        points, a scene's mean."""
        scene = self.scenes.scenes
        agents = scene["valid"][index].sum(-1).float().mean().round()
        points = (scene["lane_index"][index] >= 0).sum(-1).float().mean().round()
        return Row(
            benchmark,
            variant,
            len(index),
            int(agents),
            int(points),
            value,
            unit,
            **fields,
        )

    def best(self, function: Callable[[], object]) -> float:
        """Least wall time [s] of the repeats, after one call that is not counted."""
        return self.both(function)[0]

    def both(self, function: Callable[[], object]) -> tuple[float, float]:
        """`best`, and the least time [s] that the process was on a core, which others
        on the machine hardly change."""
        function()
        wall = []
        cpu = []
        for _ in range(self.repeats):
            begin = time.perf_counter()
            begun = time.process_time()
            function()
            (
                wall.append(time.perf_counter() - begin),
                cpu.append(time.process_time() - begun),
            )
        return min(wall), min(cpu)


Benchmark = Callable[[Bench], Iterator[Row]]
