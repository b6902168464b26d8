"""Top-down maps of traffic on matplotlib axes, and figures as images.

World coordinates are metres with y up. A figure has 72 points per inch, so lengths of
layouts are in points.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.text import Text
from PIL import Image

from e2rl.run.files import write_atomically
from e2rl.sim.rollout_file import Road

Colour = str | tuple[str, float]  # of matplotlib: a name, or a name with its opacity

GROUND = "#eef0ec"
ROAD = "#d5d9df"
CENTRELINE = "#f7f8fa"
INK = "#1c2430"
MUTED = "#5d6877"
PANEL = "#ffffff"
EGO = "#1565d8"
ADVERSARY = "#dc2f3c"
BACKGROUND = "#8793a3"
REPLAYED = "#b3bcc8"
VULNERABLE = "#f0950c"
DRIVER = "#0b7a4b"
EVASION = "#7a3fc0"
CONTACT = "#dc2f3c"
CLEAR = (0, 0, 0, 0)
# m added to a lane's drawn width: the gap between neighbouring lanes is road, too.
VERGE = 0.8

# Outlines in units of half the length and half the width, the front at x = 1.
BODY = (
    (1, 0.62),
    (0.9, 1),
    (-0.93, 1),
    (-1, 0.75),
    (-1, -0.75),
    (-0.93, -1),
    (0.9, -1),
    (1, -0.62),
)
WINDSCREEN = ((0.52, 0.72), (0.2, 0.8), (0.2, -0.8), (0.52, -0.72))
BOX = ((1, 1), (-1, 1), (-1, -1), (1, -1))
CIRCLE = tuple(
    (np.cos(angle), np.sin(angle))
    for angle in np.linspace(0, 2 * np.pi, 48, endpoint=False)
)


class Shape(NamedTuple):
    """A polygon [k, 2] m with its fill, its edge and the edge's width [m]."""

    polygon: np.ndarray
    fill: Colour
    edge: Colour = "none"
    width: float = 0.1


class Trail(NamedTuple):
    """A path [k, 2] m that fades towards its beginning, with its colour and its width
    [m] at the end."""

    path: np.ndarray
    colour: Colour
    width: float


class TrafficMap:
    """A road, drawn once, and the traffic that each `show` replaces.

    axes: where to draw. metres: the world's length along the axes' width, which fixes
    the scale. `scale` is in points per metre.
    """

    def __init__(self, axes: Axes, road: Road, metres: float):
        box = axes.get_window_extent()
        self.axes = axes
        self.scale = box.width / axes.figure.dpi * 72 / metres
        self.reach = metres / 2 * np.array([1, box.height / box.width])
        axes.set(facecolor=GROUND, xticks=(), yticks=())
        axes.spines[:].set_visible(False)
        lanes = road.lanes()
        widths = (road.lane_width + VERGE) * self.scale
        # Agg clips lines without a fill at the canvas by their middle, which would cut
        # wide ones: hence a clear fill.
        surface = LineCollection(
            lanes,
            linewidths=widths,
            colors=ROAD,
            facecolors=CLEAR,
        )
        surface.set(capstyle="round", joinstyle="round")
        self.trails = LineCollection([])
        self.shapes = PolyCollection([], zorder=3)
        axes.add_collection(PolyCollection(road.polygons(), facecolors=ROAD))
        axes.add_collection(surface)
        axes.add_collection(
            LineCollection(lanes, linewidths=0.16 * self.scale, colors=CENTRELINE)
        )
        axes.add_collection(self.trails)
        axes.add_collection(self.shapes)

    def show(
        self,
        centre: np.ndarray,
        trails: Sequence[Trail],
        shapes: Sequence[Shape],
    ) -> None:
        """Move the map's centre [2] m, and draw trails and then shapes, the last on
        top."""
        low = centre - self.reach
        high = centre + self.reach
        self.axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        parts = []
        colours = []
        widths = []
        for path, colour, width in trails:
            fade = np.arange(1, len(path)) / len(path)
            parts += list(np.stack([path[:-1], path[1:]], 1))
            colours += [(colour, 0.15 + 0.6 * part) for part in fade]
            widths += list(width * self.scale * (0.4 + 0.6 * fade))
        self.trails.set(segments=parts, color=colours, linewidths=widths)
        self.shapes.set(
            verts=[shape.polygon for shape in shapes],
            facecolor=[shape.fill for shape in shapes],
            edgecolor=[shape.edge for shape in shapes],
            linewidths=[shape.width * self.scale for shape in shapes],
        )


def placed(
    outline: Sequence[tuple[float, float]],
    state: np.ndarray,
    size: np.ndarray,
) -> np.ndarray:
    """World points [k, 2] m of an outline at a state (x, y, heading, ...), for a size
    (length, width)."""
    local = np.array(outline) * size / 2
    cos = np.cos(state[2])
    sin = np.sin(state[2])
    return state[:2] + local @ np.array([[cos, sin], [-sin, cos]])


def vehicle(state: np.ndarray, size: np.ndarray, colour: Colour) -> list[Shape]:
    """A car's body, and its windscreen, which shows where its front is."""
    body = Shape(
        placed(BODY, state, size=size),
        colour,
        edge=("black", 0.4),
        width=0.12,
    )
    return [body, Shape(placed(WINDSCREEN, state, size=size), ("black", 0.45))]


def agent(
    kind: str,
    state: np.ndarray,
    size: np.ndarray,
    colour: Colour,
) -> list[Shape]:
    """A pedestrian as a disc, a cyclist as a slim box with a disc, and all others as
    vehicles.

    Args:
        kind: one of `recording.AGENT_TYPES`.
        state: x, y [m], heading [rad], ...
        size: length and width [m].
        colour: of vehicles.
    """
    if kind not in ("pedestrian", "cyclist"):
        return vehicle(state, size, colour=colour)
    bicycle = Shape(
        placed(BOX, state, size=np.maximum(size, (1.7, 0.5))),
        VULNERABLE,
        edge=("black", 0.4),
    )
    return [
        *([bicycle] if kind == "cyclist" else []),
        disc(state[:2], 0.45, fill=VULNERABLE, edge=("black", 0.4)),
    ]


def contact_mark(point: np.ndarray, phase: float) -> list[Shape]:
    """A dot at a point of contact [2] m and a ring around it, which widens as `phase`
    goes from 0 to 1."""
    radius = 1.9 + 2.6 * phase
    width = 0.34 - 0.18 * phase
    return [
        disc(point, radius, fill="none", edge=PANEL, width=width + 0.24),
        disc(point, radius, fill="none", edge=CONTACT, width=width),
        disc(point, 0.5, fill=CONTACT, edge=PANEL, width=0.16),
    ]


def disc(
    centre: np.ndarray,
    radius: float,
    fill: Colour,
    edge: Colour,
    width: float = 0.1,
) -> Shape:
    """A circle.

    Args:
        centre: [2] m.
        radius: m.
        fill: its colour.
        edge: its edge's colour.
        width: of the edge, m.
    """
    return Shape(centre + radius * np.array(CIRCLE), fill, edge=edge, width=width)


def new_figure(width: float, height: float, dpi: float = 72) -> Figure:
    """An empty figure of a size in points; at 72 dpi a point is a pixel."""
    return Figure((width / 72, height / 72), dpi, facecolor=PANEL)


def add_legend(figure: Figure, colours: Mapping[str, Colour], size: float) -> None:
    """What the colours mean, in one row at the figure's lower left; font of `size`."""
    handles = [Patch(facecolor=colour, label=text) for text, colour in colours.items()]
    style = {
        "frameon": False,
        "handlelength": 1.4,
        "handleheight": 0.9,
        "columnspacing": 1.4,
    }
    figure.legend(
        handles=handles,
        ncols=len(handles),
        loc="lower left",
        fontsize=size,
        **style,
    )


def without_formulas(figure: Figure) -> None:
    """No text in the figure is a formula: names may hold dollar signs."""
    for text in figure.findobj(Text):
        text.set_parse_math(False)


def image_of(figure: Figure) -> Image.Image:
    """The figure drawn as it is now, without formulas."""
    without_formulas(figure)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])


def save_figure(path: Path, figure: Figure) -> None:
    """Write a figure as PNG."""
    write_atomically(path, partial(image_of(figure).save, format="PNG", optimize=True))
