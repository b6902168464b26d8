"""Feasibility bounds: who must brake, and how hard, in the part of a plan that is executed.

They are part of the simulated traffic for every method alike, and stand in each table's caption. A joint plan is driven
as it stands where it is feasible. A vehicle whose plan runs into somebody else's, or takes a curve too fast, gets a cap
on its acceleration: the braking that just avoids it. A cap never pushes a vehicle forward.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from e2rl.prior.lane_relative import ACCEL_SCALE, LaneState
from e2rl.scene.boxes import overlap
from e2rl.scene.recording import DT

FREE = 20.0  # m/s^2: the cap of a vehicle whose plan is feasible
STRIDE = 3  # steps between the times at which plans are compared
GENTLE = 0.5  # m/s^2: whoever is in somebody's way brakes at least so much


@dataclass(frozen=True)
class BoundSettings:
    """meeting, curve: which of the bounds act; look [s]: how far ahead plans are compared; gap [m]: kept to whomever a
    plan runs into, aside [m]: to either side; lateral [m/s^2]: what curves may cost; floor [m/s^2]: hardest braking;
    onset [m/s^2]: what a bound may take off the current acceleration at once, the rest follows over half a second."""

    meeting: bool = True
    curve: bool = True
    look: float = 3.0
    gap: float = 1.2
    aside: float = 0.1
    lateral: float = 5.0
    floor: float = -7.0
    onset: float = 2.0


@dataclass
class Surroundings:
    """Everybody now: agents [B, N, 4], their size [B, N, 2], present [B, N]; exempt [B, V]: vehicles that may meet the
    ego (adversaries)."""

    agents: Tensor
    size: Tensor
    present: Tensor
    exempt: Tensor


def bounded(
    settings: BoundSettings, decode: Callable[[Tensor | None], LaneState], state: LaneState, around: Surroundings
) -> LaneState:
    """The motion decode(None), fields [B, V, HORIZON], with decode(cap) for the vehicles that get a cap [B, V].

    Braking may put a vehicle in the way of the one behind, so plans are compared twice.
    """
    motion = decode(None)
    cap = torch.full_like(state.v, FREE)
    for _ in range(2):
        cap = torch.minimum(cap, acceleration_caps(settings, motion, state, around))
        motion = select(cap < FREE, decode(cap), motion)
    return motion


def acceleration_caps(settings: BoundSettings, motion: LaneState, state: LaneState, around: Surroundings) -> Tensor:
    """Highest acceleration [B, V] each vehicle may take now, FREE where its planned motion [B, V, HORIZON] from state
    [B, V] is feasible."""
    steps = torch.arange(STRIDE - 1, round(settings.look / DT), STRIDE, device=state.v.device)
    need = torch.full_like(state.v, -FREE)
    if settings.meeting:
        need = torch.maximum(need, _meeting(settings, motion, state, around, steps))
    if settings.curve:
        need = torch.maximum(need, _curve(settings, motion, state, steps))
    return (-need).clamp(min=settings.floor)


def _meeting(
    settings: BoundSettings, motion: LaneState, state: LaneState, around: Surroundings, steps: Tensor
) -> Tensor:
    """Braking [B, V] that keeps a vehicle `gap` short of whomever its plan runs into first: to that one's speed along
    its own way if it moves on (v - u)^2 / 2 room, u = 0 if it crosses or comes towards it.

    Of two that meet, the one that has the other farther ahead of itself brakes.
    """
    everybody = planned(motion, around.agents, steps)
    vehicles = state.v.shape[1]
    first, meet = _first_meeting(everybody, around, settings.aside, vehicles)
    index = first[..., None, None].expand(*first.shape, 1, 4)
    other = everybody[:, None].expand(-1, vehicles, -1, -1, -1).gather(3, index)[..., 0, :]
    mine = everybody[:, :vehicles, None].expand(-1, -1, first.shape[2], -1, -1).gather(3, index)[..., 0, :]
    gap = other[..., :2] - mine[..., :2]
    ahead, theirs = (
        (gap[..., 0] * torch.cos(pose[..., 2]) + gap[..., 1] * torch.sin(pose[..., 2])) * sign
        for pose, sign in ((mine, 1), (other, -1))
    )
    yields = meet & (ahead > theirs)
    u = (other[..., 3] * torch.cos(other[..., 2] - mine[..., 2])).clamp(min=0)
    way = (motion.s[..., steps] - state.s[..., None]).gather(-1, first)
    room = (way - settings.gap - u * DT * (steps[first] + 1)).clamp(min=0.3)
    need = (state.v[..., None] - u).clamp(min=0) ** 2 / (2 * room)
    return torch.where(yields, need.clamp(min=GENTLE), -FREE).amax(-1)


def _first_meeting(everybody: Tensor, around: Surroundings, aside: float, vehicles: int) -> tuple[Tensor, Tensor]:
    """Index of the time [B, V, N] at which i's box, wider by `aside` on both sides, first overlaps j's, and whether it
    does at all."""
    wide = around.size[:, :vehicles] + around.size.new_tensor([0.0, 2 * aside])
    meets = overlap(
        everybody[:, :vehicles, None], wide[:, :, None, None], everybody[:, None], around.size[:, None, :, None]
    )
    itself = torch.eye(vehicles, around.present.shape[1], dtype=torch.bool, device=meets.device)
    counts = around.present[:, None, :] & around.present[:, :vehicles, None] & ~itself
    counts = torch.cat([counts[..., :1] & ~around.exempt[..., None], counts[..., 1:]], -1)
    meets = meets & counts[..., None]
    return meets.int().argmax(-1), meets.any(-1)


def planned(motion: LaneState, agents: Tensor, steps: Tensor) -> Tensor:
    """Everybody's states [B, N, len(steps), 4] at steps ahead: vehicles as planned, the others at their velocity."""
    plans = motion.states()[:, :, steps]
    others = agents[:, motion.v.shape[1] :, None].expand(-1, -1, len(steps), -1)
    velocity = others[..., 3:] * torch.stack([torch.cos(others[..., 2]), torch.sin(others[..., 2])], -1)
    moved = others[..., :2] + velocity * (DT * (steps + 1))[:, None]
    return torch.cat([plans, torch.cat([moved, others[..., 2:]], -1)], 1)


def _curve(settings: BoundSettings, motion: LaneState, state: LaneState, steps: Tensor) -> Tensor:
    """Braking [B, V] that meets every place of the plan at no more than `lateral`."""
    v, kappa = motion.v[..., steps], motion.kappa[..., steps].abs()
    allowed = settings.lateral / kappa.clamp(min=1e-4)
    way = (motion.s[..., steps] - state.s[..., None]).clamp(min=1.0)
    need = ((state.v[..., None] ** 2 - allowed) / (2 * way)).clamp(min=0)
    return torch.where(v**2 > allowed, need, -FREE).amax(-1)


def under(cap: Tensor | None, x0: Tensor, state: LaneState, onset: float) -> tuple[Tensor, LaneState]:
    """x0 [B, V, SIZE] and state [B, V], their next and (by at most `onset`) present acceleration under cap [B, V]."""
    if cap is None:
        return x0, state
    present = torch.minimum(state.a, torch.maximum(cap, state.a - onset))
    first = torch.minimum(x0[..., :1], cap[..., None] / ACCEL_SCALE)
    return torch.cat([first, x0[..., 1:]], -1), replace(state, a=present)


def select(rows: Tensor, one: LaneState, other: LaneState) -> LaneState:
    """Motion [B, V, HORIZON] of `one` in rows [B, V], of `other` elsewhere."""
    return LaneState(
        *(torch.where(rows[..., None], getattr(one, f.name), getattr(other, f.name)) for f in fields(LaneState))
    )
