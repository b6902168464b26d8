"""Top-down pictures of traffic: the road once as a wide layer, agents on a window of it, all drawn twice as large.

World coordinates are metres with y up; a `View` says which square of the world a picture shows.
"""

import io
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from e2rl.files import write_atomically

SUPERSAMPLING = 2
GROUND, ROAD, CENTRELINE = "#eef0ec", "#d5d9df", "#f7f8fa"
INK, MUTED, PANEL = "#1c2430", "#5d6877", "#ffffff"
EGO, ADVERSARY, BACKGROUND, REPLAYED, VULNERABLE = "#1565d8", "#dc2f3c", "#8793a3", "#b3bcc8", "#f0950c"
CONTACT = "#dc2f3c"
VERGE = 0.8  # m added to a lane's drawn width: the gap between neighbouring lanes is road, too


@dataclass(frozen=True)
class View:
    """A square window: centre [2] m, side in metres and in pixels of the finished picture."""

    centre: tuple[float, float]
    metres: float
    pixels: int

    @property
    def scale(self) -> float:
        """Drawn (not yet reduced) pixels per metre."""
        return SUPERSAMPLING * self.pixels / self.metres

    def place(self, points: np.ndarray) -> np.ndarray:
        """Drawn pixel coordinates [..., 2] of world points [..., 2]."""
        offset = np.asarray(points, float) - self.centre
        return (offset * (1, -1) + self.metres / 2) * self.scale


class RoadLayer:
    """The road drawn once over all that a moving window of given side will show."""

    def __init__(self, rollout: dict, centres: np.ndarray, metres: float, pixels: int):
        self.scale = SUPERSAMPLING * pixels / metres
        self.low, self.high = centres.min(0) - metres / 2 - 1, centres.max(0) + metres / 2 + 1
        width, height = np.ceil((self.high - self.low) * self.scale).astype(int)
        self.image = Image.new("RGB", (int(width), int(height)), GROUND)
        draw = ImageDraw.Draw(self.image)
        for ring in lines(rollout, "drivable"):
            draw.polygon(self.place(ring), fill=ROAD)
        shown = [
            (line, width)
            for line, width in zip(lines(rollout, "lane"), rollout["lane_width"], strict=True)
            if (line.max(0) > self.low - 5).all() and (line.min(0) < self.high + 5).all()
        ]
        for line, width in shown:
            self.ribbon(draw, line, float(width) + VERGE)
        for line, _ in shown:
            draw.line(self.place(line), fill=CENTRELINE, width=max(1, round(0.16 * self.scale)), joint="curve")

    def ribbon(self, draw: ImageDraw.ImageDraw, line: np.ndarray, width: float) -> None:
        """A lane's surface: wide strokes, with discs at the vertices that close the cracks between them."""
        points, radius = self.place(line), width * self.scale / 2
        draw.line(points, fill=ROAD, width=max(1, round(2 * radius)))
        for x, y in points:
            draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=ROAD)

    def place(self, points: np.ndarray) -> list[tuple[float, float]]:
        x = (points[:, 0] - self.low[0]) * self.scale
        y = (self.high[1] - points[:, 1]) * self.scale
        return list(zip(x.tolist(), y.tolist(), strict=True))

    def window(self, view: View) -> Image.Image:
        """The part that a view shows, at drawn resolution."""
        side = SUPERSAMPLING * view.pixels
        corner = np.array(view.centre) + np.array([-0.5, 0.5]) * view.metres
        left = round((corner[0] - self.low[0]) * self.scale)
        top = round((self.high[1] - corner[1]) * self.scale)
        return self.image.crop((left, top, left + side, top + side))


def lines(rollout: dict, name: str) -> list[np.ndarray]:
    """The polylines of `name`_points, [P, 2] each."""
    offsets = rollout[f"{name}_offsets"]
    return [rollout[f"{name}_points"][start:end] for start, end in zip(offsets[:-1], offsets[1:], strict=True)]


def box_corners(state: np.ndarray, size: np.ndarray, shape: tuple[tuple[float, float], ...]) -> np.ndarray:
    """World points [k, 2] of a shape in units of half length and half width, at state (x, y, heading, ...)."""
    local = np.array(shape) * np.asarray(size, float) / 2
    cos, sin = math.cos(state[2]), math.sin(state[2])
    return np.asarray(state[:2], float) + local @ np.array([[cos, sin], [-sin, cos]])


BODY = ((1, 0.62), (0.9, 1), (-0.93, 1), (-1, 0.75), (-1, -0.75), (-0.93, -1), (0.9, -1), (1, -0.62))
WINDSCREEN = ((0.52, 0.72), (0.2, 0.8), (0.2, -0.8), (0.52, -0.72))
BOX = ((1, 1), (-1, 1), (-1, -1), (1, -1))


def draw_vehicle(draw: ImageDraw.ImageDraw, view: View, state: np.ndarray, size: np.ndarray, colour: str) -> None:
    """A car's outline with a windscreen that shows where its front is."""
    body = pixel_list(view, box_corners(state, size, BODY))
    draw.polygon(body, fill=colour, outline=shade(colour, 0.62), width=max(2, round(0.12 * view.scale)))
    draw.polygon(pixel_list(view, box_corners(state, size, WINDSCREEN)), fill=shade(colour, 0.55))


def draw_outline(draw: ImageDraw.ImageDraw, view: View, state: np.ndarray, size: np.ndarray, colour: str) -> None:
    """An empty box: where the recording has an agent."""
    draw.polygon(
        pixel_list(view, box_corners(state, size, BOX)), outline=colour, width=max(2, round(0.14 * view.scale))
    )


def draw_vulnerable(draw: ImageDraw.ImageDraw, view: View, state: np.ndarray, size: np.ndarray, cyclist: bool) -> None:
    """A pedestrian as a disc, a cyclist as a slim box with a disc; both never too small to see."""
    if cyclist:
        draw.polygon(
            pixel_list(view, box_corners(state, np.maximum(size, (1.7, 0.5)), BOX)), fill=shade(VULNERABLE, 0.75)
        )
    disc(draw, view.place(state[:2]), max(0.45 * view.scale, 5), VULNERABLE, shade(VULNERABLE, 0.6))


def draw_trail(draw: ImageDraw.ImageDraw, view: View, path: np.ndarray, colour: str, width: float) -> None:
    """A path [k, 2] as a line that fades towards its beginning."""
    points = view.place(path)
    for index in range(len(points) - 1):
        share = (index + 1) / len(points)
        draw.line(
            [tuple(points[index]), tuple(points[index + 1])],
            fill=blend(colour, ROAD, 0.15 + 0.6 * share),
            width=max(2, round(width * view.scale * (0.4 + 0.6 * share))),
        )


def draw_contact(draw: ImageDraw.ImageDraw, view: View, point: np.ndarray, phase: float) -> None:
    """A dot at a point of contact and a ring around it; phase 0..1 widens the ring."""
    centre, unit = view.place(point), view.scale
    width = 0.34 - 0.18 * phase
    disc(draw, centre, (1.9 + 2.6 * phase + 0.12) * unit, None, "#ffffff", round((width + 0.24) * unit))
    disc(draw, centre, (1.9 + 2.6 * phase) * unit, None, CONTACT, max(2, round(width * unit)))
    disc(draw, centre, 0.5 * unit, CONTACT, "#ffffff", max(2, round(0.16 * unit)))


def disc(
    draw: ImageDraw.ImageDraw, centre: np.ndarray, radius: float, fill: str | None, outline: str, width: int = 2
) -> None:
    x, y = centre
    draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=fill, outline=outline, width=width)


def pixel_list(view: View, points: np.ndarray) -> list[tuple[float, float]]:
    return [tuple(point) for point in view.place(points).tolist()]


def rgb(colour: str) -> tuple[int, int, int]:
    return tuple(int(colour[start : start + 2], 16) for start in (1, 3, 5))


def blend(colour: str, ground: str, share: float) -> tuple[int, int, int]:
    """The colour laid over the ground with opacity `share`."""
    return tuple(round(share * top + (1 - share) * below) for top, below in zip(rgb(colour), rgb(ground), strict=True))


def shade(colour: str, share: float) -> tuple[int, int, int]:
    """The colour darkened to a share of its brightness."""
    return tuple(round(share * part) for part in rgb(colour))


def font(size: float) -> ImageFont.FreeTypeFont:
    """A font of a height in finished pixels."""
    return ImageFont.load_default(size=SUPERSAMPLING * size)


def save_picture(path: Path, picture: Image.Image) -> None:
    """Write a PNG, whole."""
    buffer = io.BytesIO()
    picture.save(buffer, "PNG", optimize=True)
    write_atomically(Path(path), buffer.getvalue())
