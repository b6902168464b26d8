"""How near a rollout comes to a failure: one number, continuous, of which the failure
is a set of highest values.

A rollout without a contact has minus the least clearance, in m: over the time from the
first replan's end on (before, the noise has not acted) and over the simulated vehicles
that move, the gap of the boxes now, or at constant velocities up to LOOK s ahead, where
every second ahead counts as AHEAD m; who would touch the ego has the seconds until then.
A contact has 0 to 1, by what the competent driver in the ego's place makes of it: the
mean of the fraction of speed that it has lost by then, and of 1 / (1 + relative speed /
GENTLE). A preventable one has PREVENTED.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

from e2rl.metrics.contact import first_contact
from e2rl.metrics.geometry import velocity
from e2rl.metrics.proximity import ego_path, progress
from e2rl.metrics.score import as_doubles
from e2rl.scenes.boxes import separation
from e2rl.scenes.recording import VEHICLE
from e2rl.sim.rollouts import Rollouts
from e2rl.traffic.traffic import REPLAN_STEPS

CONTACT = 0.0  # the level of every contact, at least
PREVENTED = 2.0  # of a preventable one
TARGETS = {"contact": CONTACT, "preventable": PREVENTED}
LOOK_STEP = 0.5  # s
LOOK = tuple(LOOK_STEP * step for step in range(7))  # s
TINY = 1e-6  # m
AHEAD = 2.0  # m a second
FARTHEST = 100.0  # m: nobody moves near
MOVING = 0.5  # m/s: who has been slower all the time stands
GENTLE = 5.0  # m/s, relative speed of a contact that counts half


def levels(rollouts: Rollouts, rows: Mapping[int, dict]) -> Tensor:
    """Returns the levels [B] of rollouts, float64.

    Args:
        rollouts: B of them.
        rows: metrics of those with a contact, by their place among the B.
    """
    result = -clearance(rollouts).double().clamp(min=torch.finfo(torch.float64).tiny)
    for index, row in rows.items():
        result[index] = contact_level(row)
    return result


def contacts(rollouts: Rollouts) -> tuple[Tensor, list[float]]:
    """Returns in which rollouts [B] bool the ego touches a vehicle (`cfr`), and the km
    that it drives until then in each (`driven_km`)."""
    batch = as_doubles(rollouts)
    contact = first_contact(batch)
    path, count = ego_path(batch["states"], batch["valid"], stop=contact["stop"])
    return contact["hit"], (progress(path, count) / 1000).tolist()


def contact_level(row: dict) -> float:
    """Returns the level of a rollout with a contact, given its metrics."""
    if row["cfr_preventable"] == 1:
        return PREVENTED
    lost = min(max(row["margin"], 0.0), 1.0)
    gentle = 1 / (1 + row["relvel"] / GENTLE)
    return CONTACT + (lost + gentle) / 2


def clearance(rollouts: Rollouts) -> Tensor:
    """Returns the least clearance [B] m of the ego to simulated vehicles that move:
    what is replayed comes equally near in all rollouts."""
    begin = REPLAN_STEPS
    states = rollouts.states[:, begin:]
    moves = (rollouts.states[..., 3].abs() * rollouts.valid).amax(1) > MOVING
    counted = rollouts.valid[:, begin:] & rollouts.valid[:, begin:, :1]
    driven = (rollouts.agent_type == VEHICLE) & rollouts.simulated
    counted &= (driven & moves)[:, None]
    counted[..., 0] = False
    speed = velocity(states)
    least = torch.full_like(states[..., 0], FARTHEST)
    before = least  # the gap at the horizon before
    for ahead in LOOK:
        moved = torch.cat([states[..., :2] + ahead * speed, states[..., 2:]], -1)
        gap = separation(
            moved[:, :, :1],
            rollouts.size[:, None, :1],
            second=moved,
            second_size=rollouts.size[:, None],
        )
        # They touch between two horizons, by interpolation.
        share = before.clamp(min=0) / (before - gap).clamp(min=TINY)
        touch = (ahead - LOOK_STEP * (1 - share.clamp(max=1))).clamp(min=0)
        cost = torch.where(gap > 0, gap + AHEAD * ahead, AHEAD * touch)
        least = torch.minimum(least, cost)
        before = gap
    return least.masked_fill(~counted, FARTHEST).flatten(1).amin(1)
