"""By how much trajectories of the ego fail as evasions: clearance to everybody, and the road."""

import torch
from tensordict import TensorClass, TensorDictBase
from torch import Tensor

from e2rl.scene.boxes import separation
from e2rl.scene.recording import DT
from e2rl.scene.route import project
from e2rl.sim.drivable import off_road
from e2rl.sim.mission import mission_of

PAIRS = 8_000_000  # boxes compared at once: bounds the memory
AWAY = 1e6  # m, position of absent agents


class EvasionScene(TensorClass):
    """Scenes [B] in the T steps after a given one, in which the motion of all agents but the ego is fixed.

    `inside` tells which steps lie within the episode. `others` are AWAY where absent. `field` and `origin` are those of
    `sim.drivable.off_road`. `s` is the ego's arc length at the start on its mission, `end` the one at which the map
    ends (inf: it does not).
    """

    start: Tensor  # [B, 4], the ego's
    ego_size: Tensor  # [B, 2]
    inside: Tensor  # [B, T] bool
    others: Tensor  # [B, T, N, 4]
    other_size: Tensor  # [B, N, 2]
    field: Tensor  # [B, G, G]
    origin: Tensor  # [B, 2]
    routes: Tensor  # [B, R, P, 2], the ego's candidates
    mission: Tensor  # [B, P, 2]
    s: Tensor  # [B]
    end: Tensor  # [B]

    @staticmethod
    def after(moment: Tensor, scene: TensorDictBase, states: Tensor, valid: Tensor) -> "EvasionScene":
        """After step moment [B] of scenes [B] with agents at states [B, T+1, N, 4], valid [B, T+1, N], ego first."""
        horizon = states.shape[1] - 1
        row = torch.arange(len(states), device=states.device)
        step = moment[:, None] + torch.arange(1, horizon + 1, device=states.device)
        inside, step = step <= horizon, step.clamp(max=horizon)
        present = valid[row[:, None], step, 1:] & inside[..., None]
        ever = present.any(1).any(0)  # columns without any agent cost as much as others
        start, mission = states[row, moment, 0], mission_of(scene)
        others = states[row[:, None], step, 1:].masked_fill(~present[..., None], AWAY)[:, :, ever]
        agents = {"ego_size": scene["size"][:, 0], "others": others, "other_size": scene["size"][:, 1:][:, ever]}
        road = {"field": scene["field"], "origin": scene["field_origin"], "routes": scene["route_points"][:, 0]}
        s = project(start[:, None, :2], mission.points)[0][:, 0]
        road |= {"mission": mission.points, "s": s, "end": mission.end}
        return EvasionScene(start=start, inside=inside, **agents, **road, batch_size=[len(states)])


def violations(states: Tensor, scene: EvasionScene, clearance: float, road_margin: float) -> Tensor:
    """Metres [B, C, T] by which egos at states [B, C, T, 4] miss `clearance` to others and `road_margin` to the border.

    0 at a step that keeps both, and after the episode. As in DrivingEnv, contact counts with everybody at every step,
    the road from the first time on it, and nothing once the map has ended.
    """
    missed = clearance_violation(states, scene, clearance) + road_violation(states, scene, road_margin)
    missed = missed * scene.inside[:, None]
    return missed.masked_fill(past_end(states, missed > 0, scene)[..., None], 0.0)


def clearance_violation(states: Tensor, scene: EvasionScene, clearance: float) -> Tensor:
    """Metres [B, C, T] of missing clearance, summed over the agents nearer than it; exact box separation."""
    chunk = max(1, PAIRS // max(1, states.shape[0] * states.shape[2] * scene.others.shape[2]))
    return torch.cat([_clearance_violation(part, scene, clearance) for part in states.split(chunk, 1)], 1)


def _clearance_violation(states: Tensor, scene: EvasionScene, clearance: float) -> Tensor:
    others, size, other_size = scene.others, scene.ego_size, scene.other_size
    reach = (size.norm(dim=-1)[:, None] + other_size.norm(dim=-1)) / 2 + clearance
    gap_x = states[..., None, 0] - others[:, None, ..., 0]
    gap_y = states[..., None, 1] - others[:, None, ..., 1]
    near = gap_x.square_().add_(gap_y.square_()) < reach.square()[:, None, None]
    row, trial, step, other = near.nonzero(as_tuple=True)
    apart = separation(states[row, trial, step], size[row], others[row, step, other], other_size[row, other])
    index = (row * states.shape[1] + trial) * states.shape[2] + step
    missed = states.new_zeros(states.shape[:-1]).view(-1)
    return missed.index_add(0, index, (clearance - apart).clamp(min=0)).view(states.shape[:-1])


def road_violation(states: Tensor, scene: EvasionScene, margin: float) -> Tensor:
    """Metres [B, C, T] beyond a line `margin` m inside the drivable border, from the first time within it."""
    first = off_road(scene.start[:, None, :2], scene.field, scene.origin) + margin
    beyond = off_road(states[..., :2], scene.field, scene.origin) + margin
    before = torch.cat([first[..., None].expand_as(beyond[..., :1]), beyond[..., :-1]], -1)
    return beyond.clamp(min=0) * (before.cummin(-1).values <= 0)


def past_end(states: Tensor, wrong: Tensor, scene: EvasionScene) -> Tensor:
    """Bool [B, C]: the ego is past the map's end before the first step at which it is wrong [B, C, T].

    The step at which it passes the end still counts, so its position a step before the first wrong one decides.
    """
    first = wrong.int().argmax(-1)
    last = (first - 1).clamp(min=0)
    at = states.gather(2, last[..., None, None].expand(*last.shape, 1, 4))[:, :, 0, :2]
    speed = torch.cat([scene.start[:, None, None, 3].expand_as(states[:, :, :1, 3]), states[..., 3]], -1)
    driven = ((speed[..., 1:] + speed[..., :-1]) / 2 * DT).cumsum(-1).gather(2, last[..., None])[..., 0]
    s = project(at, scene.mission, scene.s[:, None] + driven)[0]
    return (s >= scene.end[:, None]) & (first > 0)
