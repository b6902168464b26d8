"""Scenes in which an ego may drive otherwise while all others move as they did, and by
how much its trajectories fail as evasions: clearance to others, and the road."""

import torch
from tensordict import TensorClass, TensorDictBase
from torch import Tensor

from e2rl.scenes.boxes import separation
from e2rl.scenes.drivable_area import off_road
from e2rl.scenes.recording import DT
from e2rl.scenes.route import BEHIND, project, project_track
from e2rl.sim.dynamics import midpoints
from e2rl.sim.mission import mission_of

PAIRS = 1_000_000  # boxes compared at once: bounds the memory
AWAY = 1e6  # m, position of absent agents


class EvasionScene(TensorClass):
    """Scenes [B] in the T steps after a given one, in which the motion of all agents
    but the ego is fixed."""

    start: Tensor  # [B, 4], the ego's
    ego_size: Tensor  # [B, 2]
    inside: Tensor  # [B, T] bool: within the episode
    others: Tensor  # [B, T, N, 4], AWAY where absent
    other_size: Tensor  # [B, N, 2]
    field: Tensor  # [B, G, G], of `scenes.drivable_area.off_road`
    origin: Tensor  # [B, 2]
    routes: Tensor  # [B, R, P, 2], the ego's candidates
    mission: Tensor  # [B, P, 2]
    s: Tensor  # [B] m, arc length of the ego on its mission at the start
    end: Tensor  # [B] m, the one at which the map ends (inf: it does not)

    @staticmethod
    def after(
        moment: Tensor,
        scene: TensorDictBase,
        *,
        states: Tensor,
        valid: Tensor,
    ) -> "EvasionScene":
        """The scenes after a step.

        Args:
            moment: [B] int64, the step.
            scene: [B].
            states: [B, T+1, N, 4], of all agents, the ego first.
            valid: [B, T+1, N] bool.
        """
        horizon = states.shape[1] - 1
        row = torch.arange(len(states))
        step = moment[:, None] + torch.arange(1, horizon + 1)
        inside = step <= horizon
        step = step.clamp(max=horizon)
        present = valid[row[:, None], step, 1:] & inside[..., None]
        others = states[row[:, None], step, 1:]
        others = others.masked_fill(~present[..., None], AWAY)
        # Columns without any agent would cost as much as others.
        ever = present.any(1).any(0)
        mission = mission_of(scene)
        s, _, _ = project_track(
            states[:, :, 0, :2],
            mission.points,
            known=valid[:, :, 0],
            start=BEHIND,
        )
        return EvasionScene(
            start=states[row, moment, 0],
            ego_size=scene["size"][:, 0],
            inside=inside,
            others=others[:, :, ever],
            other_size=scene["size"][:, 1:][:, ever],
            field=scene["field"],
            origin=scene["field_origin"],
            routes=scene["route_points"][:, 0],
            mission=mission.points,
            s=s[row, moment],
            end=mission.end,
            batch_size=[len(states)],
        )


def violations(
    states: Tensor,
    scene: EvasionScene,
    *,
    clearance: float,
    road_margin: float,
) -> Tensor:
    """Metres [B, C, T] by which egos fail as evasions: what is missing of the clearance
    to everybody at each step, and what lies beyond the road from the first time on it;
    nothing once the map has ended.

    Args:
        states: [B, C, T, 4], of C trajectories at steps 1..T.
        scene: the B scenes.
        clearance: m.
        road_margin: m inside the drivable border.
    """
    missing = clearance_violation(
        states,
        scene,
        clearance=clearance,
    )
    beyond = road_violation(
        states,
        scene,
        margin=road_margin,
    )
    violation = (missing + beyond) * scene.inside[:, None]
    ended = past_end(
        states,
        violation > 0,
        scene=scene,
    )
    return violation.masked_fill(ended[..., None], 0.0)


def clearance_violation(
    states: Tensor,
    scene: EvasionScene,
    clearance: float,
) -> Tensor:
    """Metres [B, C, T] of missing clearance, summed over the agents nearer than it;
    exact box separation."""
    others = scene.others
    size = scene.ego_size
    other_size = scene.other_size
    reach = (size.norm(dim=-1)[:, None] + other_size.norm(dim=-1)) / 2 + clearance
    chunk = max(1, PAIRS // max(1, states.shape[0] * states.shape[2] * others.shape[2]))
    parts = []
    for part in states.split(chunk, 1):
        # In place: these tensors of all pairs bound the memory.
        square = (part[..., None, 0] - others[:, None, ..., 0]).square_()
        square.add_((part[..., None, 1] - others[:, None, ..., 1]).square_())
        near = square < reach.square()[:, None, None]
        row, trial, step, other = near.nonzero(as_tuple=True)
        gap = separation(
            part[row, trial, step],
            size[row],
            second=others[row, step, other],
            second_size=other_size[row, other],
        )
        missing = part.new_zeros(part.shape[:-1])
        index = (row * part.shape[1] + trial) * part.shape[2] + step
        missing.view(-1).index_add_(0, index, (clearance - gap).clamp(min=0))
        parts.append(missing)
    return torch.cat(parts, 1)


def road_violation(states: Tensor, scene: EvasionScene, margin: float) -> Tensor:
    """Metres [B, C, T] beyond a line `margin` m inside the drivable border, from the
    first time within it."""
    start = off_road(
        scene.start[:, None, :2],
        scene.field,
        origin=scene.origin,
    )
    beyond = (
        off_road(
            states[..., :2],
            scene.field,
            origin=scene.origin,
        )
        + margin
    )
    start = (start + margin)[..., None].expand_as(beyond[..., :1])
    before = torch.cat([start, beyond[..., :-1]], -1)
    return beyond.clamp(min=0) * (before.cummin(-1).values <= 0)


def past_end(states: Tensor, wrong: Tensor, scene: EvasionScene) -> Tensor:
    """Bool [B, C]: the ego is past the map's end before the first step at which it is
    wrong [B, C, T].

    The step at which it passes the end still counts, so its position a step before the
    first wrong one decides.
    """
    first = wrong.int().argmax(-1)
    last = (first - 1).clamp(min=0)[..., None]
    position = states[..., :2].gather(2, last[..., None].expand(-1, -1, -1, 2))
    start_speed = scene.start[:, None, None, 3].expand_as(states[:, :, :1, 3])
    speed = torch.cat([start_speed, states[..., 3]], -1)
    driven = (midpoints(speed) * DT).cumsum(-1)
    hint = scene.s[:, None] + driven.gather(2, last)[..., 0]
    s, _, _ = project(
        position[:, :, 0],
        scene.mission,
        hint=hint,
    )
    return (s >= scene.end[:, None]) & (first > 0)
