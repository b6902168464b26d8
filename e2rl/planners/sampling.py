"""A sampling planner: hundreds of candidates, each driven by the unicycle and scored on
a forecast of the others.

It proposes, simulates, scores and takes the best, in the manner of PDM-Closed (Dauner
et al. 2023), and ignores others' plans. Vectorised over scenes, candidates and agents.
"""

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from e2rl.planners.candidates import Candidates, drive, speed_profiles
from e2rl.planners.ego import PLAN_STEPS, Ego
from e2rl.planners.path import BRAKING, MissionPath
from e2rl.planners.scoring import Weights, forecast, nearest, score
from e2rl.run.settings import configured, setting
from e2rl.scenes.recording import DT
from e2rl.scenes.route import project
from e2rl.sim import dynamics
from e2rl.sim.world import AGENT_KEYS, World

GPU_CHUNK = 512  # scenes that are planned for at a time on a GPU
STRIDE = 2  # steps between two scored states
WIDER = 4  # times as many candidates are ranked as asked for, among which those driven alike are dropped
ALIKE = 1e-4  # m, rad, m/s and cost below which two candidates are driven alike
SCENE_KEYS = (
    *(
        "size",
        "route_log",
        "route_points",
        "route_length",
        "route_open",
        "route_limit",
        "route_light",
        "route_light_s",
    ),
    *("light_state", "field", "field_origin"),
)  # that costs and paths need


@dataclass(eq=False)
class ScoringEgo(Weights, Ego):
    """Plans the cheapest of its `candidates` by `scoring.score` on a forecast of the
    others, whose plans it ignores.

    CHUNK: scenes that are planned for at a time; READS: keys of the scene that are
    looked at.
    """

    CHUNK = 64
    READS: ClassVar[tuple[str, ...]] = SCENE_KEYS
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
        steps = torch.arange(
            STRIDE, round(self.horizon / DT) + 1, STRIDE, device=world.step.device
        )
        agents, seen = nearest(world, self.agents)
        others = forecast(
            world, agents, seen=seen, times=steps * DT, hold=self.hold, turn=self.turn
        )
        return score(world, candidates, others=others, steps=steps, weights=self)

    def plan(self, world: World) -> Tensor:
        """The states [B, PLAN_STEPS, 4] of the candidate that costs least."""
        return torch.cat([self._plan(part) for part in self._chunks(world)])

    def _plan(self, world: World) -> Tensor:
        candidates = self.candidates(world)
        best = self.costs(world, candidates).argmin(1)
        return candidates.states[torch.arange(len(best), device=best.device), best]

    def ranked(self, world: World, count: int) -> tuple[Tensor, Tensor]:
        """States [B, C, PLAN_STEPS, 4] and costs [B, C] of the C = `count` cheapest
        candidates, the cheapest first; of those that are driven alike (caps and bounds
        make many so) one counts, the others cost inf."""
        states, costs = zip(
            *(self._ranked(part, count) for part in self._chunks(world)), strict=True
        )
        return torch.cat(states), torch.cat(costs)

    def _ranked(self, world: World, count: int) -> tuple[Tensor, Tensor]:
        candidates = self.candidates(world)
        every = self.costs(world, candidates)
        costs, best = every.topk(min(WIDER * count, every.shape[1]), largest=False)
        row = torch.arange(len(best), device=best.device)[:, None]
        states = candidates.states[row, best]
        alike = (states.diff(dim=1).abs().amax((2, 3)) < ALIKE) & (
            costs.diff(dim=1) < ALIKE
        )
        costs = costs.masked_fill(torch.nn.functional.pad(alike, (1, 0)), torch.inf)
        costs, best = costs.topk(count, largest=False)
        return states[row, best], costs

    def rated(self, world: World, states: Tensor) -> Tensor:
        """Costs [B, C] of driving along any states [B, C, PLAN_STEPS, 4], which lead
        where they end."""
        path = MissionPath(world)
        driven = torch.cat(
            [
                world.states[:, None, :1, :2].expand_as(states[:, :, :1, :2]),
                states[..., :2],
            ],
            2,
        )
        length = driven.diff(dim=2).norm(dim=-1).sum(-1)
        end, shift, _ = project(
            states[:, :, -1, :2], path.route, hint=path.s[:, None] + length
        )
        return self.costs(world, Candidates(states, end - path.s[:, None], shift=shift))

    def _chunks(self, world: World) -> list[World]:
        rows = torch.arange(len(world.step), device=world.step.device)
        size = GPU_CHUNK if rows.is_cuda else self.CHUNK
        return [take(world, part, keys=self.READS) for part in rows.split(size)]


def take(world: World, rows: Tensor, keys: tuple[str, ...] = SCENE_KEYS) -> World:
    """Scenes rows [b] of a World with these keys of the scene, without plans and
    routes."""
    agents = {key: getattr(world, key)[rows] for key in AGENT_KEYS}
    mission_s = None if world.mission_s is None else world.mission_s[rows]
    return World(
        world.scene.select(*keys)[rows], world.step[rows], **agents, mission_s=mission_s
    )


def ranked_actions(
    ego: ScoringEgo, world: World, count: int, hold: int
) -> tuple[Tensor, Tensor]:
    """Actions [B, C, 2] (m/s^2, rad/s) of the C = `count` cheapest candidates, in the
    mean over the coming `hold` steps, and their costs [B, C]."""
    states, costs = ego.ranked(world, count)
    now = world.states[:, None, :1].expand_as(states[:, :, :1])
    return dynamics.inverse(torch.cat([now, states[:, :, :hold]], 2)).mean(2), costs


PROFILES = (
    *(
        (-8.0, -8.0),
        (-8.0, 0.0),
        (-6.0, -6.0),
        (-6.0, 0.0),
        (-6.0, 2.0),
        (-4.0, -4.0),
        (-4.0, 0.0),
    ),
    *((-2.5, -2.5), (-2.5, 0.0), (-1.2, -1.2), (-1.2, 0.0)),
    *(
        (0.0, 0.0),
        (0.0, -3.0),
        (0.0, -8.0),
        (0.0, 1.5),
        (1.2, 1.2),
        (1.2, 0.0),
        (1.2, -3.0),
    ),
    *(
        (2.5, 2.5),
        (2.5, 0.0),
        (2.5, -4.0),
        (4.0, 4.0),
        (4.0, 0.0),
        (4.0, -6.0),
        (5.0, 5.0),
        (5.0, -8.0),
    ),
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
)  # m beside the mission, left positive
BRAKING_MORE = 1.0  # m/s^2 by which braking may exceed what the speed caps are made for


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
        caps = path.speed_caps(self.max_speed)
        speed = speed_profiles(
            start[:, 3],
            start.new_tensor(PROFILES),
            caps=caps,
            braking=BRAKING + BRAKING_MORE,
        )
        beside = start.new_tensor(SHIFTS).expand(len(start), -1)
        shift = torch.cat([beside, beside, path.d[:, None]], 1)
        time = start.new_tensor(
            [self.swift] * len(SHIFTS) + [self.calm] * len(SHIFTS) + [self.swift]
        )
        return drive(start, path, speed, shift[:, None], time)
