"""Off the road: a vehicle's centre outside every drivable polygon and far from every
lane (docs/reference/metrics.md).

On the road means inside a drivable polygon (even-odd rule), in the seam between two of
them, or within half the lane's width + 1.0 m of its centreline. Distances are exact,
from point to segment; a grid of buckets keeps the work near the number of points.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.metrics.catalogue import Batch, columns, event, rate
from e2rl.metrics.contact import steps_until
from e2rl.metrics.geometry import from_segment, pairs_where
from e2rl.scenes.drivable_area import SEAM

MARGIN = 1.0  # m beyond half the lane width
CELL = 4.0  # m, grid of segments
ROW = 4.0  # m, rows of the polygons' edges


class Points(NamedTuple):
    """n points of rollouts."""

    xy: Tensor  # [n, 2]
    rollout: Tensor  # [n] int64

    def outside(self, mask: Tensor) -> tuple["Points", Tensor]:
        """The points where mask [n] is false, and their indices."""
        index = (~mask).nonzero()[:, 0]
        return Points(self.xy[index], self.rollout[index]), index


class Segments(NamedTuple):
    """m segments of lines of rollouts."""

    rollout: Tensor  # [m] int64
    line: Tensor  # [m] int64
    ends: Tensor  # [m, 2, 2]

    @classmethod
    def of(cls, points: Tensor, index: Tensor, closed: bool = False) -> "Segments":
        """Segments of consecutive points [B, M, 2] with the same line index [B, M] >= 0.

        A line's points are adjacent rows. With `closed` a last segment joins each
        line's last point to its first.
        """
        is_point = index >= 0
        joined = is_point[:, 1:] & (index[:, 1:] == index[:, :-1])
        rollout, begin = joined.nonzero(as_tuple=True)
        end = begin + 1
        if closed and index.shape[1]:
            edge = torch.ones_like(is_point[:, :1])
            first = is_point & torch.cat([edge, ~joined], 1)
            last = is_point & torch.cat([~joined, edge], 1)
            ring, start = first.nonzero(as_tuple=True)
            rollout = torch.cat([rollout, ring])
            begin = torch.cat([begin, last.nonzero(as_tuple=True)[1]])
            end = torch.cat([end, start])
        ends = torch.stack([points[rollout, begin], points[rollout, end]], 1)
        return cls(rollout, index[rollout, begin], ends)

    @classmethod
    def lanes(cls, batch: Batch) -> "Segments":
        """Of the centrelines of a batch."""
        return cls.of(batch["lane_points"], batch["lane_index"])

    @classmethod
    def polygons(cls, batch: Batch) -> "Segments":
        """Of the borders of the drivable polygons of a batch."""
        return cls.of(
            batch["drivable_points"],
            batch["drivable_index"],
            closed=True,
        )


def near_segments(
    points: Points,
    segments: Segments,
    reach: Tensor | float,
) -> tuple[Tensor, Tensor]:
    """Indices (point, segment) of all pairs of a rollout that are at most reach m (a
    number, or [m] of each segment) apart."""
    reach = torch.as_tensor(reach, dtype=points.xy.dtype).expand(len(segments.line))

    def is_near(point: Tensor, segment: Tensor) -> Tensor:
        start, end = segments.ends[segment].unbind(1)
        offset = from_segment(
            points.xy[point],
            start,
            along=end - start,
        )
        return offset.square().sum(-1) <= reach[segment].square()

    return pairs_where(
        is_near,
        points.xy,
        points.rollout,
        low=segments.ends.amin(1) - reach[:, None],
        high=segments.ends.amax(1) + reach[:, None],
        item_group=segments.rollout,
        cell=CELL,
    )


def near_lane(points: Points, batch: Batch, margin: float = MARGIN) -> Tensor:
    """Bool [n]: points within width / 2 + margin of a lane's centreline."""
    lanes = Segments.lanes(batch)
    reach = batch["lane_width"][lanes.rollout, lanes.line] / 2 + margin
    point, _ = near_segments(points, lanes, reach)
    return is_among(point, points)


def inside_polygon(points: Points, polygons: Segments) -> Tensor:
    """Bool [n]: points inside a polygon, by the parity of edges crossed on a ray
    towards +x; polygons may overlap."""
    height = polygons.ends[..., 1]

    def is_crossed(point: Tensor, edge: Tensor) -> Tensor:
        x, y = points.xy[point].unbind(-1)
        begin, end = polygons.ends[edge].unbind(1)
        x0, y0 = begin.unbind(-1)
        x1, y1 = end.unbind(-1)
        straddles = (y0 > y) != (y1 > y)
        rise = torch.where(y1 == y0, torch.ones_like(y0), y1 - y0)
        return straddles & (x < x0 + (y - y0) / rise * (x1 - x0))

    point, edge = pairs_where(
        is_crossed,
        points.xy[:, 1:],
        points.rollout,
        low=height.amin(1)[:, None],
        high=height.amax(1)[:, None],
        item_group=polygons.rollout,
        cell=ROW,
    )
    pairs = torch.stack([point, polygons.line[edge]], 1)
    pairs, count = pairs.unique(dim=0, return_counts=True)
    return is_among(pairs[count % 2 == 1, 0], points)


def in_seam(points: Points, polygons: Segments) -> Tensor:
    """Bool [n]: points within SEAM of the borders of two polygons or more. Many maps
    draw polygons that adjoin with a gap."""
    point, segment = near_segments(points, polygons, SEAM)
    pairs = torch.stack([point, polygons.line[segment]], 1).unique(dim=0)
    return torch.bincount(pairs[:, 0], minlength=len(points.xy)) > 1


def is_among(index: Tensor, points: Points) -> Tensor:
    """Bool [n]: points whose index is among these."""
    mask = torch.zeros(len(points.xy), dtype=torch.bool)
    return mask.index_fill(0, index, True)


def on_road(points: Points, batch: Batch) -> Tensor:
    """Bool [n]: points are on the road of the batch's maps."""
    result = near_lane(points, batch)
    polygons = Segments.polygons(batch)
    for holds in (inside_polygon, in_seam):
        others, index = points.outside(result)
        result[index] = holds(others, polygons)
    return result


def has_map(batch: Batch) -> Tensor:
    """Bool [B]: some lane or polygon has at least two points."""

    def has_line(index: Tensor) -> Tensor:
        return ((index[:, 1:] >= 0) & (index[:, 1:] == index[:, :-1])).any(-1)

    return has_line(batch["lane_index"]) | has_line(batch["drivable_index"])


@columns(
    rate(
        "aor_step",
        "off the road, of vehicle-steps",
        weight="aor_vehicle_steps",
        tables="main traffic adversaries methods public",
    ),
    rate(
        "aor_any",
        "off the road, of rollouts",
        tables="main traffic methods",
    ),
    event(
        "ego_off_road",
        "ego leaves the road",
        tables="main egos public",
    ),
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
    steps = torch.arange(states.shape[1])
    until_stop = (steps <= stop[:, None])[..., None]
    traffic = batch["traffic"] & batch["valid"][:, 0]
    vehicles = traffic.clone()
    vehicles[:, 0] = True
    present = batch["valid"] & vehicles[:, None] & until_stop
    index = present.nonzero(as_tuple=True)
    is_on_road = torch.zeros_like(present)
    is_on_road[index] = on_road(Points(states[index][:, :2], index[0]), batch)
    starts_on_road = is_on_road[:, 0]
    counted = present & (traffic & starts_on_road)[:, None]
    counted = counted & steps_until(stop, states.shape[1])[..., None]

    unmapped = ~has_map(batch)
    number = counted.sum((1, 2)) * ~unmapped
    off = (counted & ~is_on_road).sum((1, 2)).to(states.dtype)
    left_out = (traffic & ~starts_on_road).sum(-1).to(states.dtype)
    ego_off = (present & ~is_on_road)[..., 0].any(1).to(states.dtype)
    unknown = number == 0
    return {
        "aor_step": (off / number.clamp(min=1)).masked_fill(unknown, torch.nan),
        "aor_any": (off > 0).to(states.dtype).masked_fill(unknown, torch.nan),
        "aor_left_out": left_out.masked_fill(unmapped, torch.nan),
        "aor_vehicle_steps": number,
        "ego_off_road": ego_off.masked_fill(
            ~starts_on_road[:, 0] | unmapped, torch.nan
        ),
    }
