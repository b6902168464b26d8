"""A sampling planner: hundreds of candidates, each driven by the unicycle and scored on
a forecast of the others.

It proposes, simulates, scores and takes the best, in the manner of PDM-Closed (Dauner
et al. 2023), and ignores others' plans. Vectorised over scenes, candidates and agents.
"""

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from e2rl.planners.candidates import Candidates, drive, speed_profiles
from e2rl.planners.chunks import PLANNER_KEYS, chunks
from e2rl.planners.ego import PLAN_STEPS, Ego
from e2rl.planners.path import BRAKING, MissionPath
from e2rl.planners.scoring import Weights, forecast, nearest, score
from e2rl.run.config import configured, setting
from e2rl.scenes.recording import DT
from e2rl.sim.world import World

GPU_CHUNK = 512  # scenes that are planned for at a time on a GPU
STRIDE = 2  # steps between two scored states
PROFILES = (
    (-8.0, -8.0),
    (-8.0, 0.0),
    (-6.0, -6.0),
    (-6.0, 0.0),
    (-6.0, 2.0),
    (-4.0, -4.0),
    (-4.0, 0.0),
    (-2.5, -2.5),
    (-2.5, 0.0),
    (-1.2, -1.2),
    (-1.2, 0.0),
    (0.0, 0.0),
    (0.0, -3.0),
    (0.0, -8.0),
    (0.0, 1.5),
    (1.2, 1.2),
    (1.2, 0.0),
    (1.2, -3.0),
    (2.5, 2.5),
    (2.5, 0.0),
    (2.5, -4.0),
    (4.0, 4.0),
    (4.0, 0.0),
    (4.0, -6.0),
    (5.0, 5.0),
    (5.0, -8.0),
)  # m/s^2 in the first second and after it
SHIFTS = (
    0.0,
    1.0,
    -1.0,
    2.0,
    -2.0,
    3.5,
    -3.5,
    5.0,
    -5.0,
)  # m beside the mission, left +
BRAKING_MORE = 1.0  # m/s^2 by which braking may exceed what the speed caps are made for


@dataclass(eq=False)
class ScoringEgo(Weights, Ego):
    """Plans the cheapest of its `candidates` by `scoring.score` on a forecast of the
    others, whose plans it ignores.

    CHUNK: scenes that are planned for at a time; READS: keys of the scene that are
    looked at.
    """

    CHUNK = 64
    READS: ClassVar[tuple[str, ...]] = PLANNER_KEYS
    tuned = {
        "hold": (0.3, 2.5),
        "turn": (0.3, 3.0),
        "margin": (0.2, 1.5),
        "margin_growth": (0.0, 0.6),
        "headway": (0.5, 3.0),
        "rear": (0.1, 1.0),
        "fade": (0.0, 0.5),
        "near": (5.0, 100.0),
        "progress": (0.05, 0.6),
        "comfort": (0.3, 4.0),
        "lateral_offset": (0.3, 5.0),
    }

    horizon: float = setting(low=0.2, high=5.0)
    agents: int = setting(low=1)
    hold: float = setting(low=0)
    turn: float = setting(low=0)
    replan_every: int = setting(low=1, high=PLAN_STEPS)

    @abstractmethod
    def candidates(self, world: World) -> Candidates:
        """The candidates [B, C] that it chooses among."""

    def costs(self, world: World, candidates: Candidates) -> Tensor:
        """Costs [B, C] of candidates."""
        device = world.step.device
        end = round(self.horizon / DT) + 1
        steps = torch.arange(STRIDE, end, STRIDE, device=device)
        others = forecast(
            world,
            nearest(world, self.agents),
            times=steps * DT,
            hold=self.hold,
            turn=self.turn,
        )
        return score(
            world,
            candidates,
            others=others,
            steps=steps,
            weights=self,
        )

    def plan(self, world: World) -> Tensor:
        """The states [B, PLAN_STEPS, 4] of the candidate that costs least."""
        plans = []
        for part in self._parts(world):
            candidates = self.candidates(part)
            best = self.costs(part, candidates).argmin(1)
            row = torch.arange(len(best), device=best.device)
            plans.append(candidates.states[row, best])
        return torch.cat(plans)

    def _parts(self, world: World) -> Iterator[World]:
        size = GPU_CHUNK if world.step.is_cuda else self.CHUNK
        return chunks(world, size, keys=self.READS)


@configured("ego/sampling")
@dataclass(eq=False)
class SamplingEgo(ScoringEgo):
    """26 speed profiles on 19 lateral moves: 9 shifts beside the mission, swift and
    calm, and the present one."""

    CHUNK = 8  # fits the processor's cache

    tuned = {"swift": (0.5, 1.0), "calm": (1.0, 2.5)} | ScoringEgo.tuned

    max_speed: float = setting(low=0.1)
    swift: float = setting(low=0)
    calm: float = setting(low=0)

    def candidates(self, world: World) -> Candidates:
        """Every speed profile on every lateral move."""
        path = MissionPath(world)
        start = world.states[:, 0]
        speed = speed_profiles(
            start[:, 3],
            start.new_tensor(PROFILES),
            caps=path.speed_caps(self.max_speed),
            braking=BRAKING + BRAKING_MORE,
        )
        shifts = start.new_tensor(SHIFTS).expand(len(start), -1)
        shift = torch.cat([shifts, shifts, path.d[:, None]], 1)
        count = len(SHIFTS)
        times = [self.swift] * count + [self.calm] * count + [self.swift]
        time = start.new_tensor(times)
        return drive(
            start,
            path,
            speed=speed,
            shift=shift[:, None],
            time=time,
        )
