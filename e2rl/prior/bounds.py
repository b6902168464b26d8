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
from e2rl.run.config import configured, setting
from e2rl.run.fused import fused
from e2rl.scenes.boxes import overlap
from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import constant_velocity

NO_CAP = 20.0  # m/s^2: the cap of a vehicle whose plan is feasible
STRIDE = 3  # steps between the times at which plans are compared
GAP = 1.2  # m kept to the agent that a plan runs into
LEAST_ROOM = 0.3  # m: braking is never asked for in less
LATERAL_MARGIN = 0.1  # m kept to either side
# m/s^2 by which a bound lowers the acceleration at once; the rest follows over 0.5 s.
ONSET = 2.0
WAIT = 0.5  # s until a vehicle that waits decides again
MIN_BRAKING = 0.5  # m/s^2 of a vehicle that must give way
# Cosine between the headings of vehicles that touch side by side rather than crossing.
ALONGSIDE = 0.7

Rows = tuple[Tensor, ...]  # scene and vehicle [Q] int64 of Q vehicles


@configured("prior/default", "bounds")
@dataclass(frozen=True)
class BoundSettings:
    """What the bounds allow (conf/prior/default.yaml)."""

    meeting: bool = setting()
    curve: bool = setting()
    look: float = setting(
        low=0.5,
        high=5.0,
    )
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


def bounded(
    settings: BoundSettings,
    motion: LaneState,
    *,
    capped: Callable[[Rows, Tensor], LaneState],
    state: LaneState,
    obstacles: Obstacles,
) -> LaneState:
    """The planned motion with that of the vehicles that get a cap.

    Braking may put a vehicle in the way of the one behind it, so plans are compared
    twice.

    Args:
        settings: what is allowed.
        motion: fields [B, V, HORIZON], as planned.
        capped: from rows and caps [Q] to motion, fields [Q, HORIZON].
        state: fields [B, V], where the motion begins.
        obstacles: everybody now.
    """
    cap = torch.full_like(state.v, NO_CAP)
    for _ in range(2):
        caps = acceleration_caps(
            settings,
            motion,
            state=state,
            obstacles=obstacles,
        )
        cap = torch.minimum(cap, caps)
        rows = (cap < NO_CAP).nonzero(as_tuple=True)
        if len(rows[0]):
            motion = motion.put(rows, capped(rows, cap[rows]))
    return motion


def acceleration_caps(
    settings: BoundSettings,
    motion: LaneState,
    *,
    state: LaneState,
    obstacles: Obstacles,
) -> Tensor:
    """Highest acceleration [B, V] m/s^2 each vehicle may take, NO_CAP where its plan is
    feasible.

    Args:
        settings: what is allowed.
        motion: fields [B, V, HORIZON], as planned.
        state: fields [B, V], where the motion begins.
        obstacles: everybody now.
    """
    last = round(settings.look / DT)
    steps = torch.arange(STRIDE - 1, last, STRIDE, device=state.v.device)
    braking = torch.full_like(state.v, -NO_CAP)
    if settings.meeting:
        meeting = _meeting_braking(
            motion,
            state,
            obstacles=obstacles,
            steps=steps,
        )
        braking = torch.maximum(braking, meeting)
    if settings.curve:
        curve = _curve_braking(
            motion,
            state,
            lateral=settings.lateral,
            steps=steps,
        )
        braking = torch.maximum(braking, curve)
    return (-braking).clamp(min=settings.floor)


def apply_cap(cap: Tensor, x0: Tensor, state: LaneState) -> tuple[Tensor, LaneState]:
    """x0 [B, V, SIZE] and state [B, V] with the next and (by at most ONSET) the current
    acceleration under the cap [B, V]."""
    current = torch.minimum(state.a, torch.maximum(cap, state.a - ONSET))
    first = torch.minimum(x0[..., :1], cap[..., None] / ACCEL_SCALE)
    return torch.cat([first, x0[..., 1:]], -1), replace(state, a=current)


class Plans(NamedTuple):
    """What vehicles [B, V] and all agents [B, N] do up to steps [K].

    planned [B, V, K, 4] and everybody [B, N, K, 4]: states; driven [B, V, K] m; vehicle_size
    [B, V, 2], size [B, N, 2]; here [B, V], present [B, N]: whether they are there.
    """

    planned: Tensor
    everybody: Tensor
    driven: Tensor
    vehicle_size: Tensor
    size: Tensor
    here: Tensor
    present: Tensor
    steps: Tensor


def _meeting_braking(
    motion: LaneState,
    state: LaneState,
    *,
    obstacles: Obstacles,
    steps: Tensor,
) -> Tensor:
    """`meeting_braking` [B, V] of planned motion, towards the agent that each vehicle
    runs into first."""
    size = obstacles.size
    present = obstacles.present
    vehicles = state.v.shape[1]
    others = constant_velocity(obstacles.agents[:, vehicles:], DT * (steps + 1))
    planned = motion.states()[:, :, steps]
    plans = Plans(
        planned=planned,
        everybody=torch.cat([planned, others], 1),
        driven=motion.s[..., steps] - state.s[..., None],
        vehicle_size=size[:, :vehicles],
        size=size,
        here=present[:, :vehicles],
        present=present,
        steps=steps + 1,
    )
    length = (size[:, :vehicles, 0] + size[:, :1, 0]) / 2
    duty = obstacles.duty
    if duty is None:  # nobody is behind the ego by any duty
        nobody = torch.zeros_like(plans.here)
        duty = Duty(nobody, nobody, patience=torch.zeros_like(length))
        length = torch.full_like(length, -torch.inf)
    return braking_for_meetings(plans, state.v, length, duty)


@fused(
    (
        "B V K 4",
        "B N K 4",
        "B V K",
        "B V 2",
        "B N 2",
        "B V:bool",
        "B N:bool",
        "K:int64",
    ),
    "B V",
    "B V",
    ("B V:bool", "B V:bool", "B V"),
)
def braking_for_meetings(
    plans: Plans,
    speed: Tensor,
    length: Tensor,
    duty: Duty,
) -> Tensor:
    """`meeting_braking` [B, V] for the `first_meeting`.

    Args:
        plans: of vehicles and everybody.
        speed, length, duty: of `meeting_braking`.
    """
    return meeting_braking(
        first_meeting(plans),
        speed,
        length=length,
        duty=duty,
    )


class Meeting(NamedTuple):
    """Vehicles and each of N agents, the ego first, when they first meet: vehicle,
    other [B, V, N, 4] their states, after the vehicle has driven `driven` [B, V, N] m in
    `steps` [B, V, N] steps; happens [B, V, N]: they do meet."""

    vehicle: Tensor
    other: Tensor
    driven: Tensor
    steps: Tensor
    happens: Tensor


def first_meeting(plans: Plans) -> Meeting:
    """Where boxes of vehicles, wider by LATERAL_MARGIN on both sides, first overlap
    those of everybody."""
    planned = plans.planned
    length, width = plans.vehicle_size.unbind(-1)
    wide = torch.stack([length, width + 2 * LATERAL_MARGIN], -1)
    meets = overlap(
        planned[:, :, None],
        wide[:, :, None, None],
        second=plans.everybody[:, None],
        second_size=plans.size[:, None, :, None],
    )  # [B, V, N, K]
    number = torch.arange(plans.present.shape[1], device=planned.device)
    itself = number == torch.arange(planned.shape[1], device=planned.device)[:, None]
    counts = plans.present[:, None, :] & plans.here[..., None] & ~itself
    count = plans.steps.shape[0]
    rest = torch.arange(
        count,
        0,
        -1,
        dtype=planned.dtype,
        device=planned.device,
    )
    left = torch.where(meets & counts[..., None], rest, 0.0).amax(-1)
    first = torch.where(left > 0, count - left, 0.0).long()  # [B, V, N]
    vehicles, agents = first.shape[1:]
    index = first[..., None, None].expand(*first.shape, 1, 4)
    everybody = plans.everybody[:, None].expand(-1, vehicles, -1, -1, -1)
    driven = plans.driven[:, :, None].expand(-1, -1, agents, -1)
    planned = planned[:, :, None].expand(-1, -1, agents, -1, -1)
    return Meeting(
        vehicle=planned.gather(3, index)[..., 0, :],
        other=everybody.gather(3, index)[..., 0, :],
        driven=driven.gather(3, first[..., None])[..., 0],
        steps=plans.steps[first],
        happens=left > 0,
    )


def meeting_braking(
    meeting: Meeting,
    speed: Tensor,
    *,
    length: Tensor,
    duty: Duty,
) -> Tensor:
    """Braking [B, V] m/s^2 that keeps vehicles GAP short of what they meet, -NO_CAP
    where none has to brake.

    It is (v - u)^2 / (2 room), u the other's speed along the vehicle's heading, 0 if it
    crosses or comes towards it. Of two that meet, the one that has the other farther
    ahead of itself brakes. Adversaries that come into the ego's side fall behind it.

    Args:
        meeting: of vehicles and everybody.
        speed: [B, V] m/s, v.
        length: [B, V] m between the centres if the vehicle were just behind the ego,
            -inf: nobody falls behind it.
        duty: how adversaries treat the ego.
    """
    vehicle, other, driven, steps, happens = meeting
    dx, dy = (other[..., :2] - vehicle[..., :2]).unbind(-1)
    ahead = dx * torch.cos(vehicle[..., 2]) + dy * torch.sin(vehicle[..., 2])
    ahead_of_other = -(dx * torch.cos(other[..., 2]) + dy * torch.sin(other[..., 2]))
    yields = happens & (ahead > ahead_of_other)
    along = torch.cos(other[..., 2] - vehicle[..., 2])
    u = (other[..., 3] * along).clamp(min=0)
    room = (driven - GAP - u * DT * steps).clamp(min=LEAST_ROOM)
    closing = (speed[..., None] - u).clamp(min=0)
    braking = closing**2 / (2 * room)

    later = room[..., 0] - closing[..., 0] * WAIT
    waits = (closing[..., 0] ** 2 < 2 * later * duty.patience) & (later > 0)
    to_ego = happens[..., 0] & ~duty.exempt & (yields[..., 0] | duty.yields) & ~waits
    yields = torch.cat([to_ego[..., None], yields[..., 1:]], -1)

    back = 2 * (length + GAP - ahead[..., 0]).clamp(min=0) / (DT * steps[..., 0]) ** 2
    back = back * (along[..., 0] > ALONGSIDE)  # who comes into the ego's side
    to_ego_braking = torch.maximum(braking[..., 0], back)
    braking = torch.cat([to_ego_braking[..., None], braking[..., 1:]], -1)
    return torch.where(yields, braking.clamp(min=MIN_BRAKING), -NO_CAP).amax(-1)


def _curve_braking(
    motion: LaneState,
    state: LaneState,
    *,
    lateral: float,
    steps: Tensor,
) -> Tensor:
    """Braking [B, V] by which v^2 kappa is at most `lateral` m/s^2 at every point of
    the plan."""
    allowed = lateral / motion.kappa[..., steps].abs().clamp(min=1e-4)
    driven = (motion.s[..., steps] - state.s[..., None]).clamp(min=1.0)
    braking = ((state.v[..., None] ** 2 - allowed) / (2 * driven)).clamp(min=0)
    too_fast = motion.v[..., steps] ** 2 > allowed
    return torch.where(too_fast, braking, -NO_CAP).amax(-1)
