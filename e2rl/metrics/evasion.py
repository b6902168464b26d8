"""Which collisions the ego could have avoided, found by search (docs/reference/metrics.md).

The others move as they did: they do not react. Candidates are longitudinal profiles on
lateral targets (the ego's routes, and shifts beside its mission). Where none is clean,
an evolution strategy perturbs the knots of the best ones. What it finds proves that a
collision was avoidable; what it does not find proves nothing.
"""

import torch
from tensordict import TensorClass, TensorDictBase
from torch import Tensor

from e2rl.metrics.catalogue import Metric, declare, rate
from e2rl.metrics.evasion_scene import EvasionScene, violations
from e2rl.metrics.manoeuvre import (
    KNOT_STEPS,
    execute,
    knot_count,
    knots_of,
    peak_acceleration,
)
from e2rl.scenes.recording import DT
from e2rl.sim import dynamics
from e2rl.sim.rollouts import Rollouts
from e2rl.sim.settings import SimSettings

BRAKES = (2.0, 4.0, 6.0, 8.0)  # m/s^2, held from a moment on
PULSES = (  # m/s^2 of braking, s it lasts
    (3.0, 1.0),
    (3.0, 2.0),
    (6.0, 1.0),
    (6.0, 2.0),
    (-2.0, 2.0),
    (-4.0, 2.0),
)
BEGINS = (0.0, 1.0, 2.0, 3.0, 4.0)  # s
SHIFTS = (0.0, 1.5, -1.5, 3.5, -3.5, 2.5, -2.5)  # m beside the mission
FIRST_SHIFTS = 3  # of SHIFTS, tried before the other routes
RAMP = 3  # knots that a shift takes
TARGETS = 8  # lateral targets a profile is tried on
CHUNK = 8  # rollouts searched at once
STEPS = 1 << 17  # of manoeuvres executed at once: bounds the memory
CLEARANCE = 0.05  # m to others that an evasion leaves
ROAD_MARGIN = 0.5  # m inside the drivable border (1 m beyond the lanes), of its centre
SAMPLES = 192  # of a round of the strategy
SURVIVORS = 24  # of a round, parents of the next
ROUNDS = 16  # at most
ACCEL_STD = 4.0  # m/s^2, largest standard deviation of the strategy
SHIFT_STD = 2.0  # m, the same
LEAST_STRENGTH = 0.02  # of a child's standard deviation
SMOOTH_KNOTS = 2.0  # over which disturbances are smooth
LATE = 1.0  # s before contact at which the late search starts

declare(
    rate(
        "avoidable",
        "collisions that some ego actions avoid, found by search",
        per_collision=True,
        tables="main adversaries",
    ),
    rate(
        "avoidable_1s",
        "the same, acting only 1 s before contact",
        per_collision=True,
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


class Knots(TensorClass):
    """C manoeuvres of each of B rollouts."""

    route: Tensor  # [B, C], candidate
    accel: Tensor  # [B, C, K] m/s^2
    shift: Tensor  # [B, C, K] m


class Trials(TensorClass):
    """C manoeuvres of each of B rollouts, executed."""

    knots: Knots  # [B, C]
    actions: Tensor  # [B, C, T, 2]
    states: Tensor  # [B, C, T, 4]
    violation: Tensor  # [B, C] m, summed over steps; 0 is clean
    peak: Tensor  # [B, C] m/s^2

    def best(self, count: int) -> "Trials":
        """The best of each rollout: clean ones first, by their peak, then by their
        violation."""
        rank = torch.where(self.violation > 0, 1e3 + self.violation, self.peak)
        row = torch.arange(len(rank))[:, None]
        return self[row, rank.argsort(1)[:, :count]]

    def evasions(self) -> Evasions:
        """The best of each rollout."""
        best = self.best(1)[:, 0]
        return Evasions(
            found=best.violation == 0,
            actions=best.actions,
            states=best.states,
            peak=best.peak,
            batch_size=best.batch_size,
        )


def find_evasions(
    scene: TensorDictBase,
    states: Tensor,
    *,
    valid: Tensor,
    sim: SimSettings,
    moment: Tensor | None = None,
) -> Evasions:
    """The mildest evasion found of each rollout; all draw the same numbers, so a result
    does not depend on the batch.

    An evasion holds the T steps from its moment on and counts to the last recorded one.

    Args:
        scene: [B >= 1].
        states: [B, T+1, N, 4], motion in the scenes.
        valid: [B, T+1, N] bool.
        sim: the ego's limits.
        moment: [B] int64, the step from which the ego may act otherwise (None: 0).
    """
    if moment is None:
        moment = torch.zeros(len(states), dtype=torch.int64)
    parts = [
        search(
            EvasionScene.after(
                moment[row],
                scene[row],
                states=states[row].float(),
                valid=valid[row],
            ),
            grid(
                driven_acceleration(states[row].float(), valid[row], moment[row]),
                route_valid=scene["route_valid"][row, 0],
                mission=scene["route_log"][row, 0],
            ),
            sim,
        )
        for row in torch.arange(len(states)).split(CHUNK)
    ]
    return Evasions.cat(parts)


def driven_acceleration(states: Tensor, valid: Tensor, moment: Tensor) -> Tensor:
    """Accelerations [B, T] of the ego in the steps after moment [B], the last one
    repeated, of states [B, T+1, N, 4] and valid [B, T+1, N]."""
    accel = dynamics.inverse(states[:, :, 0])[..., 0]
    accel = accel.masked_fill(~valid[:, 1:, 0], 0.0)
    steps = accel.shape[1]
    step = moment[:, None] + torch.arange(steps)
    return accel.gather(1, step.clamp(max=steps - 1))


def search(scene: EvasionScene, knots: Knots, sim: SimSettings) -> Evasions:
    """The mildest evasion of each scene among these manoeuvres, and, where none is
    clean, among ROUNDS of an evolution strategy that begins with them."""
    pool = executed(
        scene,
        knots,
        sim=sim,
    )
    result = pool.evasions()
    row = torch.arange(len(result))
    generator = torch.Generator().manual_seed(0)
    for _ in range(ROUNDS):
        left = ~result.found[row]
        row = row[left]
        if not len(row):
            break
        scene = scene[left]
        parents = pool[left].best(SURVIVORS)
        children = executed(
            scene,
            mutated(parents.knots, generator),
            sim=sim,
        )
        pool = Trials.cat([parents, children], 1)
        result[row] = pool.evasions()
    return result


def profiles(driven: Tensor) -> Tensor:
    """Knots [B, L, K] of longitudinal profiles: constant speed, braking and
    accelerating from a moment on or for a while, and the same on top of the
    acceleration driven [B, T] m/s^2."""
    batch, steps = driven.shape
    time = torch.arange(knot_count(steps), dtype=driven.dtype) * KNOT_STEPS * DT
    pulses = [torch.zeros_like(time)]
    pulses += [-level * (time >= begin) for level in BRAKES for begin in BEGINS]
    pulses += [
        -level * ((time >= begin) & (time < begin + duration))
        for level, duration in PULSES
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
    shift = torch.tensor(SHIFTS).expand(batch, -1)
    own_route = mission[:, None].expand(-1, len(SHIFTS))
    others = torch.arange(count).expand(batch, -1)
    no_shift = torch.zeros(batch, count)
    first = FIRST_SHIFTS
    route = torch.cat([own_route[:, :first], others, own_route[:, first:]], 1)
    shift = torch.cat([shift[:, :first], no_shift, shift[:, first:]], 1)
    useful = torch.ones_like(route, dtype=torch.bool)
    useful[:, first : first + count] = route_valid & (others != mission[:, None])
    order = torch.argsort(
        ~useful,
        dim=1,
        stable=True,
    )[:, :TARGETS]
    return route.gather(1, order), shift.gather(1, order)


def grid(driven: Tensor, route_valid: Tensor, mission: Tensor) -> Knots:
    """Knots of every profile on every lateral target; arguments as in `profiles` and
    `lateral_targets`."""
    accel = profiles(driven)
    route, shift = lateral_targets(route_valid, mission)
    batch, count, knots = accel.shape
    shape = (batch, count, route.shape[1], knots)
    ramp = (torch.arange(-1, knots - 1) / RAMP).clamp(0, 1)
    shift = shift[:, None, :, None] * ramp
    return Knots(
        route=route[:, None].expand(shape[:3]).flatten(1),
        accel=accel[:, :, None].expand(shape).flatten(1, 2),
        shift=shift.expand(shape).flatten(1, 2),
        batch_size=[batch, count * route.shape[1]],
    )


def executed(scene: EvasionScene, knots: Knots, sim: SimSettings) -> Trials:
    """The manoeuvres of these knots, executed and judged."""
    count = max(1, STEPS // max(1, scene.inside.numel()))
    parts = [execute_part(scene, part, sim) for part in knots.split(count, 1)]
    return Trials.cat(parts, 1)


def execute_part(scene: EvasionScene, knots: Knots, sim: SimSettings) -> Trials:
    """`executed` of a part of the manoeuvres."""
    row = torch.arange(len(scene))[:, None]
    start = scene.start[:, None].expand(*knots.batch_size, 4)
    actions, states = execute(
        start,
        scene.routes[row, knots.route],
        accel=knots.accel,
        shift=knots.shift,
        steps=scene.inside.shape[1],
        sim=sim,
    )
    violation = violations(
        states,
        scene,
        clearance=CLEARANCE,
        road_margin=ROAD_MARGIN,
    )
    return Trials(
        knots=knots,
        actions=actions,
        states=states,
        violation=violation.sum(-1),
        peak=peak_acceleration(start, states),
        batch_size=knots.batch_size,
    )


def mutated(parents: Knots, generator: torch.Generator) -> Knots:
    """SAMPLES children of parents [B, C], better ones more often: disturbed smoothly
    over about 1 s, with a strength drawn for each child."""
    count = parents.accel.shape[-1]
    parent = torch.rand(SAMPLES, generator=generator)
    strength = (
        torch.rand(
            SAMPLES,
            2,
            generator=generator,
        ).square()
        + LEAST_STRENGTH
    )
    gap = torch.arange(count)[:, None] - torch.arange(count)
    smooth = torch.exp(-((gap / SMOOTH_KNOTS) ** 2) / 2)
    smooth = smooth / smooth.norm(dim=-1, keepdim=True)
    white = torch.randn(
        2,
        SAMPLES,
        count,
        generator=generator,
    )
    accel, shift = white @ smooth.T * strength.T[..., None]
    children = parents[:, (parent.square() * parents.route.shape[1]).long()]
    children.accel = children.accel + ACCEL_STD * accel
    children.shift = children.shift + SHIFT_STD * shift
    return children


def add_avoidable(
    rows: list[dict],
    rollouts: Rollouts,
    *,
    scene: TensorDictBase,
    sim: SimSettings,
) -> None:
    """Search the collisions of the ego for evasions; what is found goes into the rows
    and into `rollouts.evasion`.

    Args:
        rows: of `score_rollouts`. Those with a collision get avoidable and avoidable_1s
            (0 or 1: an evasion was found from the start, from LATE seconds before
            contact), evasion_accel [m/s^2] of the mildest one from the start.
        rollouts: [B], those of the rows. `evasion` [B, T+1, 4] is the ego's mildest one
            from the start where there is one, else the late one; NaN where none was
            found.
        scene: their scenes [B].
        sim: the ego's limits.
    """
    rollouts.evasion = torch.full_like(rollouts.states[:, :, 0], torch.nan)
    collided = [row for row in rows if row["cfr"] == 1]
    if not collided:
        return
    hit = torch.tensor([row["cfr"] == 1 for row in rows])
    states = rollouts.states[hit]
    valid = rollouts.valid[hit]
    start = torch.zeros(len(collided), dtype=torch.int64)
    contact = torch.tensor([int(row["contact_step"]) for row in collided])
    late_moment = (contact - round(LATE / DT)).clamp(min=0)
    early, late = (
        find_evasions(
            scene[hit],
            states,
            valid=valid,
            sim=sim,
            moment=moment,
        )
        for moment in (start, late_moment)
    )
    # Avoidable late implies avoidable early: drive as in the rollout until then.
    avoidable = early.found | late.found
    peak = late.peak.where(late.found, torch.nan)
    peak = torch.where(early.found, early.peak, peak)
    for index, row in enumerate(collided):
        row["avoidable"] = float(avoidable[index])
        row["avoidable_1s"] = float(late.found[index])
        row["evasion_accel"] = peak[index].item()
    driven = states[:, :, 0]
    rows_hit = hit.nonzero()[:, 0]
    for evasion, moment in ((late, late_moment), (early, start)):
        later = spliced(
            driven[:, 1:],
            evasion.states,
            moment=moment,
        )
        whole = torch.cat([driven[:, :1], later], 1)
        rollouts.evasion[rows_hit[evasion.found]] = whole[evasion.found]


def spliced(driven: Tensor, evasion: Tensor, moment: Tensor) -> Tensor:
    """States or actions [B, T, C] of the T steps: those driven [B, T, C] before
    `moment` [B], then those of an evasion [B, T, C] that begins there."""
    step = torch.arange(driven.shape[1]) - moment[:, None]
    after = evasion.gather(1, step.clamp(min=0)[..., None].expand_as(evasion))
    return torch.where((step >= 0)[..., None], after, driven)


def search_effort(steps: int) -> str:
    """Caption on the search behind `avoidable`, for rollouts of `steps` steps."""
    count = len(profiles(torch.zeros(1, steps))[0]) * TARGETS
    return (
        f"avoidable: not found after {count} manoeuvres, then {ROUNDS} rounds of "
        f"{SAMPLES} counts as no"
    )
