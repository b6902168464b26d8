"""One rollout as pictures: any moment of it, and all frames of its replay."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image
from tqdm import tqdm

from e2rl.report import drawing
from e2rl.report.drawing import (
    Shape,
    TrafficMap,
    Trail,
    add_legend,
    image_of,
    new_figure,
)
from e2rl.report.failure_tracks import contact_point
from e2rl.sim.rollout_file import Rollout

TRAIL = 2.0  # s
SMOOTHING = 41  # steps over which the camera's path is smoothed
SLOW = 0.6  # s before contact that are played at half speed
FREEZE = 14  # frames that hold the contact
SIDE = 720  # points, of a picture
LEGEND = {
    "ego": drawing.EGO,
    "adversary": drawing.ADVERSARY,
    "traffic": drawing.BACKGROUND,
    "replayed": drawing.REPLAYED,
    "pedestrian, cyclist": drawing.VULNERABLE,
}


@dataclass(frozen=True)
class Letters:
    """Sizes in points: of the header, the legend's foot, and letters."""

    head: float
    foot: float
    title: float
    detail: float
    badge: float
    legend: float


SMALL = Letters(head=50, foot=30, title=16, detail=11, badge=13, legend=11)
LARGE = Letters(head=86, foot=48, title=26, detail=20, badge=22, legend=20)


@dataclass
class Replay:
    """The pictures of one rollout. `contact` is the step of the ego's first contact, or
    None; `last` is the last step shown: the contact, or the rollout's end.

    Args:
        rollout: what is shown.
        row: its row of metrics.
        metres: side of the square that is shown.
        pixels: side of a picture.
        caption: two lines to show in large letters; by default the method, ego, scene,
            seed and intensity.
    """

    rollout: Rollout
    row: Mapping[str, Any]
    metres: float = 70.0
    pixels: int = 720
    caption: tuple[str, str] | None = None

    def __post_init__(self) -> None:
        from scipy.signal import savgol_filter  # loads all of scipy, for half a second

        step = self.row["contact_step"]
        self.contact = None if math.isnan(step) else int(step)
        self.last = len(self.rollout.states) - 1
        if self.contact is not None:
            self.last = self.contact
        path = self.rollout.states[:, self.rollout.ego, :2]
        window = min(SMOOTHING, len(path))
        self.centres = savgol_filter(path, window, min(1, window - 1), axis=0)
        self.panel = Panel(self, new_figure(SIDE, SIDE, dpi=72 * self.pixels / SIDE))

    def picture(self, time: float, phase: float | None = None) -> Image.Image:
        """The moment at `time` [steps, fractions interpolate]; `phase` from 0 to 1
        marks the contact."""
        self.panel.show(time, phase)
        return image_of(self.panel.figure)

    def frames(self) -> Iterator[Image.Image]:
        """All frames, drawn as they are asked for: real time, half speed just before
        contact, then the contact held."""
        times: list[float] = list(range(self.last + 1))
        if self.contact is not None:
            slow = max(0, self.contact - round(SLOW / self.rollout.dt))
            times[slow:] = np.arange(slow, self.contact, 0.5).tolist()
        for time in tqdm(times, desc="frames", leave=False, disable=None):
            yield self.picture(time)
        if self.contact is not None:
            for index in range(FREEZE):
                yield self.picture(self.contact, phase=(index % 7) / 6)

    def trails(self, time: float) -> list[Trail]:
        """The last two seconds of all agents that move, those of the adversaries and of
        the ego on top."""
        rollout = self.rollout
        step = math.floor(time)
        recent = slice(max(0, step - round(TRAIL / rollout.dt)), step + 1)
        trails = []
        for agent in sorted(range(rollout.states.shape[1]), key=self.layer):
            path = rollout.states[recent, agent, :2][rollout.valid[recent, agent]]
            if len(path) > 1 and np.ptp(path, axis=0).max() > 0.5:
                width = 0.5 if self.layer(agent) >= 2 else 0.3
                trails.append(Trail(path, self.colour(agent), width=width))
        return trails

    def shapes(self, time: float, phase: float | None) -> list[Shape]:
        """All agents and the mark of contact, from the lowest to the highest."""
        rollout = self.rollout
        step = math.floor(time)
        states = interpolated(rollout, time)
        shapes = []
        for agent in sorted(
            np.flatnonzero(rollout.valid[step]).tolist(), key=self.layer
        ):
            shapes += drawing.agent(
                rollout.agent_type[agent],
                states[agent],
                size=rollout.size[agent],
                colour=self.colour(agent),
            )
        if phase is not None:
            point = contact_point(rollout, step, partner=self.row["partner"])
            shapes += drawing.contact_mark(point, phase)
        return shapes

    def layer(self, agent: int) -> int:
        """Higher layers lie on top: 0 other vehicles, 1 pedestrians and cyclists, 2
        adversaries, 3 the ego."""
        if agent == self.rollout.ego:
            return 3
        if self.rollout.adversaries[agent]:
            return 2
        return int(self.rollout.agent_type[agent] in ("pedestrian", "cyclist"))

    def colour(self, agent: int) -> str:
        simulated = self.rollout.simulated[agent]
        return (
            drawing.BACKGROUND if simulated else drawing.REPLAYED,
            drawing.VULNERABLE,
            drawing.ADVERSARY,
            drawing.EGO,
        )[self.layer(agent)]


class Panel:
    """A replay on a square figure of SIDE, with a header, a map and a legend; `show`
    moves it to another moment."""

    def __init__(self, replay: Replay, figure: Figure) -> None:
        self.replay = replay
        self.figure = figure
        rollout = replay.rollout
        letters = SMALL
        title = f"{rollout.method}  vs  {rollout.ego_policy}"
        detail = f"{shorten(rollout.scene_id)}   seed {rollout.seed}   "
        detail += f"intensity {rollout.eta:g}"
        badge = f"{contact_text(replay.row)}\n{verdict_text(replay.row)}"
        legend = LEGEND
        if replay.caption:
            letters = LARGE
            title, detail = replay.caption
            badge = contact_text(replay.row)
            legend = dict(list(LEGEND.items())[:3])
        head = letters.head / SIDE
        foot = letters.foot / SIDE
        axes = figure.add_axes((0, foot, 1, 1 - head - foot))
        self.map = TrafficMap(axes, rollout, metres=replay.metres)
        left = 14 / SIDE
        right = 706 / SIDE
        first: dict[str, Any] = {
            "y": 1 - 0.46 * head,
            "fontsize": letters.title,
            "color": drawing.INK,
        }
        second: dict[str, Any] = {
            "y": 1 - 0.82 * head,
            "fontsize": letters.detail,
            "color": drawing.MUTED,
        }
        figure.text(left, s=title, **first)
        figure.text(left, s=detail, **second)
        self.clock = figure.text(right, s="", ha="right", **first)
        self.speed = figure.text(right, s="", ha="right", **second)
        box = {
            "boxstyle": "round,pad=0.5,rounding_size=1",
            "facecolor": drawing.CONTACT,
            "edgecolor": "none",
        }
        self.badge = figure.text(
            0.5,
            1 - head - 40 / SIDE,
            badge,
            fontsize=letters.badge,
            color="w",
            bbox=box,
            ha="center",
            va="center",
        )
        add_legend(figure, legend, size=letters.legend)
        bar = (right - 10 / replay.metres, right)
        figure.add_artist(
            Line2D(bar, (10 / SIDE, 10 / SIDE), color=drawing.INK, linewidth=2)
        )
        second |= {"y": 14 / SIDE, "fontsize": letters.detail - 1}
        figure.text(sum(bar) / 2, s="10 m", ha="center", **second)

    def show(self, time: float, phase: float | None) -> None:
        replay = self.replay
        rollout = replay.rollout
        steps = np.arange(len(replay.centres))
        centre = np.array([np.interp(time, steps, axis) for axis in replay.centres.T])
        self.map.show(centre, replay.trails(time), replay.shapes(time, phase))
        self.clock.set_text(f"{time * rollout.dt:.1f} s")
        self.speed.set_text(
            f"ego {interpolated(rollout, time)[rollout.ego, 3]:.1f} m/s"
        )
        self.badge.set_visible(replay.contact is not None and time >= replay.contact)


def interpolated(rollout: Rollout, time: float) -> np.ndarray:
    """States [N, 4] at a fractional step; agents that are absent at the next step stay
    where they are."""
    states = rollout.states
    low = math.floor(time)
    high = min(low + 1, len(states) - 1)
    change = states[high].astype(float) - states[low]
    change[:, 2] = (change[:, 2] + np.pi) % (2 * np.pi) - np.pi
    stays = ~rollout.valid[high, :, None]
    return states[low] + np.where(stays, 0, (time - low) * change)


def contact_text(row: Mapping[str, Any]) -> str:
    return (
        f"contact at {row['contact_time']:.1f} s: {row['contact_type']}, "
        f"{row['relvel']:.1f} m/s"
    )


def verdict_text(row: Mapping[str, Any]) -> str:
    """Whether the collision counts and why, and the duty that the partner broke."""
    reasons = {"ego's fault": row["at_fault"], "preventable": row["preventable"]}
    counts = ", ".join(name for name, holds in reasons.items() if holds == 1)
    duty = "no duty broken" if row["duty"] == "none" else row["duty"]
    return f"{counts or 'does not count'}; {duty}"


def shorten(name: str, limit: int = 42) -> str:
    if len(name) <= limit:
        return name
    return f"{name[: limit // 2 - 1]}…{name[-limit // 2 :]}"
