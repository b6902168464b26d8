"""The other agents in the ego's frame, on the last axis, and which contacts are of the
ego's own making."""

from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.run.fused import product, some
from e2rl.scenes.recording import DT
from e2rl.scenes.route import first_least
from e2rl.sim.passing import is_fast, time_inside
from e2rl.sim.static import StaticScene
from e2rl.sim.world import Agents, Tracks

# m: gap of boxes that have passed through each other, at the moment of their contact.
TOUCHING = -1e-6
# m/s of relative velocity below which nobody passes through the ego in a step: it takes
# half a pedestrian.
SLOWEST = 2.0
SLACK = 1.5  # of the distance that agents are expected to have come in a step
STANDING = 0.1  # m/s
# Steps: who keeps two seconds of distance (UK Highway Code, rule 126) stops behind what
# stood for so long.
STOOD = round(2.0 / DT)
LOOKED = 4  # steps between those that are looked at


class Neighbours(NamedTuple):
    """M other agents of B egos.

    position [B, 2, M]: m forward and left of the ego; direction [B, 2, M]: cosine and
    sine of the heading relative to the ego's; gap [B, M]: box separation [m]
    (`separation` of two boxes); agents: what they are in the world.
    """

    position: Tensor
    direction: Tensor
    gap: Tensor
    agents: Agents


def rotation_into(ego: Tensor) -> Tensor:
    """Rotation [B, 2, 2] that turns world vectors into the frame of the ego states [B,
    4]."""
    cos = ego[:, 2].cos()
    sin = ego[:, 2].sin()
    return torch.stack([cos, sin, -sin, cos], -1).view(-1, 2, 2)


def neighbours_of(
    ego: Tensor,
    rotation: Tensor,
    *,
    static: StaticScene,
    agents: Agents,
) -> Neighbours:
    """Neighbours of egos.

    Args:
        ego: [B, 4] states.
        rotation: [B, 2, 2], `rotation_into(ego)`.
        static: sizes of all.
        agents: M others of each ego.
    """
    x, y, heading, _ = agents.states.unbind(-1)
    ahead = [x - ego[:, :1], heading.cos()]
    poses = torch.stack([*ahead, y - ego[:, 1:2], heading.sin()], 1)
    batch = ego.shape[0]
    turned = product(rotation, poses.view(batch, 2, -1)).view(batch, 2, 2, -1)
    position, direction = turned.unbind(2)
    half = static.size[..., None] / 2
    gap = separation_in_frame(
        position,
        direction,
        own=half,
        half_size=static.half_size,
    )
    return Neighbours(position, direction, gap, agents)


def separation_in_frame(
    position: Tensor,
    direction: Tensor,
    *,
    own: Tensor,
    half_size: Tensor,
) -> Tensor:
    """Box separation [B, M] m of a box at the origin from others, by the separating
    axis theorem, as in `separation`.

    Args:
        position: [B, 2, M] m, of the others in the box's frame.
        direction: [B, 2, M], cosine and sine of their headings there.
        own: [B, 2, 1] m, half length and width of the box.
        half_size: [B, 2, M] m, of the others.
    """
    size = direction.abs()
    # Rows: extent of a box's length and width along the other's axes.
    size = torch.stack([size, size.flip(1)], 1)
    from_own = position.abs() - own - (size * half_size[:, None]).sum(2)
    ahead = (position * direction).sum(1)
    across = position[:, 1] * direction[:, 0] - position[:, 0] * direction[:, 1]
    place = torch.stack([ahead, across], 1).abs()
    from_other = place - half_size - (size * own[:, None]).sum(2)
    return torch.maximum(from_own, from_other).amax(1)


def relative_velocity(ego: Tensor, speed: Tensor, direction: Tensor) -> Tensor:
    """Velocity [B, 2, K] m/s of others in the frame of the egos [B, 4], relative to
    them; speed [B, 1, K] m/s, direction [B, 2, K]."""
    of_ego = torch.nn.functional.pad(ego[:, 3:, None], (0, 0, 0, 1))
    return speed * direction - of_ego


def passed(
    near: Neighbours,
    *,
    ego: Tensor,
    ego_before: Tensor,
    tracks: Tracks,
    static: StaticScene,
    before: Tensor,
) -> Neighbours:
    """The neighbours, where they have passed through the ego since the last step as
    they were on contact with it.

    Args:
        near: of the egos.
        ego: [B, 4] states.
        ego_before: [B, 4], at the last step.
        tracks: of all agents, the ego first.
        static: sizes of all.
        before: [B], the last step.
    """
    states, present, *_ = near.agents
    velocity = relative_velocity(ego, states[:, None, :, 3], near.direction)
    # forty times as fast as `norm` over two rows
    pace = velocity.square().sum(1).sqrt()
    fast = present & (near.gap >= 0) & (pace > SLOWEST) & (near.gap < SLACK * DT * pace)
    rows: Tensor | slice = slice(None)
    if not torch.compiler.is_compiling() and not fast.is_cuda:
        rows = fast.any(1).nonzero()[:, 0]
        if not len(rows):
            return near
    agent = torch.arange(1, fast.shape[1] + 1, device=fast.device)
    at = static.row[rows], before[rows, None], agent
    moved = states[rows, :, :2] - tracks.states[at][..., :2]
    x, y = (moved - (ego - ego_before)[rows, None, :2]).unbind(-1)
    cos = ego[:, 2:3].cos()[rows]
    sin = ego[:, 2:3].sin()[rows]
    change = torch.stack([cos * x + sin * y, cos * y - sin * x])
    position = near.position[rows].transpose(0, 1)
    half = (static.size[rows] / 2).T[..., None]
    other = static.half_size[rows].transpose(0, 1)
    begin, end = time_inside(
        position - change,
        change,
        direction=near.direction[rows].transpose(0, 1),
        own=half,
        other=other,
    )
    passes = is_fast(change, half, other) & tracks.valid[at] & (begin > 0)
    passes = passes & (begin < end) & fast[rows]
    touch = torch.where(passes, position - (1 - begin) * change, position)
    touching = near._replace(position=near.position.clone(), gap=near.gap.clone())
    touching.position[rows] = touch.transpose(0, 1)
    touching.gap[rows] = torch.where(passes, TOUCHING, near.gap[rows])
    return touching


def standing(
    tracks: Tracks,
    *,
    row: Tensor,
    step: Tensor,
    agent: Tensor,
    long: Tensor,
) -> tuple[Tensor, Tensor]:
    """Whether agents move at a step, and whether they have stood up to it; each [B]
    bool. Every LOOKED-th step is looked at.

    Args:
        tracks: of all agents.
        row: [B, 1], 0 .. B - 1.
        step: [B].
        agent: [B], whom to look at.
        long: [B] bool: to have stood is to do so for STOOD steps, or as long as it is
            known, else at the step.
    """
    back = torch.arange(0, STOOD + 1, LOOKED, device=step.device) * long[:, None]
    at = row, (step[:, None] - back).clamp(min=0), agent[:, None]
    present = tracks.valid[at]
    moves = (tracks.states[..., 3][at].abs() > STANDING) & present
    return moves[:, 0], present[:, 0] & ~some(moves)


def own_fault(
    speed: Tensor,
    near: Neighbours,
    *,
    hit: Tensor,
    static: StaticScene,
    tracks: Tracks,
    before: Tensor,
) -> Tensor:
    """Bool [B]: the ego overlaps an agent while it moves, and either that agent has
    stood (a vehicle: for STOOD steps; another: at all) or it moves and lies across the
    ego's front edge.

    By the step alone, these are the rules of metrics/verdicts.py but for cut-ins, for
    who moved sideways into whom, and for an ego that stands across a lane. Of an ego
    that reverses the front is its rear. The edge is that of the least overlap along the
    ego's axes, which near its corners may differ from the one that touched first.

    Args:
        speed: [B] m/s, of the ego before the contact.
        near: of the egos.
        hit: [B, M], the neighbours that each ego overlaps; the one with the deepest
            overlap is judged.
        static: sizes and kinds of all.
        tracks: of all agents, the ego first.
        before: [B], the step before the contact.
    """
    if hit.shape[1] == 0:
        return hit.any(1)
    partner = first_least(near.gap.masked_fill(~hit, torch.inf))
    pick = partner[:, None, None].expand(-1, 2, 1)
    position, turn, half = (
        value.gather(2, pick)[..., 0]
        for value in (near.position, near.direction, static.half_size)
    )
    turn = turn.abs()
    extent = torch.stack([(turn * half).sum(1), (turn.flip(1) * half).sum(1)], 1)
    ahead, across = (position.abs() - static.size / 2 - extent).unbind(1)
    front = ((position[:, 0] > 0) == (speed >= -STANDING)) & (ahead > across)
    moves, stood = standing(
        tracks,
        row=static.row,
        step=before,
        agent=partner + 1,
        long=static.vehicle.gather(1, partner[:, None])[:, 0],
    )
    return some(hit) & (speed.abs() > STANDING) & (stood | (front & moves))
