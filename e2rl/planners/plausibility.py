"""Whether what an ego answers is a plan or an action that a vehicle can drive."""

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from e2rl.planners.ego import PLAN_STEPS, Ego
from e2rl.planners.ego_errors import NotFinite, WrongPlan
from e2rl.planners.misreadings import MISREADINGS, misreading
from e2rl.scenes.boxes import to_frame
from e2rl.scenes.recording import DT
from e2rl.sim import dynamics

FASTEST = 50.0  # m/s: a faster plan, by its speeds or from pose to pose, is nonsense
LARGEST = 100.0  # m/s^2, rad/s: so is a larger action
# A plan that begins farther away is in another frame, or of another time; some begin on
# a lane beside.
MAX_AHEAD = 2.0  # m
MAX_BESIDE = 5.0  # m
MAX_TURN = 1.0  # rad
CREEP = 0.5  # m/s below which a heading may be anything
JUMPS = f"a plan that is not finite, or jumps (above {FASTEST:g} m/s)"
STRAYS = (
    f"a plan that begins more than {MAX_AHEAD:g} m ahead of, behind, {MAX_BESIDE:g} m "
    f"beside or {MAX_TURN:g} rad from where the ego will be 0.1 s from now: its states "
    "are of the scene's frame, the first of them 0.1 s ahead"
)
BACKWARDS = (
    "a plan that goes backwards: egos do not reverse, and who reverses at the start "
    "comes to a halt"
)
WILD = f"an action that is not finite, or above {LARGEST:g}"


def plan_faults(state: Tensor, plan: Tensor) -> Iterator[tuple[Tensor, str]]:
    """Scenes [B] bool whose plan [B, PLAN_STEPS, 4] of an ego at state [B, 4] no
    vehicle can drive, and why, the gravest reason first."""
    jumps = ~drivable(state, plan)
    yield jumps, JUMPS + _cause(state[jumps], plan[jumps])
    astray = strays(state, plan[:, 0])
    yield astray & reverses(state, plan), BACKWARDS
    yield astray, STRAYS + _cause(state[astray], plan[astray])


def _cause(state: Tensor, plan: Tensor) -> str:
    """Why plans may begin elsewhere, for a message; "" where nothing explains it."""
    name = misreading(state[None], plan[None]) if len(state) else None
    return f"; plans seem {name}: {MISREADINGS[name][1]}" if name else ""


def action_faults(
    state: Tensor,
    plan: Tensor,
    action: Tensor,
) -> Iterator[tuple[Tensor, str]]:
    """The same of actions [B, 2], by which egos at state [B, 4] drive a plan. One may
    stop at once, or change its speed as much: its acceleration is bounded."""
    wild = (action.abs() > LARGEST).any(1)
    yield wild & reverses(state, plan), BACKWARDS
    planned = (plan[:, 0, 3] - state[:, 3]) / DT
    beyond = torch.stack([action[:, 0] - planned, action[:, 1]], -1).abs() > LARGEST
    yield wild & beyond.any(1), WILD


def drivable(
    state: Tensor,
    plan: Tensor,
    length: Tensor | int = PLAN_STEPS,
) -> Tensor:
    """Bool [B]: the first `length` [B] states of a plan [B, H, 4] that begins at state
    [B, 4] are finite and no faster than FASTEST, in their speeds and from pose to
    pose."""
    path = torch.cat([state[:, None, :2], plan[..., :2]], 1)
    slow = path.diff(dim=1).norm(dim=-1) <= FASTEST * DT
    fine = slow & (plan[..., 3].abs() <= FASTEST) & plan.isfinite().all(-1)
    step = torch.arange(plan.shape[1], device=plan.device)
    end = torch.as_tensor(length, device=plan.device)[..., None]
    return (fine | (step >= end)).all(1)


def strays(state: Tensor, first: Tensor) -> Tensor:
    """Bool [B]: the first planned state [B, 4] is elsewhere than the ego at state [B,
    4] will be in a step."""
    due = dynamics.constant_velocity(state, torch.full_like(state[:, :1], DT))[:, 0]
    moves = torch.minimum(state[:, 3].abs(), first[:, 3].abs()) > CREEP
    turned = dynamics.wrap(first[:, 2] - due[:, 2]).abs() > MAX_TURN
    distance = to_frame(first[:, :2], due).abs()
    far = (distance[:, 0] > MAX_AHEAD) | (distance[:, 1] > MAX_BESIDE)
    return far | (turned & moves)


def reverses(state: Tensor, plan: Tensor) -> Tensor:
    """Bool [B]: a plan [B, H, 4] of an ego at state [B, 4], which does not reverse,
    begins against its heading."""
    step = to_frame(plan[:, 1, :2], plan[:, 0])
    against = step[:, 0] < -step[:, 1].abs()
    return (state[:, 3] >= 0) & (against | (plan[:, 0, 3] < 0))


def finite(values: Tensor, name: str) -> Tensor:
    """The plans or actions [B, ...] of an ego; raises NotFinite where one is not
    finite."""
    if not bool(values.isfinite().all()):
        raise NotFinite(f"the ego's {name} is NaN or infinite")
    return values


def checked_answer(
    answer: Any,
    ego: Ego,
    *,
    method: str,
    shape: tuple[int, ...],
    begins: bool,
) -> Tensor:
    """Returns what a method of an ego returned.

    Args:
        answer: what it returned.
        ego: whose method it is, for the message.
        method: `plan` or `act`.
        shape: that the answer should have.
        begins: it is the first answer of rollouts.

    Raises:
        WrongPlan: it is no tensor of floats of this shape.
        NotFinite: it is not finite.
    """
    floats = isinstance(answer, Tensor) and answer.is_floating_point()
    if not floats or tuple(answer.shape) != shape:
        raise WrongPlan(
            f"{type(ego).__name__}.{method}: returns {_described(answer)}, expected a "
            f"tensor of floats {list(shape)} (docs/guide/planner.md)",
            begins,
        )
    return finite(answer, "plan" if method == "plan" else "action")


def _described(answer: Any) -> str:
    if isinstance(answer, Tensor):
        return f"{answer.dtype} {list(answer.shape)}"
    name = type(answer).__name__
    if hasattr(answer, "shape") and hasattr(answer, "dtype"):
        size = f"{name} of {answer.dtype} {list(answer.shape)}"
        return f"{size}, of which torch.as_tensor makes a tensor"
    return name
