"""In what other frame, unit or time an ego's plans are, where they begin elsewhere than
a vehicle can be."""

from collections.abc import Callable
from math import pi

import torch
from torch import Tensor

from e2rl.scenes.boxes import to_frame
from e2rl.scenes.recording import DT
from e2rl.sim import dynamics

# A plan that begins farther off than one of these may be of another frame.
AHEAD = 0.5  # m
BESIDE = 2.0  # m
TURN = 0.35  # rad
FASTER = 4.0  # m/s
EXPLAINED = 0.8  # of these, that a misreading leaves at most, with rounding at 4,000 km
SECOND = 10  # steps of a plan
ELSEWHERE = 10.0  # m between two origins, at least
COARSE = 5  # steps of 0.1 s of a plan at 2 Hz
Reading = Callable[[Tensor, Tensor], Tensor]


def misfit(state: Tensor, plan: Tensor) -> Tensor:
    """How far [...] plans [..., H, 4] begin from where egos at states [..., 4] are due
    in a step, and their speeds from their displacements; 1 is the limit."""
    due = due_state(state)
    first = plan[..., 0, :]
    offset = to_frame(first[..., :2], due).abs()
    turn = dynamics.wrap(first[..., 2] - due[..., 2]).abs()
    distance = (plan[..., SECOND, :2] - first[..., :2]).norm(dim=-1)
    mean_speed = plan[..., : SECOND + 1, 3].mean(-1)
    parts = (
        offset[..., 0] / AHEAD,
        offset[..., 1] / BESIDE,
        turn / TURN,
        (first[..., 3] - due[..., 3]).abs() / FASTER,
        (mean_speed - distance / (SECOND * DT)).abs() / FASTER,
    )
    return torch.stack(parts, -1).amax(-1)


def due_state(state: Tensor) -> Tensor:
    """States [..., 4] a step after others, at the same velocity."""
    times = torch.full_like(state[..., :1], DT)
    return dynamics.constant_velocity(state, times)[..., 0, :]


def from_ego(state: Tensor, plan: Tensor) -> Tensor:
    """Plans of the ego's frame in that of the scene."""
    cos = state[..., None, 2].cos()
    sin = state[..., None, 2].sin()
    x = cos * plan[..., 0] - sin * plan[..., 1] + state[..., None, 0]
    y = sin * plan[..., 0] + cos * plan[..., 1] + state[..., None, 1]
    return torch.stack([x, y, plan[..., 2] + state[..., None, 2], plan[..., 3]], -1)


def from_elsewhere(state: Tensor, plan: Tensor) -> Tensor:
    """Plans [P, B, H, 4] without the offset that all P of a scene share; as they are
    where it is less than ELSEWHERE."""
    offset = (plan[..., 0, :2] - due_state(state)[..., :2]).mean(0, keepdim=True)
    offset = offset * (offset.norm(dim=-1, keepdim=True) > ELSEWHERE)
    return torch.cat([plan[..., :2] - offset[..., None, :], plan[..., 2:]], -1)


def from_now(state: Tensor, plan: Tensor) -> Tensor:
    """Plans without their first state."""
    return torch.cat([plan[..., 1:, :], plan[..., -1:, :]], -2)


def from_coarse(state: Tensor, plan: Tensor) -> Tensor:
    """Plans of 2 Hz at their first step of 0.1 s."""
    change = plan - state[..., None, :]
    turn = dynamics.wrap(change[..., 2:3])
    change = torch.cat([change[..., :2], turn, change[..., 3:]], -1)
    return state[..., None, :] + change / COARSE


def scaled(*factors: float) -> Reading:
    """A reading by factors of x, y, heading and speed."""
    return lambda state, plan: plan * plan.new_tensor(factors)


def from_north(state: Tensor, plan: Tensor) -> Tensor:
    """Plans of headings clockwise from the y axis."""
    heading = pi / 2 - plan[..., 2:3]
    return torch.cat([plan[..., :2], heading, plan[..., 3:]], -1)


MISREADINGS: dict[str, tuple[Reading, str]] = {
    "in the frame of the ego": (
        from_ego,
        "turn and shift them into the frame of the scene, that of world.states",
    ),
    "of headings in degrees": (scaled(1, 1, pi / 180, 1), "give radians"),
    "mirrored: y and headings have the other sign": (
        scaled(1, -1, -1, 1),
        "count y to the left of x, headings counterclockwise",
    ),
    "of headings clockwise from north": (
        from_north,
        "count headings from the x axis, counterclockwise",
    ),
    "of speeds in km/h": (scaled(1, 1, 1, 1 / 3.6), "give m/s"),
    "in coordinates of another origin": (
        from_elsewhere,
        "shift them into the frame of the scene, that of world.states",
    ),
    "of states from now on": (from_now, "begin 0.1 s from now: leave out the first"),
    "of states 0.5 s apart": (from_coarse, "give 50 states, 0.1 s apart"),
}
"""How plans may be meant that begin elsewhere; how to read them, and to mend them."""


def misreading(state: Tensor, plan: Tensor) -> str | None:
    """Returns which of MISREADINGS explains where plans [P, B, H, 4] of egos at states
    [P, B, 4] begin; None where they begin at the egos, or none explains it."""
    if bool((misfit(state, plan) <= 1).all()):
        return None
    rest = {
        name: float(misfit(state, reading(state, plan)).amax())
        for name, (reading, _) in MISREADINGS.items()
    }
    best = min(rest, key=lambda name: rest[name])
    return best if rest[best] <= EXPLAINED else None
