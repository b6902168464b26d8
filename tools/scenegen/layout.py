"""A road layout as plain netconvert XML: arms, carriageways with explicit left borders,
lane-true connections."""

from dataclasses import dataclass, field
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from e2rl.scenes.paths import arc_length, shift_left, wrap

STEP = 4.0  # m between the vertices of a road axis


@dataclass
class Arm:
    """A road from a junction to the border: axis [P, 2] outwards, and its edges (None
    where one way)."""

    axis: np.ndarray
    lanes: int
    speed: float
    rank: int  # netconvert priority
    inward: str | None = None
    outward: str | None = None
    border: str | None = None
    pocket: bool = False

    @property
    def angle(self) -> float:
        """Direction [rad] in which the arm leaves its junction."""
        return float(np.arctan2(*(self.axis[1] - self.axis[0])[::-1]))


def road_axis(
    start: np.ndarray, heading: float, length: float, curvature: np.ndarray
) -> np.ndarray:
    """Axis [P, 2] from `start`: curvature [C] (1/m) is interpolated over the length, so
    roads bend without kinks."""
    count = max(int(length / STEP), 2)
    bend = np.interp(
        np.linspace(0, 1, count), np.linspace(0, 1, len(curvature)), curvature
    )
    angle = (
        heading
        + np.concatenate([[0.0], np.cumsum(bend[1:] + bend[:-1]) / 2]) * length / count
    )
    steps = np.stack([np.cos(angle), np.sin(angle)], -1) * length / count
    return np.concatenate([[start], start + np.cumsum(steps, 0)])


def cut(line: np.ndarray, begin: float, end: float) -> np.ndarray:
    """Part of a polyline [P, 2] between two arc lengths; a negative `end` counts from
    the far end."""
    s = arc_length(line)
    end = s[-1] + end if end <= 0 else end
    at = np.concatenate([[begin], s[(s > begin + 0.5) & (s < end - 0.5)], [end]])
    return np.stack([np.interp(at, s, line[:, axis]) for axis in (0, 1)], -1)


@dataclass
class Layout:
    """Nodes, edges, connections and demand of one net; coordinates are kept by
    netconvert as they are given here."""

    name: str
    lane_width: float
    nodes: list[dict] = field(default_factory=list)
    edges: list[dict] = field(default_factory=list)
    connections: list[dict] = field(default_factory=list)
    tapers: list[tuple[str, int, str, int]] = field(
        default_factory=list
    )  # merges that SUMO drives as lane changes
    demand: list[tuple[str, str, float]] = field(
        default_factory=list
    )  # from edge, to edge, vehicles per hour
    parking: list[str] = field(
        default_factory=list
    )  # edges with cars parked at the kerb
    border: list[np.ndarray] = field(default_factory=list)

    def node(
        self,
        point: np.ndarray,
        kind: str = "priority",
        radius: float | None = None,
        border: bool = False,
    ) -> str:
        """Add a node; returns its id."""
        row = {
            "id": f"n{len(self.nodes)}",
            "x": f"{point[0]:.3f}",
            "y": f"{point[1]:.3f}",
            "type": kind,
        }
        if radius is not None:
            row["radius"] = f"{radius:.2f}"
        self.nodes.append(row)
        if border:
            self.border.append(np.asarray(point, float))
        return row["id"]

    def edge(
        self,
        start: str,
        end: str,
        left: np.ndarray,
        lanes: int,
        speed: float,
        rank: int = 1,
    ) -> str:
        """Add a carriageway whose left border is the polyline `left`; returns its id."""
        shape = " ".join(f"{x:.3f},{y:.3f}" for x, y in left)
        row = {
            "id": f"e{len(self.edges)}",
            "from": start,
            "to": end,
            "numLanes": lanes,
            "speed": f"{speed:.3f}",
            "width": f"{self.lane_width:.3f}",
            "priority": rank,
            "spreadType": "right",
            "shape": shape,
        }
        self.edges.append(row)
        return row["id"]

    def connect(self, a: str, b: str, pairs) -> None:
        """Allow the lane pairs (from, to; 0 is the rightmost) between edges a and b."""
        self.connections += [
            {"from": a, "to": b, "fromLane": i, "toLane": j} for i, j in pairs
        ]

    def arm(
        self,
        node: str,
        axis: np.ndarray,
        lanes: int,
        speed: float,
        rank: int,
        median: float = 0.0,
        pocket: float = 0.0,
        border: str | None = None,
        taper: float = 34.0,
    ) -> Arm:
        """A two-way road from `node` outwards along `axis`.

        pocket > 0: a left-turn lane of that length takes the median (at least a lane
        wide) before the junction; it opens over `taper` m. The carriageways' left
        borders are explicit, so through lanes never shift sideways.
        """
        border = border or self.node(axis[-1], border=True)
        outward = self.edge(
            node, border, shift_left(axis, -median / 2), lanes, speed, rank
        )
        left = shift_left(axis, median / 2)
        if pocket:
            joint = self.node(np.array(cut(left, pocket + taper / 2, 0)[0]))
            far = self.edge(
                border, joint, cut(left, pocket + taper, 0)[::-1], lanes, speed, rank
            )
            near_left = shift_left(axis, median / 2 - self.lane_width)
            inward = self.edge(
                joint, node, cut(near_left, 0, pocket)[::-1], lanes + 1, speed, rank
            )
            self.connect(
                far, inward, [(k, k) for k in range(lanes)] + [(lanes - 1, lanes)]
            )
            source = far
        else:
            inward = source = self.edge(border, node, left[::-1], lanes, speed, rank)
        return Arm(axis, lanes, speed, rank, inward, outward, source, bool(pocket))

    def join(self, arms: list[Arm]) -> None:
        """Connect all arms of a junction: right turns from the rightmost lane, left
        turns from the leftmost, straight on in the lane that lies ahead."""
        for a in arms:
            for b in arms:
                if a is b or a.inward is None or b.outward is None:
                    continue
                turn = wrap(b.angle - (a.angle + np.pi))
                count = a.lanes + a.pocket
                if turn < -0.7:
                    pairs = [(0, 0)]
                elif turn > 0.7:
                    pairs = [(count - 1, b.lanes - 1)]
                else:
                    pairs = [
                        (a.lanes - 1 - k, b.lanes - 1 - k)
                        for k in range(min(a.lanes, b.lanes))
                    ]
                self.connect(a.inward, b.outward, pairs)

    def write(self, folder: Path) -> list[str]:
        """Write the three XML files; returns netconvert's arguments for them."""
        arguments = []
        for option, tag, rows in (
            ("node", "nodes", self.nodes),
            ("edge", "edges", self.edges),
            ("connection", "connections", self.connections),
        ):
            lines = [
                f"  <{option} "
                + " ".join(f"{k}={quoteattr(str(v))}" for k, v in row.items())
                + "/>"
                for row in rows
            ]
            path = folder / f"{self.name}.{option}.xml"
            path.write_text("\n".join([f"<{tag}>", *lines, f"</{tag}>"]))
            arguments += [f"--{option}-files", str(path)]
        return arguments
