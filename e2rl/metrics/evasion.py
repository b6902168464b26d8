"""Which collisions the ego could have avoided, found by search (docs/method.md, section
10).

The others move as they did: they do not react. Candidates are longitudinal profiles on
lateral targets (the ego's routes, and shifts beside its mission). Where none is clean,
an evolution strategy perturbs the knots of the best ones. What it finds proves that a
collision was avoidable; what it does not find proves nothing.
"""

import torch
from tensordict import TensorClass, TensorDictBase
from torch import Tensor

from e2rl.metrics.catalogue import Metric, declare, rate
from e2rl.metrics.manoeuvre import (
    KNOT_STEPS,
    EvasionScene,
    execute,
    knot_count,
    knots_of,
    peak_acceleration,
    violations,
)
from e2rl.scenes.recording import DT
from e2rl.sim import dynamics
from e2rl.sim.env import SimSettings
from e2rl.sim.rollouts import Rollouts

BRAKES = (2.0, 4.0, 6.0, 8.0)  # m/s^2, held from a moment on
PULSES = (
    (3.0, 1.0),
    (3.0, 2.0),
    (6.0, 1.0),
    (6.0, 2.0),
    (-2.0, 2.0),
    (-4.0, 2.0),
)  # m/s^2 of braking, s it lasts
BEGINS = (0.0, 1.0, 2.0, 3.0, 4.0)  # s
SHIFTS = (0.0, 1.5, -1.5, 3.5, -3.5, 2.5, -2.5)  # m beside the mission
RAMP = 3  # knots that a shift takes
TARGETS = 8  # lateral targets a profile is tried on
CHUNK = 8  # rollouts searched at once: bounds the memory
CLEARANCE = 0.05  # m that an evasion keeps to others
ROAD_MARGIN = 0.5  # m inside the drivable border (1 m beyond the lanes) that its centre keeps; recorded egos keep 0.8
SAMPLES, SURVIVORS, ROUNDS = 192, 24, 16  # of the strategy: per round, parents, at most
ACCEL_STD, SHIFT_STD = 4.0, 2.0  # m/s^2, m: largest standard deviations of the strategy
LATE = 1.0  # s before contact at which the late search starts

declare(
    rate(
        "avoidable",
        "collisions that some ego actions avoid, found by search",
        per_collision=True,
        tables="main adversaries",
    ),
    rate(
        "avoidable_1s", "the same, acting only 1 s before contact", per_collision=True
    ),
    Metric(
        "evasion_accel",
        "peak acceleration of the mildest evasion found",
        unit="m/s²",
        per_collision=True,
    ),
)


class Evasions(TensorClass):
    """The mildest evasion found of each rollout [B], else the manoeuvre that violates
    least."""

    found: Tensor  # [B] bool
    actions: Tensor  # [B, T, 2]
    states: Tensor  # [B, T, 4], at steps 1..T
    peak: Tensor  # [B] m/s^2, its largest acceleration


class Trials(TensorClass):
    """C manoeuvres of each of B rollouts."""

    route: Tensor  # [B, C], candidate
    accel: Tensor  # [B, C, K], knots
    shift: Tensor  # [B, C, K], knots
    actions: Tensor  # [B, C, T, 2]
    states: Tensor  # [B, C, T, 4]
    violation: Tensor  # [B, C] m, summed over steps; 0 is clean
    peak: Tensor  # [B, C] m/s^2

    def best(self, count: int) -> "Trials":
        """The best of each rollout: clean ones first, by their peak, then by their
        violation."""
        rank = torch.where(self.violation > 0, 1e3 + self.violation, self.peak)
        row = torch.arange(len(rank), device=rank.device)[:, None]
        return self[row, rank.argsort(1)[:, :count]]

    def evasions(self) -> Evasions:
        """The best of each rollout."""
        best = self.best(1)[:, 0]
        return Evasions(
            best.violation == 0,
            best.actions,
            states=best.states,
            peak=best.peak,
            batch_size=best.batch_size,
        )


def find_evasions(
    scene: TensorDictBase,
    states: Tensor,
    valid: Tensor,
    sim: SimSettings,
    moment: Tensor | None = None,
) -> Evasions:
    """The mildest evasion found of each rollout; all draw the same numbers, so a result
    does not depend on the batch.

    states [B, T+1, N, 4], valid [B, T+1, N]: motion in scenes [B >= 1]; moment [B]
    int64: the step from which the ego may act otherwise (None: 0). An evasion holds the
    T steps from there on and counts to the last recorded one.
    """
    moment = (
        torch.zeros(len(states), dtype=torch.int64, device=states.device)
        if moment is None
        else moment
    )
    rows = torch.arange(len(states), device=states.device).split(CHUNK)
    parts = [
        _search(
            scene[row],
            states[row].float(),
            valid=valid[row],
            moment=moment[row],
            sim=sim,
        )
        for row in rows
    ]
    return Evasions.cat(parts)


def _search(
    scene: TensorDictBase,
    states: Tensor,
    valid: Tensor,
    moment: Tensor,
    sim: SimSettings,
) -> Evasions:
    steps = states.shape[1] - 1
    driven = dynamics.inverse(states[:, :, 0])[..., 0].masked_fill(
        ~valid[:, 1:, 0], 0.0
    )
    driven = driven.gather(
        1,
        (moment[:, None] + torch.arange(steps, device=moment.device)).clamp(
            max=steps - 1
        ),
    )
    task = EvasionScene.after(moment, scene, states=states, valid=valid)
    pool = _try(
        task,
        *grid(driven, scene["route_valid"][:, 0], mission=scene["route_log"][:, 0]),
        sim,
    )
    result = pool.evasions()
    row = torch.arange(len(states), device=states.device)
    generator = torch.Generator().manual_seed(0)
    for _ in range(ROUNDS):
        left = ~result.found[row]
        row = row[left]
        task = task[left]
        pool = pool[left]
        if not len(row):
            break
        parents = pool.best(SURVIVORS)
        pool = Trials.cat([parents, _try(task, *_mutated(parents, generator), sim)], 1)
        result[row] = pool.evasions()
    return result


def profiles(driven: Tensor) -> Tensor:
    """Knots [B, L, K] of longitudinal profiles: constant speed, braking and
    accelerating from a moment on or for a while, and the same on top of the
    acceleration driven [B, T] m/s^2."""
    batch, steps = driven.shape
    at = (
        torch.arange(knot_count(steps), device=driven.device, dtype=driven.dtype)
        * KNOT_STEPS
        * DT
    )
    pulses = [torch.zeros_like(at)]
    pulses += [-level * (at >= begin) for level in BRAKES for begin in BEGINS]
    pulses += [
        -level * ((at >= begin) & (at < begin + time))
        for level, time in PULSES
        for begin in BEGINS
    ]
    profile = torch.stack(pulses).expand(batch, -1, -1)
    return torch.cat([profile, knots_of(driven)[:, None] + profile], 1)


def lateral_targets(route_valid: Tensor, mission: Tensor) -> tuple[Tensor, Tensor]:
    """Route candidate and shift [m] beside it, each [B, TARGETS], of the ego whose own
    candidate is mission [B].

    In order: the mission, half a lane to either side, the other candidates (route_valid
    [B, R]), more shifts.
    """
    batch, count = route_valid.shape
    shift = torch.tensor(SHIFTS, device=mission.device).expand(batch, -1)
    own = mission[:, None].expand(-1, len(SHIFTS))
    others = torch.arange(count, device=mission.device).expand(batch, -1)
    route = torch.cat([own[:, :3], others, own[:, 3:]], 1)
    shift = torch.cat(
        [shift[:, :3], torch.zeros_like(others, dtype=shift.dtype), shift[:, 3:]], 1
    )
    useful = torch.ones_like(route, dtype=torch.bool)
    useful[:, 3 : 3 + count] = route_valid & (others != mission[:, None])
    order = torch.argsort(~useful, dim=1, stable=True)[:, :TARGETS]
    return route.gather(1, order), shift.gather(1, order)


def grid(
    driven: Tensor, route_valid: Tensor, mission: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Route [B, C], acceleration and shift knots [B, C, K] of every profile on every
    lateral target."""
    accel, (route, shift) = profiles(driven), lateral_targets(route_valid, mission)
    shape = (*accel.shape[:2], route.shape[1])
    knots = accel.shape[-1]
    ramp = (torch.arange(-1, knots - 1, device=shift.device) / RAMP).clamp(0, 1)
    accel = accel[:, :, None]
    shift = shift[:, None, :, None] * ramp
    knots_each = [value.expand(*shape, knots).flatten(1, 2) for value in (accel, shift)]
    return route[:, None].expand(shape).flatten(1), knots_each[0], knots_each[1]


def _try(
    task: EvasionScene, route: Tensor, accel: Tensor, shift: Tensor, sim: SimSettings
) -> Trials:
    """The manoeuvres of these knots, executed and judged."""
    row = torch.arange(len(route), device=route.device)[:, None]
    start = task.start[:, None].expand(*route.shape, 4)
    actions, states = execute(
        start,
        task.routes[row, route],
        accel=accel,
        shift=shift,
        steps=task.inside.shape[1],
        sim=sim,
    )
    violation = violations(
        states, task, clearance=CLEARANCE, road_margin=ROAD_MARGIN
    ).sum(-1)
    peak = peak_acceleration(start, states)
    return Trials(
        route,
        accel,
        shift=shift,
        actions=actions,
        states=states,
        violation=violation,
        peak=peak,
        batch_size=route.shape,
    )


def _mutated(
    parents: Trials, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Route, acceleration and shift knots of SAMPLES children of parents [B, C], better
    ones more often: disturbed smoothly over about 1 s, with a strength drawn for each
    child."""
    count = SAMPLES
    knots = parents.accel.shape[-1]
    device = parents.accel.device
    parent = torch.rand(count, generator=generator).to(device)
    strength = torch.rand(count, 2, generator=generator).square() + 0.02
    gap = torch.arange(knots)[:, None] - torch.arange(knots)
    smooth = torch.exp(-((gap / 2.0) ** 2) / 2)
    smooth = smooth / smooth.norm(dim=-1, keepdim=True)
    white = torch.randn(2, count, knots, generator=generator)
    accel, shift = (white @ smooth.T * strength.T[..., None]).to(device)
    index = (parent.square() * parents.route.shape[1]).long()
    parents = parents[:, index]
    return (
        parents.route,
        parents.accel + ACCEL_STD * accel,
        parents.shift + SHIFT_STD * shift,
    )


def add_avoidable(
    rows: list[dict], rollouts: Rollouts, scene: TensorDictBase, sim: SimSettings
) -> None:
    """Search the collisions of the ego for evasions; what is found goes into the rows
    and into `rollouts.evasion`.

    Args:
        rows: of `score_rollouts`. Those with a collision get avoidable and avoidable_1s
            (0 or 1: an evasion was found
            from the start, from LATE seconds before contact), evasion_accel [m/s^2] of the mildest one from the start.
        rollouts: [B], those of the rows. `evasion` [B, T+1, 4] is the ego's mildest one
            from the start where there is
            one, else the late one; NaN where none was found.
        scene: their scenes [B].
        sim: the ego's limits.
    """
    rollouts.evasion = torch.full_like(rollouts.states[:, :, 0], torch.nan)
    collided = [index for index, row in enumerate(rows) if row["cfr"] == 1]
    if not collided:
        return
    picked = torch.tensor(collided)
    given = scene[picked], rollouts.states[picked], rollouts.valid[picked]
    contact = torch.tensor([int(rows[index]["contact_step"]) for index in collided])
    early = find_evasions(*given, sim)
    moment = (contact - round(LATE / DT)).clamp(min=0)
    late = find_evasions(*given, sim, moment)
    found = (
        early.found | late.found
    )  # avoidable late implies avoidable early: drive as in the rollout until then
    peak = torch.where(
        early.found, early.peak, torch.where(late.found, late.peak, torch.nan)
    )
    for row, index in enumerate(collided):
        rows[index] |= {
            "avoidable": float(found[row]),
            "avoidable_1s": float(late.found[row]),
            "evasion_accel": peak[row].item(),
        }
    start = given[1][:, :1, 0]
    driven = given[1][:, 1:, 0]
    for evasion, begin in ((late, moment), (early, torch.zeros_like(moment))):
        whole = torch.cat([start, spliced(driven, evasion.states, moment=begin)], 1)
        rollouts.evasion[picked[evasion.found]] = whole[evasion.found]


def spliced(driven: Tensor, evasion: Tensor, moment: Tensor) -> Tensor:
    """States or actions [B, T, C] of the T steps: those driven [B, T, C] before
    `moment` [B], then those of an evasion [B, T, C] that begins there."""
    since = torch.arange(driven.shape[1], device=driven.device) - moment[:, None]
    after = evasion.gather(1, since.clamp(min=0)[..., None].expand_as(evasion))
    return torch.where((since >= 0)[..., None], after, driven)


def search_effort(steps: int) -> str:
    """Caption on the search behind `avoidable`, for rollouts of `steps` steps."""
    count = len(profiles(torch.zeros(1, steps))[0]) * TARGETS
    return f"avoidable: not found after {count} manoeuvres, then {ROUNDS} rounds of {SAMPLES} counts as no"
