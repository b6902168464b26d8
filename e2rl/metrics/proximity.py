"""How close the ego comes, how hard it brakes and how far it gets, up to its first contact (design.md section 5)."""

import torch
from torch import Tensor

from e2rl.metrics.contact import up_to
from e2rl.metrics.geometry import velocity
from e2rl.scene.boxes import distance
from e2rl.sim.dynamics import wrap

SMOOTHING = 0.5  # s, moving average of the ego's speed before its derivative


def smallest_gap(states: Tensor, valid: Tensor, size: Tensor, stop: Tensor) -> Tensor:
    """`min_dtc` [B] [m]: the smallest box distance to any other valid agent at steps 1..stop; NaN where there is none.

    states [B, T+1, N, 4] with the ego in row 0, valid [B, T+1, N], size [B, N, 2].
    """
    seen = valid & valid[..., :1] & up_to(stop, states.shape[1])[..., None]
    seen[..., 0] = False
    gap = distance(states[:, :, :1], size[:, None, :1], states, size[:, None])
    smallest = gap.masked_fill(~seen, torch.inf).flatten(1).amin(-1)
    return smallest.masked_fill(smallest.isinf(), torch.nan)


def closest_approach_cost(states: Tensor) -> Tensor:
    """exp(-t*^2 / 2 - d*^2 / 2) [..., N] at the ego's and each agent's closest approach at constant velocity.

    t* = relu(-(p . v) / (|v|^2 + 1e-6)), d* = |p + v t*| for the relative position p and velocity v of states
    [..., N, 4]; a pair at the same velocity keeps its distance, hence costs nearly nothing (section 8.5, corrected).
    """
    moving = velocity(states)
    offset, closing = states[..., :2] - states[..., :1, :2], moving - moving[..., :1, :]
    time = (-(offset * closing).sum(-1) / (closing.square().sum(-1) + 1e-6)).clamp(min=0)
    miss = offset + closing * time[..., None]
    return (-(time.square() + miss.square().sum(-1)) / 2).exp()


def mean_worst_cost(cost: Tensor, counted: Tensor) -> Tensor:
    """`ttc_c` [B]: mean over steps of the largest counted cost [B, T+1, N] over the steps that have one, else NaN."""
    known = counted.any(-1)
    worst = (cost * counted).amax(-1)
    return (worst * known).sum(-1) / known.sum(-1)  # 0 / 0 is NaN


def ego_path(states: Tensor, valid: Tensor, stop: Tensor) -> tuple[Tensor, Tensor]:
    """The ego's valid states at steps 0..stop moved to the front [B, T+1, 4], and their number [B]."""
    steps = torch.arange(states.shape[1], device=states.device)
    counted = valid[..., 0] & (steps <= stop[:, None])
    order = (~counted).byte().argsort(dim=-1, stable=True)
    return states[:, :, 0].gather(1, order[..., None].expand(-1, -1, 4)), counted.sum(-1)


def mean_acceleration(path: Tensor, count: Tensor, dt: float) -> Tensor:
    """`macc` [B] [m/s2]: mean |central difference| of the speed's moving average over full windows of 0.5 s.

    path [B, T+1, 4] of `count` [B] states; NaN where it is shorter than a window and two steps.
    """
    window = max(round(SMOOTHING / dt), 1)
    if path.shape[1] < window + 2:
        return torch.full_like(path[:, 0, 0], torch.nan)
    smooth = path[..., 3].unfold(1, window, 1).mean(-1)
    change = (smooth[:, 2:] - smooth[:, :-2]).abs() / (2 * dt)
    number = (count - window - 1).clamp(min=0)
    counted = torch.arange(change.shape[1], device=path.device) < number[:, None]
    return (change * counted).sum(-1) / number


def progress(path: Tensor, count: Tensor) -> Tensor:
    """[B] [m]: the ego's way along its own heading, each step along the mean of its two headings (backwards < 0)."""
    step = path[:, 1:] - path[:, :-1]
    heading = path[:, :-1, 2] + wrap(step[..., 2]) / 2
    way = step[..., 0] * heading.cos() + step[..., 1] * heading.sin()
    counted = torch.arange(way.shape[1], device=path.device) < (count - 1)[:, None]
    return (way * counted).sum(-1)
