"""How far driven trajectories of the ego miss what an evasion must keep: no contact with anyone, and the road."""

from dataclasses import dataclass, fields

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.scene.boxes import separation
from e2rl.scene.recording import DT
from e2rl.scene.route import project
from e2rl.sim.drivable import off_road
from e2rl.sim.mission import mission_of

PAIRS = 8_000_000  # boxes compared at once: bounds the memory
AWAY = 1e6  # m, where agents are put that are not there


@dataclass(frozen=True)
class Surroundings:
    """What B egos meet in the T steps after a moment: start [B, 4] and size [B, 2] of the ego; counts [B, T]: the step
    is within the episode; others [B, T, N, 4] (AWAY where absent) and their sizes [B, N, 2]; the drivable field
    [B, G, G] and its origin [B, 2]; the mission's points [B, P, 2], its place at the start [B] and the arc length [B]
    at which the map ends (inf: it does not)."""

    start: Tensor
    size: Tensor
    counts: Tensor
    others: Tensor
    other_size: Tensor
    field: Tensor
    origin: Tensor
    mission: Tensor
    begin: Tensor
    end: Tensor

    @staticmethod
    def of(scene: TensorDictBase, states: Tensor, valid: Tensor, moment: Tensor) -> "Surroundings":
        """After step moment [B] of scenes [B] in which agents moved along states [B, T+1, N, 4], valid [B, T+1, N]; row
        0 is the ego's."""
        horizon = states.shape[1] - 1
        row = torch.arange(len(states), device=states.device)
        step = moment[:, None] + torch.arange(1, horizon + 1, device=states.device)
        counts, step = step <= horizon, step.clamp(max=horizon)
        present = valid[row[:, None], step, 1:] & counts[..., None]
        ever = present.any(1).any(0)  # columns that nobody ever fills cost as much as others
        others = states[row[:, None], step, 1:].masked_fill(~present[..., None], AWAY)[:, :, ever]
        start, mission = states[row, moment, 0], mission_of(scene)
        begin = project(start[:, None, :2], mission.points)[0][:, 0]
        return Surroundings(
            start,
            scene["size"][:, 0],
            counts,
            others,
            scene["size"][:, 1:][:, ever],
            scene["field"],
            scene["field_origin"],
            mission.points,
            begin,
            mission.end,
        )

    def rows(self, index: Tensor) -> "Surroundings":
        """Those of some egos."""
        return Surroundings(*(getattr(self, field.name)[index] for field in fields(self)))


def violations(states: Tensor, around: Surroundings, clearance: float, shoulder: float) -> Tensor:
    """Metres [B, C, T] by which trajectories [B, C, T, 4] of the egos miss `clearance` [m] to others, and the road less
    a `shoulder` [m] inside its border.

    0 at a step that keeps both, and after the episode. As in DrivingEnv contact counts at every step, with everybody,
    the road from the first time on it, and nothing once the map has ended.
    """
    missed = (contact_depth(states, around, clearance) + beyond_road(states, around, shoulder)) * around.counts[:, None]
    return missed.masked_fill(gone_before(states, missed, around)[..., None], 0.0)


def contact_depth(states: Tensor, around: Surroundings, clearance: float) -> Tensor:
    """Metres [B, C, T] of missing clearance, summed over the others nearer than it; exact box separation."""
    chunk = max(1, PAIRS // max(1, states.shape[0] * states.shape[2] * around.others.shape[2]))
    return torch.cat([_contact_depth(part, around, clearance) for part in states.split(chunk, 1)], 1)


def _contact_depth(states: Tensor, around: Surroundings, clearance: float) -> Tensor:
    reach = (around.size.norm(dim=-1)[:, None] + around.other_size.norm(dim=-1)) / 2 + clearance
    gap_x = states[..., None, 0] - around.others[:, None, ..., 0]
    gap_y = states[..., None, 1] - around.others[:, None, ..., 1]
    near = gap_x.square_().add_(gap_y.square_()) < reach.square()[:, None, None]
    row, trial, step, other = near.nonzero(as_tuple=True)
    apart = separation(
        states[row, trial, step], around.size[row], around.others[row, step, other], around.other_size[row, other]
    )
    place = (row * states.shape[1] + trial) * states.shape[2] + step
    depth = states.new_zeros(states.shape[:-1]).view(-1)
    return depth.index_add(0, place, (clearance - apart).clamp(min=0)).view(states.shape[:-1])


def beyond_road(states: Tensor, around: Surroundings, shoulder: float) -> Tensor:
    """Metres [B, C, T] beyond a line `shoulder` m inside the drivable border, from the first time within it."""
    first = off_road(around.start[:, None, :2], around.field, around.origin) + shoulder
    beyond = off_road(states[..., :2], around.field, around.origin) + shoulder
    before = torch.cat([first[..., None].expand_as(beyond[..., :1]), beyond[..., :-1]], -1)
    return beyond.clamp(min=0) * (before.cummin(-1).values <= 0)


def gone_before(states: Tensor, missed: Tensor, around: Surroundings) -> Tensor:
    """Bool [B, C]: the ego has left by the map's end before the first step that misses [B, C, T] something.

    The step at which it passes the end counts still, so the place a step before the first miss decides.
    """
    wrong = missed > 0
    last = (wrong.int().argmax(-1) - 1).clamp(min=0)
    at = states.gather(2, last[..., None, None].expand(*last.shape, 1, 4))[:, :, 0, :2]
    speed = torch.cat([around.start[:, None, None, 3].expand_as(states[:, :, :1, 3]), states[..., 3]], -1)
    driven = ((speed[..., 1:] + speed[..., :-1]) / 2 * DT).cumsum(-1).gather(2, last[..., None])[..., 0]
    place = project(at, around.mission, around.begin[:, None] + driven)[0]
    return (place >= around.end[:, None]) & (wrong.int().argmax(-1) > 0)
