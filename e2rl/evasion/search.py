"""The search for an ego action sequence that avoids contact, given how everybody else moved (design.md section 5).

Others are fixed: they do not react. Candidates are longitudinal profiles x ways (routes of the ego and shifts beside
its mission); where none is clean, an evolution strategy perturbs the knots of the best ones. What it finds is proof
that a collision was avoidable; what it does not find proves nothing.
"""

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.evasion.manoeuvre import KNOT_STEPS, Limits, drive, knot_count, knots_of, peak_acceleration
from e2rl.evasion.violation import Surroundings, violations
from e2rl.scene.recording import DT
from e2rl.sim import dynamics
from e2rl.sim.env import SimSettings

BRAKES = (2.0, 4.0, 6.0, 8.0)  # m/s^2 held from a moment on, or for a while
BEGINS = (0.0, 1.0, 2.0, 3.0, 4.0)  # s
DABS = ((3.0, 1.0), (3.0, 2.0), (6.0, 1.0), (6.0, 2.0), (-2.0, 2.0), (-4.0, 2.0))  # m/s^2 of braking, s it lasts
SHIFTS = (0.0, 1.5, -1.5, 3.5, -3.5, 2.5, -2.5)  # m beside the mission
RAMP = 3  # knots that a shift takes
WAYS = 8  # ways a profile is tried on
CHUNK = 8  # rollouts searched at once: bounds the memory


@dataclass(frozen=True)
class SearchSettings:
    """clearance [m] an evasion keeps to others, and shoulder [m] its centre keeps inside the road's border, which lies
    1 m beyond the lanes (recorded egos keep 0.8 m); the strategy's samples a round, survivors, rounds at most, and its
    largest standard deviations of an acceleration [m/s^2] and of a shift [m]."""

    clearance: float = 0.05
    shoulder: float = 0.5
    samples: int = 192
    survivors: int = 24
    rounds: int = 16
    accel_spread: float = 4.0
    shift_spread: float = 2.0

    def effort(self, steps: int) -> str:
        """What is tried before a collision counts as not avoided, in words."""
        return (
            f"{len(profiles(torch.zeros(1, steps))[0]) * WAYS} manoeuvres, then {self.rounds} rounds of {self.samples}"
        )


@dataclass(frozen=True)
class Evasions:
    """Per rollout [B]: found; actions [B, T, 2] and states [B, T, 4] at steps 1..T of the mildest found, else of the
    one that missed least; peak [B]: its largest acceleration [m/s^2]; tried [B]: manoeuvres driven."""

    found: Tensor
    actions: Tensor
    states: Tensor
    peak: Tensor
    tried: Tensor


@dataclass(frozen=True)
class Trials:
    """C manoeuvres of each of B rollouts: route [B, C], knots accel and shift [B, C, K], what they did (actions, states
    [B, C, T, .]), metres missed, summed over steps [B, C] (0: clean), peak [B, C]."""

    route: Tensor
    accel: Tensor
    shift: Tensor
    actions: Tensor
    states: Tensor
    missed: Tensor
    peak: Tensor

    def best(self, count: int) -> Tensor:
        """Indices [B, count]: clean ones first, the mildest before others, then by what they missed."""
        rank = torch.where(self.missed > 0, 1e3 + self.missed, self.peak)
        return rank.argsort(1)[:, :count]


def find_evasions(
    scene: TensorDictBase,
    states: Tensor,
    valid: Tensor,
    sim: SimSettings,
    settings: SearchSettings | None = None,
    moment: Tensor | None = None,
) -> Evasions:
    """Search for every rollout of scenes [B], at least one, with states [B, T+1, N, 4], valid [B, T+1, N] (all agents,
    the ego in row 0), from step moment [B] (default 0: the start frame) to the last, within the simulator's bounds.

    Evasions hold the T steps from that moment on. A rollout's result does not depend on the batch: all draw the same
    numbers.
    """
    settings = settings or SearchSettings()
    moment = torch.zeros(len(states), dtype=torch.int64, device=states.device) if moment is None else moment
    parts = [
        _search(scene[rows], states[rows].float(), valid[rows], moment[rows], Limits.of(sim), settings)
        for rows in torch.arange(len(states), device=states.device).split(CHUNK)
    ]
    return Evasions(*(torch.cat([getattr(part, name) for part in parts]) for name in Evasions.__dataclass_fields__))


def _search(
    scene: TensorDictBase, states: Tensor, valid: Tensor, moment: Tensor, limits: Limits, settings: SearchSettings
) -> Evasions:
    around, routes = Surroundings.of(scene, states, valid, moment), scene["route_points"][:, 0]
    steps = states.shape[1] - 1
    driven = dynamics.inverse(states[:, :, 0])[..., 0].masked_fill(~valid[:, 1:, 0], 0.0)
    driven = driven.gather(1, (moment[:, None] + torch.arange(steps, device=moment.device)).clamp(max=steps - 1))
    route, accel, shift = grid(driven, scene["route_valid"][:, 0], scene["route_log"][:, 0])
    trials = _drive(around, routes, route, accel, shift, steps, limits, settings)
    result, tried = _kept(trials), torch.full((len(states),), route.shape[1], device=states.device)
    open_rows = (~result.found).nonzero()[:, 0]
    generator = torch.Generator().manual_seed(0)
    pool = _rows(trials, open_rows)
    for _ in range(settings.rounds):
        noise = _noise(settings, accel.shape[-1], generator)
        if not len(open_rows):
            break
        parents = _pick(pool, pool.best(settings.survivors))
        children = _mutated(parents, noise)
        part = around.rows(open_rows)
        trials = _drive(part, routes[open_rows], *children, steps, limits, settings)
        pool = Trials(
            *(torch.cat([getattr(parents, name), getattr(trials, name)], 1) for name in Trials.__dataclass_fields__)
        )
        best = _kept(pool)
        result = Evasions(
            *(
                getattr(result, name).index_copy(0, open_rows, getattr(best, name))
                for name in ("found", "actions", "states", "peak")
            ),
            result.tried,
        )
        tried[open_rows] += settings.samples
        left = (~best.found).nonzero()[:, 0]
        open_rows, pool = open_rows[left], _rows(pool, left)
    return Evasions(result.found, result.actions, result.states, result.peak, tried)


def profiles(driven: Tensor) -> Tensor:
    """Knots [B, L, K] of longitudinal profiles: as driven [B, T] m/s^2, at constant speed, braking and accelerating
    from a moment on or for a while, and the same on top of what was driven."""
    batch, steps = driven.shape
    at = torch.arange(knot_count(steps), device=driven.device, dtype=driven.dtype) * KNOT_STEPS * DT
    pulses = [torch.zeros_like(at)]
    pulses += [-level * (at >= begin) for level in BRAKES for begin in BEGINS]
    pulses += [-level * ((at >= begin) & (at < begin + time)) for level, time in DABS for begin in BEGINS]
    pulses = torch.stack(pulses).expand(batch, -1, -1)
    return torch.cat([pulses, knots_of(driven)[:, None] + pulses], 1)


def ways(route_valid: Tensor, mission: Tensor) -> tuple[Tensor, Tensor]:
    """Candidate [B, WAYS] and shift [m, B, WAYS] of the ways: the mission, one lane's half to either side, the other
    candidates (route_valid [B, R]), more shifts. mission [B]: the ego's own candidate."""
    batch, count = route_valid.shape
    shift = torch.tensor(SHIFTS, device=mission.device)
    own = mission[:, None].expand(-1, len(SHIFTS))
    others = torch.arange(count, device=mission.device).expand(batch, -1)
    route = torch.cat([own[:, :3], others, own[:, 3:]], 1)
    moved = torch.cat(
        [shift[:3].expand(batch, -1), torch.zeros_like(others, dtype=shift.dtype), shift[3:].expand(batch, -1)], 1
    )
    useful = torch.ones_like(route, dtype=torch.bool)
    useful[:, 3 : 3 + count] = route_valid & (others != mission[:, None])
    order = torch.argsort(~useful, dim=1, stable=True)[:, :WAYS]
    return route.gather(1, order), moved.gather(1, order)


def grid(driven: Tensor, route_valid: Tensor, mission: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Route [B, C], acceleration and shift knots [B, C, K] of every profile on every way."""
    accel, (route, shift) = profiles(driven), ways(route_valid, mission)
    batch, count, knots = accel.shape
    shape = (batch, count, route.shape[1])
    ramp = (torch.arange(-1, knots - 1, device=shift.device) / RAMP).clamp(0, 1)
    wide = accel[:, :, None].expand(*shape, knots).flatten(1, 2)
    return (
        route[:, None].expand(shape).flatten(1),
        wide,
        (shift[:, None, :, None] * ramp).expand(*shape, knots).flatten(1, 2),
    )


def _drive(
    around: Surroundings,
    routes: Tensor,
    route: Tensor,
    accel: Tensor,
    shift: Tensor,
    steps: int,
    limits: Limits,
    settings: SearchSettings,
) -> Trials:
    row = torch.arange(len(route), device=route.device)[:, None]
    start = around.start[:, None].expand(*route.shape, 4)
    actions, states = drive(start, routes[row, route], accel, shift, steps, limits)
    missed = violations(states, around, settings.clearance, settings.shoulder).sum(-1)
    return Trials(route, accel, shift, actions, states, missed, peak_acceleration(start, states)[..., -1])


def _noise(settings: SearchSettings, knots: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Parents [M] (a share of the survivors in [0, 1)) and disturbances [M, K] of both kinds of knots: smooth over
    about 1 s, of a strength drawn for each sample, so that small and large changes are both tried."""
    count = settings.samples
    parent = torch.rand(count, generator=generator)
    strength = torch.rand(count, 2, generator=generator).square() + 0.02
    gap = torch.arange(knots)[:, None] - torch.arange(knots)
    smooth = torch.exp(-((gap / 2.0) ** 2) / 2)
    smooth = smooth / smooth.norm(dim=-1, keepdim=True)
    white = torch.randn(2, count, knots, generator=generator)
    disturbed = white @ smooth.T * strength.T[..., None]
    return parent, settings.accel_spread * disturbed[0], settings.shift_spread * disturbed[1]


def _mutated(parents: Trials, noise: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    share, accel, shift = (value.to(parents.accel.device) for value in noise)
    index = (share.square() * parents.route.shape[1]).long()  # better ones more often
    return parents.route[:, index], parents.accel[:, index] + accel, parents.shift[:, index] + shift


def _kept(trials: Trials) -> Evasions:
    """The best manoeuvre of each rollout."""
    best = _pick(trials, trials.best(1))
    return Evasions(
        best.missed[:, 0] == 0,
        best.actions[:, 0],
        best.states[:, 0],
        best.peak[:, 0],
        torch.zeros_like(best.route[:, 0]),
    )


def _pick(trials: Trials, index: Tensor) -> Trials:
    """Manoeuvres index [B, C'] of each rollout."""
    row = torch.arange(len(index), device=index.device)[:, None]
    return Trials(*(getattr(trials, name)[row, index] for name in Trials.__dataclass_fields__))


def _rows(trials: Trials, rows: Tensor) -> Trials:
    return Trials(*(getattr(trials, name)[rows] for name in Trials.__dataclass_fields__))
