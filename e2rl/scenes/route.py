"""Geometry of routes: polylines with a vertex every SPACING metres, whose arc length is
SPACING x vertex index.

Routes are smoothed, so chords are a little shorter than SPACING; projection and
interpolation share the index scale.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from e2rl.run.fused import fused, is_on

SPACING = 2.0  # m of arc length between vertices
WINDOW = 20.0  # m on either side of an expected arc length
BEHIND = 20.0  # m of a route, at most, that lie behind the vehicle that it was made for


def _take(route: Tensor, index: Tensor) -> Tensor:
    """Vertices route [..., P, 2] at index [..., K] -> [..., K, 2], leading dims
    broadcast."""
    if route.shape[:-2] != index.shape[:-1]:
        lead = torch.broadcast_shapes(route.shape[:-2], index.shape[:-1])
        route = route.expand(*lead, *route.shape[-2:])
        index = index.expand(*lead, index.shape[-1])
    return route.gather(-2, index[..., None].expand(*index.shape, 2))


def nearest_vertex(
    points: Tensor, route: Tensor, hint: Tensor | None = None, window: float = WINDOW
) -> Tensor:
    """Index [..., K] of the vertex of route [..., P, 2] nearest to points [..., K, 2].

    hint [..., K]: expected arc length; only vertices within `window` m of it count, for
    routes that cross themselves.
    """
    count = route.shape[-2]
    if hint is None:
        if (
            torch.compiler.is_compiling()
        ):  # the compiler makes a vector loop of a minimum, but not of argmin
            x, y = (
                (points[..., None, axis] - route[..., None, :, axis]).square()
                for axis in range(2)
            )
            return first_least(x + y)
        squared = (route**2).sum(-1)[..., None, :] - 2 * points @ route.transpose(
            -1, -2
        )
        return squared.argmin(-1)
    near = hint.clamp(
        0, SPACING * (count - 1)
    )  # beyond the ends, the end is what is near
    width = min(int(2 * window / SPACING) + 1, count)
    first = ((near - window) / SPACING).ceil().clamp(0, count - width).long()
    index = first[..., None] + torch.arange(width, device=first.device)
    gap = (
        _take(route, index.flatten(-2)).unflatten(-2, index.shape[-2:])
        - points[..., None, :]
    )
    outside = (SPACING * index - near[..., None]).abs() > window
    squared = gap.square().sum(-1).masked_fill(outside, torch.inf)
    return first + first_least(squared)


def first_least(values: Tensor) -> Tensor:
    """`values.argmin(-1)`, by minima while it is compiled."""
    if not torch.compiler.is_compiling():
        return values.argmin(-1)
    order = torch.arange(values.shape[-1], dtype=values.dtype, device=values.device)
    return (
        torch.where(values == values.amin(-1, keepdim=True), order, values.shape[-1])
        .amin(-1)
        .long()
    )


def project(
    points: Tensor, route: Tensor, hint: Tensor | None = None, window: float = WINDOW
) -> tuple[Tensor, Tensor, Tensor]:
    """Frenet coordinates of points [..., K, 2] on route [..., P, 2]: arc length s [m],
    offset d [m] (left positive) and the route's heading [rad] at s; each [..., K].

    hint, window: see `nearest_vertex`. Leading dims broadcast. Beyond the ends the
    route goes on straight.
    """
    lead = route.shape[:-2]
    if (
        is_on()
        and hint is None
        and torch.broadcast_shapes(points.shape[:-2], lead) == lead
    ):
        rows = points.expand(*lead, *points.shape[-2:]).flatten(0, -3)
        return tuple(
            value.view(*lead, points.shape[-2])
            for value in project_rows(rows, route.flatten(0, -3))
        )
    return _project(points, route, hint=hint, window=window)


def _project(
    points: Tensor, route: Tensor, hint: Tensor | None, window: float
) -> tuple[Tensor, Tensor, Tensor]:
    vertex = nearest_vertex(points, route, hint=hint, window=window)
    return onto_segments(
        points, vertex, last=route.shape[-2] - 2, take=lambda index: _take(route, index)
    )


@fused("R K 2", "R P 2!")
def project_rows(points: Tensor, route: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`project` of points [R, K, 2] on routes [R, P, 2]."""
    return _project(points, route, hint=None, window=WINDOW)


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
    s, d, heading = project(points, route)
    moved = points.diff(dim=1).norm(dim=-1)
    lost = ((s.diff(dim=1).abs() - moved) > WINDOW).any(1)
    if start is not None and points.shape[1]:
        away = (s[:, 0] - start).abs() > WINDOW
        lost = lost | (away if known is None else away & known[:, 0])
    rows = lost.nonzero()[:, 0]
    if not len(rows):
        return s, d, heading
    place = torch.full_like(s[rows, 0], start) if start is not None else s[rows, 0]
    if start is not None and known is not None:
        place = torch.where(known[rows, 0], place, s[rows, 0])
    poses = []
    for frame in range(points.shape[1]):
        hint = place if frame == 0 else place + moved[rows, frame - 1]
        pose = project(points[rows, frame : frame + 1], route[rows], hint=hint[:, None])
        place = pose[0][:, 0]
        poses.append(torch.stack(pose, -1))
    fresh = torch.cat(poses, 1).unbind(-1)
    s, d, heading = (
        old.index_copy(0, rows, new)
        for old, new in zip((s, d, heading), fresh, strict=True)
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
    points: Tensor, vertex: Tensor, last: int, take: Callable[[Tensor], Tensor]
) -> tuple[Tensor, Tensor, Tensor]:
    """`project` of points [..., 2] whose nearest vertices [...] are known.

    They are projected onto the two segments that meet at the vertex. last: index of the
    last segment; take: a function from indices [2, ...] to vertices [2, ..., 2].
    """
    start = torch.stack([vertex - 1, vertex]).clamp(0, last)
    a = take(start)
    along, length, unit = segment(a, take(start + 1))
    s, d, second = onto_nearer(
        points, start, last=last, a=a, along=along, length=length, unit=unit
    )
    x, y = torch.where(second[..., None], unit[1], unit[0]).unbind(-1)
    return s, d, torch.atan2(y, x)


def segment(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """From a to b [..., 2]: the difference, its length [...] (at least 1e-6), its
    direction."""
    along = b - a
    length = along.norm(dim=-1).clamp(min=1e-6)
    return along, length, along / length[..., None]


def onto_nearer(
    points: Tensor,
    start: Tensor,
    last: int,
    a: Tensor,
    along: Tensor,
    length: Tensor,
    unit: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Arc length, offset [...] of points [..., 2] on the nearer of two segments, and
    whether that is the second; it is the first where both are equally near.

    start [2, ...], a [2, ..., 2]: index and position of the vertex where each segment
    begins; last: index of the last segment; along, length, unit [2, ...]: see
    `segment`.
    """
    offset = points - a
    t = (offset * unit).sum(-1) / length
    low = torch.where(start == 0, -torch.inf, 0.0)
    high = torch.where(start == last, torch.inf, 1.0)
    t = torch.maximum(torch.minimum(t, high), low)
    gap = (offset - t[..., None] * along).norm(dim=-1)
    d = unit[..., 0] * offset[..., 1] - unit[..., 1] * offset[..., 0]
    second = gap[1] < gap[0]
    s, d = (
        torch.where(second, x[1], x[0])
        for x in (SPACING * (start + t), torch.where(d < 0, -gap, gap))
    )
    return s, d, second


def interpolate(
    route: Tensor, s: Tensor, tangents: tuple[Tensor, Tensor] | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Point [..., K, 2], heading [rad], curvature [1/m] (each [..., K]) of route [...,
    P, 2] at arc length s [..., K].

    Points lie on the chords; the heading turns linearly from vertex to vertex, so it is
    continuous in s. Beyond the ends the route goes on straight. Differentiable in s.
    tangents: those of the route, for many more points than it has vertices.
    """
    if is_on() and tangents is None and route.shape[:-2] == s.shape[:-1]:
        xy, heading, curvature = interpolate_rows(
            route.flatten(0, -3), s.flatten(0, -2)
        )
        return xy.view(*s.shape, 2), heading.view(s.shape), curvature.view(s.shape)
    return _interpolate(route, s, tangents=tangents)


@fused("R P 2!", "R K")
def interpolate_rows(route: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`interpolate` of routes [R, P, 2] at s [R, K]."""
    return _interpolate(route, s, tangents=None)


def _interpolate(
    route: Tensor, s: Tensor, tangents: tuple[Tensor, Tensor] | None
) -> tuple[Tensor, Tensor, Tensor]:
    last = route.shape[-2] - 2
    u = s / SPACING
    i = u.detach().floor().clamp(0, last).long()
    t = u - i
    if tangents is None:
        four = torch.cat([i - 1, i, i + 1, i + 2], -1).clamp(0, last + 1)
        before, a, b, after = (
            _take(route, four).unflatten(-2, (4, i.shape[-1])).unbind(-3)
        )
        angle, turn = _tangent(before, a, b=b, after=after)
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
    return _tangent(before, route[..., :-1, :], b=route[..., 1:, :], after=after)


def _tangent(
    before: Tensor, a: Tensor, b: Tensor, after: Tensor
) -> tuple[Tensor, Tensor]:
    """`tangents` of segments from a to b [..., 2] and the vertices before and after
    them."""
    first = b - before
    second = after - a
    cross = first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
    return torch.atan2(first[..., 1], first[..., 0]), torch.atan2(
        cross, (first * second).sum(-1)
    )
