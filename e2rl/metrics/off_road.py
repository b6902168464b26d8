"""Off the road: a vehicle's centre outside every drivable polygon and far from every
lane (docs/method.md, section 10).

On the road means inside a drivable polygon (even-odd rule), in the seam between two of
them, or within half the lane's width + 1.0 m of its centreline. Distances are exact,
from point to segment; a grid of buckets keeps the work near the number of points.
"""

import torch
from torch import Tensor

from e2rl.metrics.catalogue import Batch, columns, event, rate
from e2rl.metrics.contact import steps_until
from e2rl.metrics.geometry import candidates, from_segment
from e2rl.scenes.drivable_area import SEAM

MARGIN = 1.0  # m beyond half the lane width
LANE_CELL = 8.0  # m, grid of the lanes' segments
ROW = 4.0  # m, rows of the polygons' edges


def line_segments(
    points: Tensor, index: Tensor, closed: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """(rollout [m], line [m], ends [m, 2, 2]) of consecutive points [B, M, 2] with the
    same line index [B, M] >= 0.

    A line's points are adjacent rows. With `closed` a last segment joins each line's
    last point to its first.
    """
    known = index >= 0
    same_line = known[:, 1:] & (index[:, 1:] == index[:, :-1])
    rollout, point = same_line.nonzero(as_tuple=True)
    line = index[rollout, point]
    ends = torch.stack([points[rollout, point], points[rollout, point + 1]], 1)
    if closed and index.shape[1]:
        edge = torch.ones_like(known[:, :1])
        first = known & torch.cat([edge, ~same_line], 1)
        last = known & torch.cat([~same_line, edge], 1)
        ring, start = first.nonzero(as_tuple=True)
        stop = last.nonzero(as_tuple=True)[1]
        rollout = torch.cat([rollout, ring])
        line = torch.cat([line, index[ring, start]])
        ends = torch.cat(
            [ends, torch.stack([points[ring, stop], points[ring, start]], 1)]
        )
    return rollout, line, ends


def near_lane(
    points: Tensor,
    rollout: Tensor,
    lane_points: Tensor,
    lane_index: Tensor,
    lane_width: Tensor,
    margin: float = MARGIN,
) -> Tensor:
    """Bool [n]: points [n, 2] of rollouts [n] within width / 2 + margin of a lane's
    centreline.

    lane_points [B, M, 2], lane_index [B, M] (-1 padding), lane_width [B, L].
    """
    owner, lane, ends = line_segments(lane_points, lane_index)
    point, _ = near_segments(
        points,
        rollout,
        owner=owner,
        ends=ends,
        reach=lane_width[owner, lane] / 2 + margin,
    )
    return torch.zeros(len(points), dtype=torch.bool).index_fill(0, point, True)


def near_segments(
    points: Tensor, rollout: Tensor, owner: Tensor, ends: Tensor, reach: Tensor
) -> tuple[Tensor, Tensor]:
    """(point, segment) of all pairs of a point [n, 2] of rollouts [n] and a segment [m,
    2, 2] of rollouts `owner` [m] that is at most reach [m] m away."""
    low = ends.amin(1) - reach[:, None]
    high = ends.amax(1) + reach[:, None]
    point, segment = candidates(
        points, rollout, low=low, high=high, item_group=owner, cell=LANE_CELL
    )
    start = ends[segment, 0]
    along = (ends[:, 1] - ends[:, 0])[segment]
    near = (
        from_segment(points[point], start, along=along).square().sum(-1)
        <= reach[segment].square()
    )
    return point[near], segment[near]


def inside_polygon(
    points: Tensor, rollout: Tensor, polygon_points: Tensor, polygon_index: Tensor
) -> Tensor:
    """Bool [n]: points [n, 2] of rollouts [n] inside a polygon, by the parity of edges
    crossed on a ray towards +x.

    polygon_points [B, D, 2], polygon_index [B, D] (-1 padding); polygons may overlap.
    """
    owner, polygon, ends = line_segments(polygon_points, polygon_index, closed=True)
    y = ends[..., 1]
    point, edge = candidates(
        points[:, 1:],
        rollout,
        low=y.amin(1)[:, None],
        high=y.amax(1)[:, None],
        item_group=owner,
        cell=ROW,
    )
    x, height = points[point].unbind(-1)
    (x0, y0), (x1, y1) = ends[edge, 0].unbind(-1), ends[edge, 1].unbind(-1)
    straddles = (y0 > height) != (y1 > height)
    rise = torch.where(y1 == y0, torch.ones_like(y0), y1 - y0)
    crossed = straddles & (x < x0 + (height - y0) / rise * (x1 - x0))
    polygons = max(int(polygon_index.amax()) + 1, 1) if polygon_index.numel() else 1
    key, count = (point * polygons + polygon[edge])[crossed].unique(return_counts=True)
    return torch.zeros(len(points), dtype=torch.bool).index_fill(
        0, key[count % 2 == 1] // polygons, True
    )


def in_seam(
    points: Tensor, rollout: Tensor, polygon_points: Tensor, polygon_index: Tensor
) -> Tensor:
    """Bool [n]: points [n, 2] of rollouts [n] within SEAM of the borders of two
    polygons or more.

    polygon_points [B, D, 2], polygon_index [B, D] (-1 padding). Many maps draw polygons
    that adjoin with a gap.
    """
    owner, polygon, ends = line_segments(polygon_points, polygon_index, closed=True)
    point, segment = near_segments(
        points, rollout, owner=owner, ends=ends, reach=ends.new_full(owner.shape, SEAM)
    )
    pairs = torch.stack([point, polygon[segment]], 1).unique(dim=0)
    return torch.bincount(pairs[:, 0], minlength=len(points)) > 1


def has_lines(index: Tensor) -> Tensor:
    """Bool [B]: some line of index [B, M] has at least two points."""
    return ((index[:, 1:] >= 0) & (index[:, 1:] == index[:, :-1])).any(-1)


def on_road(points: Tensor, rollout: Tensor, batch: Batch) -> Tensor:
    """Bool [n]: points [n, 2] of rollouts [n] int64 are on the road of the batch's
    maps."""
    polygons = batch["drivable_points"], batch["drivable_index"]
    near = near_lane(
        points,
        rollout,
        lane_points=batch["lane_points"],
        lane_index=batch["lane_index"],
        lane_width=batch["lane_width"],
    )
    for holds in (inside_polygon, in_seam):
        rest = (~near).nonzero()[:, 0]
        near[rest] = holds(points[rest], rollout[rest], *polygons)
    return near


@columns(
    rate(
        "aor_step",
        "off the road, of vehicle-steps",
        weight="aor_vehicle_steps",
        tables="main traffic adversaries methods public",
    ),
    rate("aor_any", "off the road, of rollouts", tables="main traffic methods"),
    event("ego_off_road", "ego leaves the road", tables="main egos public"),
    events=("aor_vehicle_steps", "aor_left_out"),
)
def off_road_columns(batch: Batch) -> Batch:
    """`aor_step` and `aor_any` [B] of the traffic at steps 1..stop, and the
    vehicle-steps they rest on; `ego_off_road` [B], 0 or 1: the ego leaves the road.

    Vehicles absent or off the road at step 0 are left out (`aor_left_out` counts the
    latter). NaN where no vehicle is left, of the ego where it is left out, or where the
    rollout has no map.
    """
    states = batch["states"]
    stop = batch["stop"]
    counted = batch["traffic"] & batch["valid"][:, 0]
    looked_at = counted.clone()
    looked_at[:, 0] = True
    steps = torch.arange(states.shape[1], device=states.device)
    asked = batch["valid"] & looked_at[:, None] & (steps <= stop[:, None])[..., None]
    index = asked.nonzero(as_tuple=True)
    road_here = torch.zeros_like(asked)
    road_here[index] = on_road(states[index][:, :2], index[0], batch=batch)
    ego_off = (asked & ~road_here)[..., 0]
    seen = (
        asked
        & counted[:, None]
        & road_here[:, :1]
        & steps_until(stop, states.shape[1])[..., None]
    )
    mapped = has_lines(batch["lane_index"]) | has_lines(batch["drivable_index"])
    number = seen.sum((1, 2)) * mapped
    off = (seen & ~road_here).sum((1, 2)).to(states.dtype)
    unknown, beside = (
        number == 0,
        ~road_here[:, 0, 0],
    )  # the ego is beside the road, or not there, at the start
    return {
        "aor_step": (off / number.clamp(min=1)).masked_fill(unknown, torch.nan),
        "aor_any": (off > 0).to(states.dtype).masked_fill(unknown, torch.nan),
        "aor_left_out": (counted & ~road_here[:, 0])
        .sum(-1)
        .to(states.dtype)
        .masked_fill(~mapped, torch.nan),
        "aor_vehicle_steps": number,
        "ego_off_road": ego_off.any(1)
        .to(states.dtype)
        .masked_fill(beside | ~mapped, torch.nan),
    }
