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
from e2rl.sim.world import Agents


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
    ego: Tensor, rotation: Tensor, size: Tensor, half_size: Tensor, agents: Agents
) -> Neighbours:
    """Neighbours of egos [B, 4] among M agents.

    rotation: `rotation_into(ego)`; size [B, 2]: length and width of the egos; half_size
    [B, 2, M]: of the agents.
    """
    x, y, heading, _ = agents.states.unbind(-1)
    poses = torch.stack(
        [x - ego[:, :1], heading.cos(), y - ego[:, 1:2], heading.sin()], 1
    )
    seen = product(rotation, poses.view(ego.shape[0], 2, -1)).view(
        ego.shape[0], 2, 2, -1
    )
    position, direction = seen.unbind(2)
    gap = separation_in_frame(
        position, direction, own=size[..., None] / 2, half_size=half_size
    )
    return Neighbours(position, direction, gap=gap, agents=agents)


def separation_in_frame(
    position: Tensor, direction: Tensor, own: Tensor, half_size: Tensor
) -> Tensor:
    """Box separation [B, M] of a box at the origin from boxes at `position`,
    `direction` [B, 2, M] in its frame.

    own [B, 2, 1], half_size [B, 2, M]: half lengths and widths. The separating axis
    theorem, as in `separation`.
    """
    size = direction.abs()
    size = torch.stack(
        [size, size.flip(1)], 1
    )  # rows: extent of a box's length and width along the other's axes
    from_own = position.abs() - own - (size * half_size[:, None]).sum(2)
    ahead = (position * direction).sum(1)
    across = position[:, 1] * direction[:, 0] - position[:, 0] * direction[:, 1]
    from_other = (
        torch.stack([ahead, across], 1).abs() - half_size - (size * own[:, None]).sum(2)
    )
    return torch.maximum(from_own, from_other).amax(1)


TOUCHING = (
    -1e-6
)  # m: gap of boxes that have passed through each other, at the moment of their contact


# m/s of relative velocity below which nobody passes through the ego in a step: it takes
# half a pedestrian
SLOWEST = 2.0
SLACK = 1.5  # of the distance that agents are expected to have come in a step


def passed(
    near: Neighbours,
    ego: tuple[Tensor, Tensor],
    tracks: tuple[Tensor, Tensor],
    row: Tensor,
    step: Tensor,
    size: Tensor,
    half_size: Tensor,
) -> Neighbours:
    """The neighbours, where they have passed through the ego since the last step as
    they were on contact with it.

    Args:
        near: of the egos now.
        ego: [B, 4] at the last step and now.
        tracks: of all agents, the ego first; row [B, 1]: 0 .. B - 1; step [B]: the last
            one.
        size: [B, 2] m of the egos; half_size: [B, 2, M] m of the agents.
    """
    states, there, *_ = near.agents
    motion = states[:, None, :, 3] * near.direction - torch.nn.functional.pad(
        ego[1][:, 3:, None], (0, 0, 0, 1)
    )
    pace = motion.norm(dim=1)
    asked = there & (near.gap >= 0) & (pace > SLOWEST) & (near.gap < SLACK * DT * pace)
    if (
        not torch.compiler.is_compiling()
        and not asked.is_cuda
        and not bool(asked.any())
    ):
        return near
    if torch.compiler.is_compiling():
        scene = row.expand_as(asked)
        agent = torch.arange(asked.shape[1], device=row.device).expand_as(asked)
    else:
        scene, agent = asked.nonzero(as_tuple=True)
    then = step[scene]
    moved = (
        states[scene, agent, :2]
        - tracks[0][scene, then, agent + 1, :2]
        - (ego[1] - ego[0])[scene, :2]
    )
    cos = ego[1][:, 2].cos()[scene]
    sin = ego[1][:, 2].sin()[scene]
    x, y = moved.unbind(-1)
    change = torch.stack([cos * x + sin * y, cos * y - sin * x])
    position, direction, half = (
        torch.stack([value[:, 0][scene, agent], value[:, 1][scene, agent]])
        for value in (near.position, near.direction, half_size)
    )
    own = torch.stack([size[:, 0][scene], size[:, 1][scene]]) / 2
    begin, end = time_inside(
        position - change, change, direction=direction, own=own, other=half
    )
    passes = (
        is_fast(change, own, other=half)
        & tracks[1][scene, then, agent + 1]
        & (begin > 0)
        & (begin < end)
    )
    passes = passes & asked[scene, agent]
    touch = torch.where(passes, position - (1 - begin) * change, position)
    gap = torch.where(passes, TOUCHING, near.gap[scene, agent])
    if torch.compiler.is_compiling():
        return near._replace(position=touch.transpose(0, 1), gap=gap)
    place = (
        near.position.transpose(1, 2).index_put((scene, agent), touch.T).transpose(1, 2)
    )
    return near._replace(position=place, gap=near.gap.index_put((scene, agent), gap))


STANDING = 0.1  # m/s
STOOD = round(
    2.0 / DT
)  # steps; who keeps two seconds of distance (UK Highway Code, rule 126) stops behind what stood
LOOKED = 4  # steps between those that are looked at


def standing(
    tracks: tuple[Tensor, Tensor],
    row: Tensor,
    step: Tensor,
    agent: Tensor,
    long: Tensor,
) -> tuple[Tensor, Tensor]:
    """Whether agents [B] of tracks (states [B, T+1, N, 4], presence [B, T+1, N]) move
    at step [B], and whether they have stood up to it: for STOOD steps, or as long as
    they are known, if `long` [B], else at it; each [B] bool.

    row [B, 1]: 0 .. B - 1. Every LOOKED-th step is looked at.
    """
    back = torch.arange(0, STOOD + 1, LOOKED, device=step.device) * long[:, None]
    at = row, (step[:, None] - back).clamp(min=0), agent[:, None]
    known = tracks[1][at]
    moves = (tracks[0][..., 3][at].abs() > STANDING) & known
    return moves[:, 0], known[:, 0] & ~some(moves)


def own_fault(
    speed: Tensor,
    near: Neighbours,
    hit: Tensor,
    static: StaticScene,
    tracks: tuple[Tensor, Tensor],
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
        hit: [B, M], the neighbours that each ego overlaps; the one with the deepest
            overlap is judged.
        tracks: of all agents, the ego first; what they did up to the step `before` [B],
            the one before the contact.
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
    vehicle = static.vehicle.gather(1, partner[:, None])[:, 0]
    moves, stood = standing(
        tracks, static.row, step=before, agent=partner + 1, long=vehicle
    )
    return some(hit) & (speed.abs() > STANDING) & (stood | (front & moves))
