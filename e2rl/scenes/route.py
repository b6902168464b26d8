"""Geometry of routes: polylines with a vertex every SPACING metres, whose arc length is
SPACING x vertex index.

Routes are smoothed, so chords are a little shorter than SPACING; projection and
interpolation share the index scale.
"""

from collections.abc import (
    Callable,
    Sequence,
)

import torch
from torch import Tensor

from e2rl.run.fused import (
    fused,
    is_on,
)
from e2rl.scenes.boxes import angle_of

SPACING = 2.0  # m of arc length between vertices
WINDOW = 20.0  # m on either side of an expected arc length
BEHIND = 20.0  # m of a route, at most, that lie behind the vehicle that it was made for


def _take(route: Tensor, index: Tensor) -> Tensor:
    """Vertices route [..., P, 2] at index [..., K] -> [..., K, 2], leading dims
    broadcast."""
    if route.shape[:-2] != index.shape[:-1]:
        # of tensors: broadcast_shapes takes ten times as long
        like, _ = torch.broadcast_tensors(route[..., :1, 0], index[..., :1])
        lead = like.shape[:-1]
        route = route.expand(lead + route.shape[-2:])
        index = index.expand(lead + index.shape[-1:])
    return route.gather(-2, index[..., None].expand(*index.shape, 2))


def nearest_vertex(
    points: Tensor,
    route: Tensor,
    hint: Tensor | None = None,
    window: float = WINDOW,
) -> Tensor:
    """Returns the index [..., K] of the vertex of a route nearest to points.

    Args:
        points: [..., K, 2] m.
        route: [..., P, 2] m.
        hint: [..., K] m, expected arc length, for routes that cross themselves.
        window: m around it within which vertices count.
    """
    count = route.shape[-2]
    if hint is None:
        # the compiler makes a vector loop of a minimum, but not of argmin
        if torch.compiler.is_compiling():
            dx = points[..., None, 0] - route[..., None, :, 0]
            dy = points[..., None, 1] - route[..., None, :, 1]
            return first_least(dx.square() + dy.square())
        product = 2 * points @ route.transpose(-1, -2)
        return ((route**2).sum(-1)[..., None, :] - product).argmin(-1)
    near = hint.clamp(0, SPACING * (count - 1))  # beyond an end, that is what is near
    width = min(int(2 * window / SPACING) + 1, count)
    first = ((near - window) / SPACING).ceil().clamp(0, count - width).long()
    index = first[..., None] + torch.arange(width, device=first.device)
    vertices = _take(route, index.flatten(-2)).unflatten(-2, index.shape[-2:])
    gap = vertices - points[..., None, :]
    outside = (SPACING * index - near[..., None]).abs() > window
    squared = gap.square().sum(-1).masked_fill(outside, torch.inf)
    return first + first_least(squared)


def first_least(values: Tensor) -> Tensor:
    """`values.argmin(-1)`, by minima while it is compiled."""
    if not torch.compiler.is_compiling():
        return values.argmin(-1)
    order = torch.arange(
        values.shape[-1],
        dtype=values.dtype,
        device=values.device,
    )
    least = values == values.amin(-1, keepdim=True)
    return torch.where(least, order, values.shape[-1]).amin(-1).long()


def project(
    points: Tensor,
    route: Tensor,
    hint: Tensor | None = None,
    window: float = WINDOW,
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns Frenet coordinates of points on a route, which goes on straight beyond
    its ends.

    Args:
        points: [..., K, 2] m; leading dims broadcast.
        route: [..., P, 2] m.
        hint, window: see `nearest_vertex`.

    Returns:
        Arc length s [m], offset d [m] (left positive) and the route's heading [rad] at
        s, each [..., K].
    """
    lead = route.shape[:-2]
    compiled = is_on() and hint is None
    if compiled and torch.broadcast_shapes(points.shape[:-2], lead) == lead:
        rows = points.expand(lead + points.shape[-2:]).flatten(0, -3)
        pose = project_rows(rows, route.flatten(0, -3))
        return tuple(value.view(lead + points.shape[-2:-1]) for value in pose)
    return _project(
        points,
        route,
        hint=hint,
        window=window,
    )


def _project(
    points: Tensor,
    route: Tensor,
    hint: Tensor | None,
    window: float,
) -> tuple[Tensor, Tensor, Tensor]:
    vertex = nearest_vertex(
        points,
        route,
        hint=hint,
        window=window,
    )
    last = route.shape[-2] - 2
    return onto_segments(
        points,
        vertex,
        last,
        take=lambda index: _take(route, index),
    )


@fused("R K 2", "R P 2!")
def project_rows(points: Tensor, route: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`project` of points [R, K, 2] on routes [R, P, 2]."""
    return _project(
        points,
        route,
        hint=None,
        window=WINDOW,
    )


def project_track(
    points: Tensor,
    route: Tensor,
    known: Tensor | None = None,
    start: float | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """`project` of points [Q, T, 2] that a vehicle passes one after another, continuous
    along routes [Q, P, 2].

    Where a route crosses or repeats itself, the nearest place may be one that the
    vehicle comes to later or has long passed: a track whose places jump is followed
    from point to point instead.

    Args:
        points: positions [m].
        route: one route for each track.
        known: bool [Q, T], whether a point is known; others are where the last known
            one is. Default: all.
        start: arc length [m] near which a track whose first point is known begins.
            Default: unknown.

    Returns:
        Arc length s [m], offset d [m] and the route's heading [rad], each [Q, T].
    """
    if known is not None:
        points = _filled(points, known)
    pose = project(points, route)
    s = pose[0]
    moved = points.diff(dim=1).norm(dim=-1)
    jumps = ((s.diff(dim=1).abs() - moved) > WINDOW).any(1)
    if start is not None and points.shape[1]:
        away = (s[:, 0] - start).abs() > WINDOW
        jumps = jumps | (away if known is None else away & known[:, 0])
    rows = jumps.nonzero()[:, 0]
    if not len(rows):
        return pose
    place = s[rows, 0]
    if start is not None:
        begins = torch.full_like(place, start)
        place = begins if known is None else torch.where(known[rows, 0], begins, place)
    steps = []
    for frame in range(points.shape[1]):
        hint = place if frame == 0 else place + moved[rows, frame - 1]
        step = project(points[rows, frame : frame + 1], route[rows], hint[:, None])
        place = step[0][:, 0]
        steps.append(torch.stack(step, -1))
    followed = torch.cat(steps, 1).unbind(-1)
    s, d, heading = (
        value.index_copy(0, rows, change)
        for value, change in zip(pose, followed, strict=True)
    )
    return s, d, heading


def _filled(points: Tensor, known: Tensor) -> Tensor:
    """Points [Q, T, 2] with the last known one, or before that the first, in the place
    of those unknown."""
    frame = torch.arange(known.shape[1], device=known.device).expand_as(known)
    last = torch.where(known, frame, -1).cummax(1).values
    first = known.int().argmax(1, keepdim=True)
    index = torch.where(last < 0, first, last)
    return points.gather(1, index[..., None].expand_as(points))


def onto_segments(
    points: Tensor,
    vertex: Tensor,
    last: int,
    take: Callable[[Tensor], Tensor],
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns `project` of points whose nearest vertices are known, onto the two
    segments that meet there.

    Args:
        points: [..., 2] m.
        vertex: [...] index of the nearest one.
        last: index of the last segment.
        take: a function from indices [2, ...] to vertices [2, ..., 2].
    """
    index = torch.stack([vertex - 1, vertex]).clamp(0, last)
    start = take(index)
    along = take(index + 1) - start
    length = along.norm(dim=-1).clamp(min=1e-6)
    unit = along / length[..., None]
    offset = points - start
    t = (offset * unit).sum(-1) / length
    low = torch.where(index == 0, -torch.inf, 0.0)
    high = torch.where(index == last, torch.inf, 1.0)
    t = torch.maximum(torch.minimum(t, high), low)
    gap = (offset - t[..., None] * along).norm(dim=-1)
    d = unit[..., 0] * offset[..., 1] - unit[..., 1] * offset[..., 0]
    d = torch.where(d < 0, -gap, gap)
    s = SPACING * (index + t)
    second = gap[1] < gap[0]  # the first, where both are equally near
    x, y = torch.where(second[..., None], unit[1], unit[0]).unbind(-1)
    s = torch.where(second, s[1], s[0])
    return s, torch.where(second, d[1], d[0]), torch.atan2(y, x)


def interpolate(
    route: Tensor,
    s: Tensor,
    tangents: tuple[Tensor, Tensor] | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Point [..., K, 2], heading [rad], curvature [1/m] (each [..., K]) of route [...,
    P, 2] at arc length s [..., K].

    Points lie on the chords; the heading turns linearly from vertex to vertex, so it is
    continuous in s. Beyond the ends the route goes on straight. Differentiable in s.
    tangents: those of the route, for many more points than it has vertices.
    """
    if is_on() and tangents is None and route.shape[:-2] == s.shape[:-1]:
        rows = s.flatten(0, -2)
        xy, heading, curvature = interpolate_rows(route.flatten(0, -3), rows)
        return xy.view(*s.shape, 2), heading.view(s.shape), curvature.view(s.shape)
    return _interpolate(route, s, tangents=tangents)


@fused("R P 2!", "R K")
def interpolate_rows(route: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`interpolate` of routes [R, P, 2] at s [R, K]."""
    return _interpolate(route, s, tangents=None)


def _interpolate(
    route: Tensor,
    s: Tensor,
    tangents: tuple[Tensor, Tensor] | None,
) -> tuple[Tensor, Tensor, Tensor]:
    last = route.shape[-2] - 2
    u = s / SPACING
    i = u.detach().floor().clamp(0, last).long()
    t = u - i
    if tangents is None:
        four = torch.cat([i - 1, i, i + 1, i + 2], -1).clamp(0, last + 1)
        vertices = _take(route, four).unflatten(-2, (4, i.shape[-1])).unbind(-3)
        _, a, b, _ = vertices
        angle, turn = _tangent(vertices)
    else:
        a = _take(route, i)
        b = _take(route, i + 1)
        angle, turn = (
            values.expand(*i.shape[:-1], last + 1).gather(-1, i) for values in tangents
        )
    xy = a + t[..., None] * (b - a)
    inside = (t >= 0) & (t <= 1)
    heading = angle + t.clamp(0, 1) * turn
    return xy, heading, torch.where(inside, turn / SPACING, 0.0)


def tangents(route: Tensor) -> tuple[Tensor, Tensor]:
    """Angle [..., P - 1] rad of a route's tangent at the first vertex of each segment,
    and its turn to the next."""
    before = torch.cat([route[..., :1, :], route[..., :-2, :]], -2)
    after = torch.cat([route[..., 2:, :], route[..., -1:, :]], -2)
    return _tangent((before, route[..., :-1, :], route[..., 1:, :], after))


def _tangent(vertices: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """`tangents` of segments; vertices [..., 2]: before them, both ends, after them."""
    before, a, b, after = vertices
    first = b - before
    second = after - a
    cross = first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
    turn = torch.atan2(cross, (first * second).sum(-1))
    return angle_of(first), turn
