"""One rollout as pictures: any moment of it, all frames of its replay, and a strip of four moments."""

import math
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw
from tqdm import tqdm

from e2rl.report import drawing
from e2rl.report.drawing import SUPERSAMPLING, RoadLayer, View

TRAIL = 2.0  # s
SLOW = 0.6  # s before contact that are played at half speed
FREEZE = 14  # frames that hold the contact
STRIP_TIMES = (-2.0, -1.0, -0.4, 0.0)  # s before contact
STRIP_PANEL = 420  # pixels


@dataclass
class Replay:
    """One rollout as read from its file, its row of metrics, and the picture's settings (side in metres and pixels)."""

    rollout: dict
    row: dict
    metres: float = 70.0
    pixels: int = 720
    ghost: bool = False

    def __post_init__(self):
        self.contact = None if math.isnan(self.row["contact_step"]) else int(self.row["contact_step"])
        self.last = len(self.rollout["states"]) - 1 if self.contact is None else self.contact
        self.centres = camera_path(self.rollout["states"][:, self.rollout["ego"], :2])
        self.road = RoadLayer(self.rollout, self.centres[: self.last + 1], self.metres, self.pixels)

    def picture(self, time: float, phase: float | None = None, caption: bool = True) -> Image.Image:
        """The moment at `time` [steps, fractions interpolate]; `phase` 0..1 marks the contact."""
        view = View(tuple(at(self.centres, time)), self.metres, self.pixels)
        image = self.road.window(view)
        draw = ImageDraw.Draw(image)
        self.draw_trails(draw, view, time)
        self.draw_agents(draw, view, time)
        if phase is not None:
            drawing.draw_contact(draw, view, contact_point(self.rollout, self.contact, self.row["partner"]), phase)
        if caption:
            self.draw_header(draw, time)
            draw_legend(draw, self.pixels, view.scale, self.ghost)
        return image.reduce(SUPERSAMPLING)

    def draw_trails(self, draw: ImageDraw.ImageDraw, view: View, time: float) -> None:
        """The last two seconds of all that move, the others' below the adversaries' and the ego's."""
        end = math.floor(time)
        begin = max(0, end - round(TRAIL / self.rollout["dt"]))
        for agent in sorted(range(self.rollout["states"].shape[1]), key=self.layer):
            steps = [step for step in range(begin, end + 1) if self.rollout["valid"][step, agent]]
            path = self.rollout["states"][steps, agent, :2]
            if len(path) > 1 and np.ptp(path, axis=0).max() > 0.5:
                width = 0.5 if self.layer(agent) >= 2 else 0.3
                drawing.draw_trail(draw, view, path, self.colour(agent), width)

    def draw_agents(self, draw: ImageDraw.ImageDraw, view: View, time: float) -> None:
        rollout, step = self.rollout, math.floor(time)
        states = interpolated(rollout["states"], rollout["valid"], time)
        if self.ghost and rollout["logged_valid"][step, rollout["ego"]]:
            logged = interpolated(rollout["logged"], rollout["logged_valid"], time)
            drawing.draw_outline(draw, view, logged[rollout["ego"]], rollout["size"][rollout["ego"]], drawing.EGO)
        for agent in sorted(np.flatnonzero(rollout["valid"][step]), key=self.layer):
            kind, size = rollout["agent_type"][agent], rollout["size"][agent]
            if kind in ("pedestrian", "cyclist"):
                drawing.draw_vulnerable(draw, view, states[agent], size, kind == "cyclist")
            else:
                drawing.draw_vehicle(draw, view, states[agent], size, self.colour(agent))

    def layer(self, agent: int) -> int:
        """What is drawn later lies on top: others, pedestrians and cyclists, adversaries, the ego."""
        if agent == self.rollout["ego"]:
            return 3
        if self.rollout["adversaries"][agent]:
            return 2
        return int(self.rollout["agent_type"][agent] in ("pedestrian", "cyclist"))

    def colour(self, agent: int) -> str:
        kinds = (
            drawing.BACKGROUND if self.rollout["simulated"][agent] else drawing.REPLAYED,
            drawing.VULNERABLE,
            drawing.ADVERSARY,
            drawing.EGO,
        )
        return kinds[self.layer(agent)]

    def draw_header(self, draw: ImageDraw.ImageDraw, time: float) -> None:
        """What is shown on the left, the time and the ego's speed on the right, the contact beneath."""
        rollout, unit = self.rollout, SUPERSAMPLING
        side = self.pixels * unit
        draw.rectangle((0, 0, side, 50 * unit), fill=drawing.PANEL)
        title = f"{rollout['method']}  vs  {rollout['ego_policy']}"
        draw.text((14 * unit, 6 * unit), title, font=drawing.font(17), fill=drawing.INK)
        detail = f"{shorten(rollout['scene_id'])}   seed {rollout['seed']}   intensity {rollout['eta']:g}"
        draw.text((14 * unit, 29 * unit), detail, font=drawing.font(12), fill=drawing.MUTED)
        clock = f"{time * rollout['dt']:.1f} s"
        draw.text((side - 14 * unit, 6 * unit), clock, font=drawing.font(17), fill=drawing.INK, anchor="ra")
        speed = interpolated(rollout["states"], rollout["valid"], time)[rollout["ego"], 3]
        draw.text(
            (side - 14 * unit, 29 * unit),
            f"ego {speed:.1f} m/s",
            font=drawing.font(12),
            fill=drawing.MUTED,
            anchor="ra",
        )
        if self.contact is not None and time >= self.contact:
            draw_badge(draw, side / 2, 64 * unit, contact_text(self.row))

    def frames(self) -> list[Image.Image]:
        """All frames: real time, half speed just before contact, then the contact held."""
        times = list(range(self.last + 1))
        if self.contact is not None:
            slow_from = max(0, self.contact - round(SLOW / self.rollout["dt"]))
            times = times[:slow_from] + [slow_from + half / 2 for half in range(2 * (self.contact - slow_from))]
        pictures = [self.picture(time) for time in tqdm(times, desc="frames", leave=False, disable=None)]
        if self.contact is not None:
            pictures += [self.picture(self.contact, phase=(index % 7) / 6) for index in range(FREEZE)]
        return pictures

    def strip(self) -> Image.Image:
        """Four moments side by side: before and at contact, or spread over the rollout where there is none."""
        whole = self.rollout["dt"]
        if self.contact is None:
            times = [self.last * share for share in (0, 1 / 3, 2 / 3, 1)]
        else:
            times = [max(0.0, self.contact + before / whole) for before in STRIP_TIMES]
        gap, label = 8, 34
        strip = Image.new("RGB", (4 * STRIP_PANEL + 3 * gap, STRIP_PANEL + label), drawing.PANEL)
        for index, time in enumerate(times):
            mark = 0.25 if self.contact is not None and time == self.contact else None
            panel = self.picture(time, phase=mark, caption=False).resize((STRIP_PANEL,) * 2, Image.Resampling.LANCZOS)
            left = index * (STRIP_PANEL + gap)
            strip.paste(panel, (left, label))
            text = f"{time * whole:.1f} s" + (f"   {contact_text(self.row)}" if mark is not None else "")
            draw_small(strip, (left + 4, 6), text, drawing.CONTACT if mark is not None else drawing.INK)
        return strip


def camera_path(path: np.ndarray, smoothing: float = 8.0) -> np.ndarray:
    """Window centres [T+1, 2]: the ego's way [T+1, 2], smoothed, so that the picture glides."""
    reach = int(3 * smoothing)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / smoothing) ** 2)
    padded = (
        np.pad(np.asarray(path, float), ((reach, reach), (0, 0)), mode="reflect", reflect_type="odd")
        if len(path) > reach
        else np.pad(np.asarray(path, float), ((reach, reach), (0, 0)), mode="edge")
    )
    return np.stack([np.convolve(padded[:, axis], kernel / kernel.sum(), "valid") for axis in range(2)], -1)


def at(values: np.ndarray, time: float) -> np.ndarray:
    """values [T+1, ...] at a fractional step."""
    low = min(math.floor(time), len(values) - 1)
    high = min(low + 1, len(values) - 1)
    return values[low] + (time - low) * (values[high] - values[low])


def interpolated(states: np.ndarray, valid: np.ndarray, time: float) -> np.ndarray:
    """States [N, 4] at a fractional step; agents absent at the next step stay where they are."""
    low = math.floor(time)
    high = min(low + 1, len(states) - 1)
    change = states[high].astype(float) - states[low]
    change[:, 2] = (change[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return states[low] + np.where(valid[high, :, None], (time - low) * change, 0)


def contact_point(rollout: dict, step: int, partner: int) -> np.ndarray:
    """Where the ego and its partner touch: the mean of the corners that lie inside the other box, else between them."""
    pair = [(rollout["states"][step, agent], rollout["size"][agent]) for agent in (rollout["ego"], partner)]
    inside = []
    for (state, size), (other, other_size) in (pair, pair[::-1]):
        corners = drawing.box_corners(state, size, drawing.BOX)
        cos, sin = math.cos(other[2]), math.sin(other[2])
        local = np.abs((corners - other[:2]) @ np.array([[cos, -sin], [sin, cos]]))
        inside.append(corners[(local <= np.asarray(other_size) / 2 + 1e-6).all(-1)])
    corners = np.concatenate(inside)
    return corners.mean(0) if len(corners) else (pair[0][0][:2] + pair[1][0][:2]) / 2


def contact_text(row: dict) -> str:
    return f"contact at {row['contact_time']:.1f} s: {row['contact_type']}, {row['relvel']:.1f} m/s"


def draw_badge(draw: ImageDraw.ImageDraw, x: float, y: float, text: str) -> None:
    """White text on a rounded panel, centred at x, its top at y."""
    face, pad = drawing.font(14), 10 * SUPERSAMPLING
    width = draw.textlength(text, font=face)
    box = (x - width / 2 - pad, y, x + width / 2 + pad, y + 28 * SUPERSAMPLING)
    draw.rounded_rectangle(box, radius=14 * SUPERSAMPLING, fill=drawing.CONTACT)
    draw.text((x, y + 14 * SUPERSAMPLING), text, font=face, fill="#ffffff", anchor="mm")


def draw_legend(draw: ImageDraw.ImageDraw, pixels: int, scale: float, ghost: bool) -> None:
    """Colours on the left, a 10 m bar on the right, along the lower edge."""
    unit, side = SUPERSAMPLING, pixels * SUPERSAMPLING
    top, x, face = side - 30 * unit, 14 * unit, drawing.font(12)
    draw.rectangle((0, top, side, side), fill=drawing.PANEL)
    entries = [
        ("ego", drawing.EGO),
        ("adversary", drawing.ADVERSARY),
        ("traffic", drawing.BACKGROUND),
        ("pedestrian, cyclist", drawing.VULNERABLE),
    ]
    for name, colour in entries + ([("ego as recorded", None)] if ghost else []):
        swatch = (x, top + 9 * unit, x + 18 * unit, top + 21 * unit)
        draw.rounded_rectangle(swatch, radius=3 * unit, fill=colour, outline=colour or drawing.EGO, width=2 * unit)
        draw.text((x + 24 * unit, top + 15 * unit), name, font=face, fill=drawing.INK, anchor="lm")
        x += 24 * unit + draw.textlength(name, font=face) + 18 * unit
    right, middle = side - 14 * unit, top + 15 * unit
    draw.line((right - 10 * scale, middle + 5 * unit, right, middle + 5 * unit), fill=drawing.INK, width=2 * unit)
    draw.text((right - 5 * scale, middle + 1 * unit), "10 m", font=drawing.font(11), fill=drawing.MUTED, anchor="md")


def draw_small(image: Image.Image, corner: tuple[int, int], text: str, colour: str) -> None:
    """Text with its upper left corner in finished pixels."""
    ImageDraw.Draw(image).text(corner, text, font=drawing.font(17 / SUPERSAMPLING), fill=colour)


def shorten(name: str, limit: int = 42) -> str:
    return name if len(name) <= limit else f"{name[: limit // 2 - 1]}…{name[-limit // 2 :]}"
