"""Who is ahead of whom along the routes.

Most pairs of a vehicle and another agent are far apart, so that only those near each other's way are projected: routes
are cut into stretches with a bounding box each, and agents are compared with the vertices of stretches they are near.
"""

import torch
from torch import Tensor

from e2rl.scene.route import SPACING, onto_segments
from e2rl.sim.car_following import desired_gap

SIDE_GAP = 0.3  # m of free space to either side that still makes somebody a leader
FREE = 200.0  # m: the gap of a vehicle with nobody ahead
STRETCH = 10  # vertices


class Ahead:
    """The agents on or beside the routes of B scenes' vehicles, one entry for each such pair.

    s [B, V]: the vehicles' arc lengths; width, length [B, V]; points [B, V, P, 2]; agents [B, M, 4]: states to look at,
    of which rows 0..V-1 are the vehicles themselves; size [B, M, 2]; present [B, M]; reach [B, V]: how far beside the
    route somebody may be, over the half widths.
    """

    def __init__(
        self,
        s: Tensor,
        width: Tensor,
        length: Tensor,
        points: Tensor,
        agents: Tensor,
        size: Tensor,
        present: Tensor,
        reach: Tensor,
    ):
        self.shape, self.own_speed = (*s.shape, agents.shape[1]), agents[:, : s.shape[1], 3]
        room = (width / 2 + SIDE_GAP + reach)[..., None] + size.norm(dim=-1)[:, None] / 2
        self.scene, self.vehicle, self.other, vertex = _near(points, s, agents[..., :2], room, present)
        mine, them = (self.scene, self.vehicle), (self.scene, self.other)
        agent, box = agents[them], size[them]
        at, self.offset, heading = onto_segments(
            agent[:, :2], vertex, points.shape[2] - 2, lambda index: points[*mine, index]
        )
        turn = agent[:, 2] - heading
        cos, sin = torch.cos(turn), torch.sin(turn)
        self.side = width[mine] / 2 + (box[:, 0] * sin.abs() + box[:, 1] * cos.abs()) / 2 + SIDE_GAP
        self.ahead = at - s[mine]
        self.gap = self.ahead - length[mine] / 2 - (box[:, 0] * cos.abs() + box[:, 1] * sin.abs()) / 2
        self.speed = agent[:, 3] * cos

    def nearest(self, d: Tensor | None = None, blind: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """The nearest agent ahead of each vehicle [B, V]: gap [m], its speed along the route, index. Where there is
        none the gap is FREE and the speed the vehicle's own.

        d [B, V]: the vehicles' offsets, at most `reach`: whoever is in the band between a vehicle's own offset and its
        route is ahead too (it changes lanes through it); blind [B, V]: vehicles that do not see agent 0.
        """
        aside = self.offset
        if d is not None:
            own = d[self.scene, self.vehicle]
            aside = aside - torch.minimum(torch.maximum(aside, own.clamp(max=0)), own.clamp(min=0))
        leads = (aside.abs() < self.side) & (self.ahead > 0)
        if blind is not None:
            leads = leads & ~(blind[self.scene, self.vehicle] & (self.other == 0))
        full = lambda fill, value: self.gap.new_full(self.shape, fill).index_put(  # noqa: E731
            (self.scene, self.vehicle, self.other), value
        )
        gap, index = full(FREE, torch.where(leads, self.gap, FREE)).min(-1)
        speed = full(0.0, self.speed).gather(-1, index[..., None])[..., 0]
        speed = torch.where(gap < FREE, speed, self.own_speed)
        return gap.clamp(max=FREE), speed, index


def _near(points: Tensor, s: Tensor, places: Tensor, room: Tensor, present: Tensor) -> tuple[Tensor, ...]:
    """Pairs (scene, vehicle, agent, index of the nearest vertex; each [Q]) of present agents places [B, M, 2] within
    room [B, V, M] m of the vehicle's route and not behind it. Beyond its last vertex a route goes on straight."""
    vehicles, count = points.shape[1:3]
    both = present[:, :vehicles, None] & present[:, None]
    itself = torch.eye(vehicles, places.shape[1], dtype=torch.bool, device=s.device)
    b, v, m = (both & ~itself).nonzero(as_tuple=True)
    starts = torch.arange(0, count - 1, STRETCH, device=s.device)
    corners = (starts[:, None] + torch.arange(STRETCH + 1, device=s.device)).clamp(max=count - 1)
    stretches = points[:, :, corners]  # [B, V, C, STRETCH + 1, 2]
    low, high = stretches.amin(3), stretches.amax(3)
    place, far = places[b, m], room[b, v, m] + SPACING / 2
    beyond = torch.maximum(low[b, v] - place[:, None], place[:, None] - high[b, v]).clamp(min=0)  # [Q, C, 2]
    near = beyond.square().sum(-1) < far.square()[:, None]
    tip = points[:, :, -1] - points[:, :, -2]
    tip = tip / tip.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    past, unit = place - points[b, v, -1], tip[b, v]
    straight = ((past * unit).sum(-1) > 0) & ((past[:, 1] * unit[:, 0] - past[:, 0] * unit[:, 1]).abs() < far)
    near[:, -1] |= straight
    ahead = (near & (SPACING * corners[:, -1] >= s[b, v][:, None] - SPACING)).any(-1) | straight
    b, v, m, place, near = b[ahead], v[ahead], m[ahead], place[ahead], near[ahead]
    pair, stretch = near.nonzero(as_tuple=True)
    squared = (stretches[b[pair], v[pair], stretch] - place[pair][:, None]).square().sum(-1)
    nearest, within = squared.min(-1)
    table = nearest.new_full(near.shape, torch.inf).index_put((pair, stretch), nearest)
    vertex = torch.zeros_like(table, dtype=torch.long).index_put((pair, stretch), corners[stretch, 0] + within)
    return b, v, m, vertex.gather(1, table.argmin(1, keepdim=True))[:, 0].clamp(max=count - 1)


def leaders(
    s: Tensor,
    width: Tensor,
    length: Tensor,
    points: Tensor,
    agents: Tensor,
    size: Tensor,
    present: Tensor,
    d: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """`Ahead.nearest` where only one question is asked; arguments as there."""
    reach = torch.zeros_like(s) if d is None else d.abs()
    return Ahead(s, width, length, points, agents, size, present, reach).nearest(d)


def idm_acceleration(
    v: Tensor, target: Tensor, gap: Tensor, leader: Tensor, headway: float, jam: float, accel: float, brake: float
) -> Tensor:
    """Intelligent Driver Model: v, target [m/s], gap [m] to a leader driving `leader` m/s -> acceleration [m/s^2].

    The original free-road term; planners drive by the improved one of ego.idm.
    """
    wanted = desired_gap(v, leader, headway, jam, accel, brake)
    return accel * (1 - (v / target.clamp(min=1.0)) ** 4 - (wanted / gap.clamp(min=0.1)) ** 2)
