"""Egos that choose among candidates by their cost, and how the candidates rank: soft labels for an imitator."""

from abc import abstractmethod
from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.ego.base import Ego
from e2rl.ego.candidates import Candidates
from e2rl.ego.forecast import forecast, nearest
from e2rl.ego.path import MissionPath
from e2rl.ego.scoring import Weights, score
from e2rl.scene.recording import DT
from e2rl.scene.route import project
from e2rl.sim import dynamics
from e2rl.sim.world import World

STRIDE = 2  # steps between two scored states
WIDER = 4  # times as many candidates are ranked as asked for, among which those driven alike are dropped
ALIKE = 1e-4  # m, rad, m/s and cost below which two candidates are driven alike
SCENE_KEYS = (
    *("size", "route_log", "route_points", "route_length", "route_open", "route_limit", "route_light", "route_light_s"),
    *("light_state", "field", "field_origin"),
)  # that costs and paths need


class RankingEgo(Ego):
    """An ego that plans its cheapest candidate and can tell the others' costs."""

    @abstractmethod
    def ranked(self, world: World, count: int) -> tuple[Tensor, Tensor]:
        """Planned states [B, C, PLAN_STEPS, 4] and costs [B, C] of the C = `count` cheapest candidates, the cheapest
        first; inf where there are no more."""

    @abstractmethod
    def rated(self, world: World, states: Tensor) -> Tensor:
        """Costs [B, C], in the same units, of driving along states [B, C, PLAN_STEPS, 4] that somebody else plans."""


class Outlook(NamedTuple):
    """Whom a ScoringEgo looks at, and how it forecasts them.

    horizon [s] that is scored, at most 5; agents: as many, those that come nearest; hold, turn [s]: they hold their
    acceleration and their path's curvature as long; see_vrus: others than vehicles are looked at, too.
    """

    horizon: float
    agents: int
    hold: float
    turn: float
    see_vrus: bool


class ScoringEgo(RankingEgo):
    """Plans the cheapest of its `candidates` by `scoring.score` on a forecast of the others. It looks at nobody's plan.

    CHUNK: scenes that are planned for at a time; READS: keys of the scene that are looked at.
    """

    CHUNK = 64
    READS: tuple[str, ...] = SCENE_KEYS

    def __init__(self, outlook: Outlook, weights: Weights, replan_every: int) -> None:
        super().__init__(replan_every)
        self.outlook, self.weights = outlook, weights

    @abstractmethod
    def candidates(self, world: World) -> Candidates:
        """The candidates [B, C] that it chooses among."""

    def costs(self, world: World, candidates: Candidates) -> Tensor:
        """Costs [B, C] of candidates."""
        outlook = self.outlook
        steps = torch.arange(STRIDE, round(outlook.horizon / DT) + 1, STRIDE, device=world.step.device)
        agents, seen = nearest(world, outlook.agents, outlook.see_vrus)
        others = forecast(world, agents, seen, steps * DT, outlook.hold, outlook.turn)
        return score(world, candidates, others, steps, self.weights)

    def plan(self, world: World) -> Tensor:
        """The states [B, PLAN_STEPS, 4] of the candidate that costs least."""
        return torch.cat([self._plan(part) for part in self._chunks(world)])

    def _plan(self, world: World) -> Tensor:
        candidates = self.candidates(world)
        best = self.costs(world, candidates).argmin(1)
        return candidates.states[torch.arange(len(best), device=best.device), best]

    def ranked(self, world: World, count: int) -> tuple[Tensor, Tensor]:
        """States [B, C, PLAN_STEPS, 4] and costs [B, C] of the cheapest candidates, the cheapest first; of those that
        are driven alike (caps and bounds make many so) one counts, the others cost inf."""
        states, costs = zip(*(self._ranked(part, count) for part in self._chunks(world)), strict=True)
        return torch.cat(states), torch.cat(costs)

    def _ranked(self, world: World, count: int) -> tuple[Tensor, Tensor]:
        candidates = self.candidates(world)
        every = self.costs(world, candidates)
        costs, best = every.topk(min(WIDER * count, every.shape[1]), largest=False)
        row = torch.arange(len(best), device=best.device)[:, None]
        states = candidates.states[row, best]
        alike = (states.diff(dim=1).abs().amax((2, 3)) < ALIKE) & (costs.diff(dim=1) < ALIKE)
        costs = costs.masked_fill(torch.nn.functional.pad(alike, (1, 0)), torch.inf)
        costs, best = costs.topk(count, largest=False)
        return states[row, best], costs

    def rated(self, world: World, states: Tensor) -> Tensor:
        """Costs [B, C] of driving along states [B, C, PLAN_STEPS, 4], which lead where they end."""
        path = MissionPath(world)
        end, shift, _ = project(states[:, :, -1, :2], path.route)
        return self.costs(world, Candidates(states, end - path.s[:, None], shift))

    def _chunks(self, world: World) -> list[World]:
        rows = torch.arange(len(world.step), device=world.step.device)
        return [take(world, part, self.READS) for part in rows.split(self.CHUNK)]


def take(world: World, rows: Tensor, keys: tuple[str, ...] = SCENE_KEYS) -> World:
    """Scenes rows [b] of a World with these keys of the scene, and nobody's plan or route."""
    turn = None if world.turn_rate is None else world.turn_rate[rows]
    now = world.step[rows], world.states[rows], world.valid[rows], world.accel[rows]
    return World(world.scene.select(*keys)[rows], *now, turn_rate=turn)


def ranked_actions(ego: RankingEgo, world: World, count: int, hold: int) -> tuple[Tensor, Tensor]:
    """Actions [B, C, 2] (m/s^2, rad/s) of the C = `count` cheapest candidates, in the mean over the coming `hold`
    steps, and their costs [B, C]."""
    states, costs = ego.ranked(world, count)
    now = world.states[:, None, :1].expand_as(states[:, :, :1])
    return dynamics.inverse(torch.cat([now, states[:, :, :hold]], 2)).mean(2), costs
