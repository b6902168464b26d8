"""Traffic bounds: which vehicles must brake, and how hard, in the part of a plan that
is executed.

They are part of the simulated traffic, the same for every method. A feasible joint plan
is driven as it stands. A vehicle whose plan runs into another agent, or takes a curve
too fast, gets a cap on its acceleration: the braking that just avoids it. A cap never
accelerates a vehicle.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.prior.lane_relative import ACCEL_SCALE, LaneState
from e2rl.run.fused import fused
from e2rl.run.settings import configured, setting
from e2rl.scenes.boxes import overlap
from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import constant_velocity

NO_CAP = 20.0  # m/s^2: the cap of a vehicle whose plan is feasible
STRIDE = 3  # steps between the times at which plans are compared
GAP = 1.2  # m kept to the agent that a plan runs into
LATERAL_MARGIN = 0.1  # m kept to either side
ONSET = 2.0  # m/s^2 by which a bound lowers the acceleration at once; the rest follows over 0.5 s
WAIT = 0.5  # s until a vehicle that waits decides again
MIN_BRAKING = 0.5  # m/s^2 of a vehicle that must give way
ALONGSIDE = 0.7  # cosine between the headings of vehicles that touch side by side rather than crossing


@configured("prior/default", "bounds")
@dataclass(frozen=True)
class BoundSettings:
    """What the bounds allow (conf/prior/default.yaml)."""

    meeting: bool = setting()
    curve: bool = setting()
    look: float = setting(low=0.5, high=5.0)
    lateral: float = setting(low=0.1)
    floor: float = setting(high=0)


@dataclass
class Duty:
    """How adversaries [B, V] treat the ego where their plans meet its own.

    exempt: they need not brake for it; yields: they give way wherever they meet it,
    whoever has the other ahead; patience [m/s^2]: they wait while as much braking still
    suffices 0.5 s later (0: nobody waits).
    """

    exempt: Tensor
    yields: Tensor
    patience: Tensor


@dataclass
class Obstacles:
    """Every agent at the present moment, vehicles first: agents [B, N, 4], size [B, N,
    2], present [B, N]; duty: of adversaries, None without any."""

    agents: Tensor
    size: Tensor
    present: Tensor
    duty: Duty | None = None


Rows = tuple[Tensor, ...]  # scene and vehicle [Q] int64 of Q vehicles


def bounded(
    settings: BoundSettings,
    decode: Callable[[Rows | None, Tensor | None], LaneState],
    state: LaneState,
    obstacles: Obstacles,
) -> LaneState:
    """The motion decode(None, None), fields [B, V, HORIZON], with that of decode(rows,
    cap), fields [Q, HORIZON], of the vehicles that get a cap [Q].

    Braking may put a vehicle in the way of the one behind it, so plans are compared
    twice.
    """
    motion = decode(None, None)
    cap = torch.full_like(state.v, NO_CAP)
    for _ in range(2):
        cap = torch.minimum(
            cap, acceleration_caps(settings, motion, state=state, obstacles=obstacles)
        )
        rows = (cap < NO_CAP).nonzero(as_tuple=True)
        if len(rows[0]):
            motion = motion.put(rows, decode(rows, cap[rows]))
    return motion


def acceleration_caps(
    settings: BoundSettings, motion: LaneState, state: LaneState, obstacles: Obstacles
) -> Tensor:
    """Highest acceleration [B, V] each vehicle may take now, NO_CAP where its planned
    motion [B, V, HORIZON] from state [B, V] is feasible."""
    steps = torch.arange(
        STRIDE - 1, round(settings.look / DT), STRIDE, device=state.v.device
    )
    braking = torch.full_like(state.v, -NO_CAP)
    if settings.meeting:
        braking = torch.maximum(
            braking, _meeting_braking(motion, state, obstacles=obstacles, steps=steps)
        )
    if settings.curve:
        braking = torch.maximum(
            braking, _curve_braking(settings, motion, state=state, steps=steps)
        )
    return (-braking).clamp(min=settings.floor)


def apply_cap(
    cap: Tensor | None, x0: Tensor, state: LaneState
) -> tuple[Tensor, LaneState]:
    """x0 [B, V, SIZE] and state [B, V] with the next and (by at most ONSET) the current
    acceleration under the cap [B, V]."""
    if cap is None:
        return x0, state
    current = torch.minimum(state.a, torch.maximum(cap, state.a - ONSET))
    first = torch.minimum(x0[..., :1], cap[..., None] / ACCEL_SCALE)
    return torch.cat([first, x0[..., 1:]], -1), replace(state, a=current)


def _meeting_braking(
    motion: LaneState, state: LaneState, obstacles: Obstacles, steps: Tensor
) -> Tensor:
    """`meeting_braking` [B, V] of planned motions, towards the agent that each runs
    into first."""
    vehicles = state.v.shape[1]
    duty = obstacles.duty
    others = constant_velocity(obstacles.agents[:, vehicles:], DT * (steps + 1))
    own = motion.states()[:, :, steps]
    driven = motion.s[..., steps] - state.s[..., None]
    sizes = obstacles.size[:, :vehicles], obstacles.size
    here = obstacles.present[:, :vehicles]
    plans = Plans(
        own,
        torch.cat([own, others], 1),
        driven,
        *sizes,
        here,
        obstacles.present,
        steps + 1,
    )
    length = (obstacles.size[:, :vehicles, 0] + obstacles.size[:, :1, 0]) / 2
    if duty is None:  # nobody is behind the ego by any duty
        none = torch.zeros_like(here)
        duty = Duty(none, none, patience=torch.zeros_like(length))
        length = torch.full_like(length, -torch.inf)
    return braking_for_meetings(plans, state.v, length, duty)


class Plans(NamedTuple):
    """Vehicles and everybody after steps [K]: own [B, V, K, 4] and everybody [B, N, K,
    4], their states; driven [B, V, K] m; own_size [B, V, 2], size [B, N, 2]; whether
    vehicles are here [B, V] and agents present [B, N]."""

    own: Tensor
    everybody: Tensor
    driven: Tensor
    own_size: Tensor
    size: Tensor
    here: Tensor
    present: Tensor
    steps: Tensor


PLANS = (
    "B V K 4",
    "B N K 4",
    "B V K",
    "B V 2",
    "B N 2",
    "B V:bool",
    "B N:bool",
    "K:int64",
)


@fused(PLANS, "B V", "B V", ("B V:bool", "B V:bool", "B V"))
def braking_for_meetings(
    plans: Plans, speed: Tensor, length: Tensor, duty: Duty
) -> Tensor:
    """`meeting_braking` [B, V] for the `first_meeting`."""
    return meeting_braking(first_meeting(plans), speed, length=length, duty=duty)


class Meeting(NamedTuple):
    """Vehicles and each of N agents, the ego first, when they first meet: own, other
    [B, V, N, 4] their states, after the vehicle has driven `driven` [B, V, N] m in
    `steps` [B, V, N] steps; happens [B, V, N]: they do meet."""

    own: Tensor
    other: Tensor
    driven: Tensor
    steps: Tensor
    happens: Tensor


def first_meeting(plans: Plans) -> Meeting:
    """Where boxes of vehicles, wider by LATERAL_MARGIN on both sides, first overlap
    those of everybody."""
    own, everybody, driven, own_size, size, here, present, steps = plans
    vehicles = own.shape[1]
    wide = torch.stack([own_size[..., 0], own_size[..., 1] + 2 * LATERAL_MARGIN], -1)
    meets = overlap(
        own[:, :, None],
        wide[:, :, None, None],
        second=everybody[:, None],
        second_size=size[:, None, :, None],
    )
    other = torch.arange(present.shape[1], device=present.device)
    itself = other == torch.arange(vehicles, device=own.device)[:, None]
    counts = present[:, None, :] & here[..., None] & ~itself
    meets = meets & counts[..., None]
    count = steps.shape[0]
    left = torch.where(
        meets, torch.arange(count, 0, -1, dtype=own.dtype, device=own.device), 0.0
    ).amax(-1)
    first = torch.where(left > 0, count - left, 0.0).long()
    index = first[..., None, None].expand(*first.shape, 1, 4)
    they = (
        everybody[:, None].expand(-1, vehicles, -1, -1, -1).gather(3, index)[..., 0, :]
    )
    mine = (
        own[:, :, None]
        .expand(-1, -1, first.shape[2], -1, -1)
        .gather(3, index)[..., 0, :]
    )
    way = (
        driven[:, :, None]
        .expand(-1, -1, first.shape[2], -1)
        .gather(3, first[..., None])[..., 0]
    )
    return Meeting(mine, they, driven=way, steps=steps[first], happens=left > 0)


def meeting_braking(
    meeting: Meeting, speed: Tensor, length: Tensor, duty: Duty
) -> Tensor:
    """Braking [B, V] m/s^2 that keeps vehicles GAP short of what they meet, -NO_CAP
    where none has to brake.

    It is (v - u)^2 / (2 room), u the other's speed along the vehicle's heading, 0 if it
    crosses or comes towards it. Of two that meet, the one that has the other farther
    ahead of itself brakes. Adversaries that come into the ego's side fall behind it.

    speed: v [B, V] m/s; length [B, V] m: between the centres if the vehicle were just
    behind the ego, -inf: nobody falls behind it.
    """
    own, other, driven, steps, happens = meeting
    dx, dy = (other[..., :2] - own[..., :2]).unbind(-1)
    ahead = dx * torch.cos(own[..., 2]) + dy * torch.sin(
        own[..., 2]
    )  # m, the other along the vehicle's heading
    ahead_of_other = -(dx * torch.cos(other[..., 2]) + dy * torch.sin(other[..., 2]))
    yields = happens & (ahead > ahead_of_other)
    along = torch.cos(other[..., 2] - own[..., 2])
    u = (other[..., 3] * along).clamp(min=0)
    room = (driven - GAP - u * DT * steps).clamp(min=0.3)
    closing = (speed[..., None] - u).clamp(min=0)
    braking = closing**2 / (2 * room)
    to_ego = _towards_ego(
        duty,
        happens[..., 0],
        yields=yields[..., 0],
        room=room[..., 0],
        closing=closing[..., 0],
    )
    yields = torch.cat([to_ego[..., None], yields[..., 1:]], -1)
    back = 2 * (length + GAP - ahead[..., 0]).clamp(min=0) / (DT * steps[..., 0]) ** 2
    back = back * (
        along[..., 0] > ALONGSIDE
    )  # who comes into the ego's side is behind it when they would touch
    braking = torch.cat(
        [torch.maximum(braking[..., 0], back)[..., None], braking[..., 1:]], -1
    )
    return torch.where(yields, braking.clamp(min=MIN_BRAKING), -NO_CAP).amax(-1)


def _towards_ego(
    duty: Duty, meets: Tensor, yields: Tensor, room: Tensor, closing: Tensor
) -> Tensor:
    """Bool [B, V]: vehicles brake for the ego now.

    meets: plans meet; yields: the ordinary rule; room [m] until there, closing [m/s].
    """
    later = room - closing * WAIT
    waits = (closing**2 < 2 * later * duty.patience) & (later > 0)
    return meets & ~duty.exempt & (yields | duty.yields) & ~waits


def _curve_braking(
    settings: BoundSettings, motion: LaneState, state: LaneState, steps: Tensor
) -> Tensor:
    """Braking [B, V] by which v^2 kappa is at most `lateral` at every point of the
    plan."""
    v = motion.v[..., steps]
    kappa = motion.kappa[..., steps].abs()
    allowed = settings.lateral / kappa.clamp(min=1e-4)
    driven = (motion.s[..., steps] - state.s[..., None]).clamp(min=1.0)
    braking = ((state.v[..., None] ** 2 - allowed) / (2 * driven)).clamp(min=0)
    return torch.where(v**2 > allowed, braking, -NO_CAP).amax(-1)
