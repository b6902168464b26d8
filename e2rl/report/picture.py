"""One rollout as pictures: any moment of it, and all frames of its replay; one scene at
several intensities."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from PIL import Image
from scipy.signal import savgol_filter
from tqdm import tqdm

from e2rl.evaluation.rollout_files import TABLE, read_rows
from e2rl.report import drawing
from e2rl.report.drawing import (
    Shape,
    TrafficMap,
    Trail,
    add_legend,
    image_of,
    new_figure,
)
from e2rl.scenes.boxes import corners, to_frame
from e2rl.sim.rollout_file import Failure, Rollout

TRAIL = 2.0  # s
SMOOTHING = 41  # steps over which the camera's path is smoothed
SLOW = 0.6  # s before contact that are played at half speed
FREEZE = 14  # frames that hold the contact
SIDE, HEAD, FOOT = 720, 50, 30  # points: of a picture, of its header and of its legend
LARGE_HEAD, LARGE_FOOT = 86, 48  # the same with large letters
SWEEP_METRES, SWEEP_GAP, SWEEP_COLUMNS = (
    60.0,
    10,
    2,
)  # side of a panel in m, points between panels, panels in a row
LEGEND = {
    "ego": drawing.EGO,
    "adversary": drawing.ADVERSARY,
    "traffic": drawing.BACKGROUND,
}
LEGEND |= {"replayed": drawing.REPLAYED, "pedestrian, cyclist": drawing.VULNERABLE}


@dataclass
class Replay:
    """The pictures of one rollout. `contact` is the step of the ego's first contact, or
    None; `last` is the last step shown: the contact, or the rollout's end.

    Args:
        rollout, row: the rollout and its row of metrics.
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

    def __post_init__(self):
        self.contact = (
            None
            if math.isnan(self.row["contact_step"])
            else int(self.row["contact_step"])
        )
        self.last = (
            len(self.rollout.states) - 1 if self.contact is None else self.contact
        )
        path = self.rollout.states[:, self.rollout.ego, :2]
        window = min(SMOOTHING, len(path))
        self.centres = savgol_filter(
            path, window, min(1, window - 1), axis=0
        )  # smoothed, so that the camera glides
        self.panel = Panel(self, new_figure(SIDE, SIDE, dpi=72 * self.pixels / SIDE))

    def picture(self, time: float, phase: float | None = None) -> Image.Image:
        """The moment at `time` [steps, fractions interpolate]; `phase` from 0 to 1
        marks the contact."""
        self.panel.show(time, phase)
        assert isinstance(self.panel.figure, Figure)
        return image_of(self.panel.figure)

    def frames(self) -> Iterator[Image.Image]:
        """All frames, drawn as they are asked for: real time, half speed just before
        contact, then the contact held."""
        if self.contact is None:
            times = list(range(self.last + 1))
        else:
            slow_from = max(0, self.contact - round(SLOW / self.rollout.dt))
            times = [*range(slow_from), *np.arange(slow_from, self.contact, 0.5)]
        yield from map(
            self.picture, tqdm(times, desc="frames", leave=False, disable=None)
        )
        if self.contact is not None:
            yield from (
                self.picture(self.contact, phase=(index % 7) / 6)
                for index in range(FREEZE)
            )

    def trails(self, time: float) -> list[Trail]:
        """The last two seconds of all agents that move, those of the adversaries and of
        the ego on top."""
        end = math.floor(time) + 1
        trails = []
        recent = slice(max(0, end - 1 - round(TRAIL / self.rollout.dt)), end)
        for agent in sorted(range(self.rollout.states.shape[1]), key=self.layer):
            path = self.rollout.states[recent, agent, :2][
                self.rollout.valid[recent, agent]
            ]
            if len(path) > 1 and np.ptp(path, axis=0).max() > 0.5:
                trails.append(
                    Trail(
                        path,
                        self.colour(agent),
                        width=0.5 if self.layer(agent) >= 2 else 0.3,
                    )
                )
        return trails

    def shapes(self, time: float, phase: float | None) -> list[Shape]:
        """All agents and the mark of contact, from the lowest to the highest."""
        rollout = self.rollout
        step = math.floor(time)
        shapes = []
        states = interpolated(rollout.states, rollout.valid, time=time)
        size = rollout.size
        for agent in sorted(
            np.flatnonzero(rollout.valid[step]).tolist(), key=self.layer
        ):
            shapes += drawing.agent(
                rollout.agent_type[agent],
                states[agent],
                size=size[agent],
                colour=self.colour(agent),
            )
        if phase is not None:
            shapes += drawing.contact_mark(
                contact_point(rollout, step, partner=self.row["partner"]), phase
            )
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
        others = (
            drawing.BACKGROUND if self.rollout.simulated[agent] else drawing.REPLAYED
        )
        return (others, drawing.VULNERABLE, drawing.ADVERSARY, drawing.EGO)[
            self.layer(agent)
        ]


class Panel:
    """A replay on a square figure of SIDE, with a header, a map and a legend; `show`
    moves it to another moment."""

    def __init__(self, replay: Replay, figure: Figure | SubFigure):
        self.replay = replay
        self.figure = figure
        rollout = replay.rollout
        large = replay.caption is not None
        head, foot = (LARGE_HEAD, LARGE_FOOT) if large else (HEAD, FOOT)
        title, detail = replay.caption or (
            f"{rollout.method}  vs  {rollout.ego_policy}",
            f"{shorten(rollout.scene_id)}   seed {rollout.seed}   intensity {rollout.eta:g}",
        )
        axes = self.figure.add_axes((0, foot / SIDE, 1, 1 - (head + foot) / SIDE))
        self.map = TrafficMap(axes, rollout, metres=replay.metres)
        first, second = (26, 20) if large else (16, 11)  # points, of the letters
        left = 14 / SIDE
        right = 706 / SIDE
        upper = 1 - 0.46 * head / SIDE
        lower = 1 - 0.82 * head / SIDE
        text = self.figure.text
        text(left, upper, title, fontsize=first, color=drawing.INK)
        text(left, lower, detail, fontsize=second, color=drawing.MUTED)
        self.clock = text(
            right, upper, "", fontsize=first, color=drawing.INK, ha="right"
        )
        self.speed = text(
            right, lower, "", fontsize=second, color=drawing.MUTED, ha="right"
        )
        box = {
            "boxstyle": "round,pad=0.5,rounding_size=1",
            "facecolor": drawing.CONTACT,
            "edgecolor": "none",
        }
        badge = (
            contact_text(replay.row)
            if large
            else f"{contact_text(replay.row)}\n{verdict_text(replay.row)}"
        )
        self.badge = text(
            0.5,
            1 - (head + 40) / SIDE,
            badge,
            fontsize=22 if large else 13,
            color="w",
            bbox=box,
        )
        self.badge.set(ha="center", va="center")
        add_legend(
            self.figure,
            dict(list(LEGEND.items())[:3]) if large else LEGEND,
            size=20 if large else 11,
        )
        bar = (right - 10 / replay.metres, right)
        self.figure.add_artist(
            Line2D(bar, (10 / SIDE, 10 / SIDE), color=drawing.INK, linewidth=2)
        )
        text(
            sum(bar) / 2,
            14 / SIDE,
            "10 m",
            fontsize=second - 1,
            color=drawing.MUTED,
            ha="center",
        )

    def show(self, time: float, phase: float | None) -> None:
        replay = self.replay
        rollout = self.replay.rollout
        centre = np.array(
            [
                np.interp(time, np.arange(len(replay.centres)), axis)
                for axis in replay.centres.T
            ]
        )
        self.map.show(centre, replay.trails(time), replay.shapes(time, phase))
        speed = interpolated(rollout.states, rollout.valid, time=time)[rollout.ego, 3]
        self.clock.set_text(f"{time * rollout.dt:.1f} s")
        self.speed.set_text(f"ego {speed:.1f} m/s")
        self.badge.set_visible(replay.contact is not None and time >= replay.contact)


def interpolated(states: np.ndarray, valid: np.ndarray, time: float) -> np.ndarray:
    """States [N, 4] at a fractional step; agents that are absent at the next step stay
    where they are."""
    low = math.floor(time)
    high = min(low + 1, len(states) - 1)
    change = states[high].astype(float) - states[low]
    change[:, 2] = (change[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return states[low] + np.where(valid[high, :, None], (time - low) * change, 0)


def contact_point(rollout: Rollout, step: int, partner: int) -> np.ndarray:
    """Where the ego and its partner touch [2] m: the mean of the corners that lie
    inside the other box, or, where there are none, the middle between the two centres.
    """
    pair = [rollout.ego, partner]
    pose = torch.tensor(rollout.states[step, pair]).double()
    size = torch.tensor(rollout.size[pair]).double()
    others = corners(pose, size).flip(0)
    inside = (to_frame(others, pose[:, None]).abs() <= size[:, None] / 2 + 1e-6).all(-1)
    return (others[inside] if inside.any() else pose[:, :2]).mean(0).numpy()


def contact_text(row: Mapping[str, Any]) -> str:
    return f"contact at {row['contact_time']:.1f} s: {row['contact_type']}, {row['relvel']:.1f} m/s"


def verdict_text(row: Mapping[str, Any]) -> str:
    """Whether the collision counts and why, and the duty that the partner broke."""
    reasons = {
        "ego's fault": row["at_fault"] == 1,
        "preventable": row["preventable"] == 1,
    }
    counts = ", ".join(name for name, holds in reasons.items() if holds)
    return f"{counts or 'does not count'}; {row['duty']}".replace(
        "; none", "; no duty broken"
    )


def shorten(name: str, limit: int = 42) -> str:
    return (
        name
        if len(name) <= limit
        else f"{name[: limit // 2 - 1]}…{name[-limit // 2 :]}"
    )


# --- one scene and seed at several intensities


def intensity_figure(sweep: Sequence[Failure]) -> Figure:
    """Returns a panel for each rollout, in the order of intensity, at the moment of its
    contact; one without contact is shown when the next one that has a contact has it,
    else at its end."""
    replays = [Replay(each.rollout, each.row, metres=SWEEP_METRES) for each in sweep]
    sizes = SWEEP_COLUMNS, math.ceil(len(replays) / SWEEP_COLUMNS)
    figure = new_figure(*(count * (SIDE + SWEEP_GAP) - SWEEP_GAP for count in sizes))
    wide, high = ([SIDE, *[SWEEP_GAP, SIDE] * (count - 1)] for count in sizes)
    places = figure.add_gridspec(
        len(high), len(wide), width_ratios=wide, height_ratios=high
    )
    for index, replay in enumerate(replays):
        contacts = [
            other.contact for other in replays[index:] if other.contact is not None
        ]
        phase = None if replay.contact is None else 0.25
        place = places[2 * (index // SWEEP_COLUMNS), 2 * (index % SWEEP_COLUMNS)]
        Panel(replay, figure.add_subfigure(place)).show(
            contacts[0] if contacts else replay.last, phase
        )
    return figure


def intensity_sweep(folder: Path) -> list[Failure]:
    """Returns the rollouts of `best_sweep` of a run's folder."""
    rows = [row for row in read_rows(Path(folder) / TABLE) if row["errored"] != 1]
    return [Failure.read(folder, row) for row in best_sweep(rows)]


def best_sweep(rows: Sequence[dict]) -> list[dict]:
    """Returns the rows, by eta, of the one (method, scene, seed) that best shows the
    effect of eta: no contact at the lowest eta, contact at as many others as possible,
    earlier at greater eta, late at first."""
    groups: dict[tuple, list[dict]] = {}
    for row in rows:
        groups.setdefault(
            (row["method"], row["ego_policy"], row["scene_id"], row["seed"]), []
        ).append(row)
    sweeps = [sorted(group, key=lambda row: row["eta"]) for group in groups.values()]
    most = max(map(len, sweeps))
    return max((sweep for sweep in sweeps if len(sweep) == most), key=worth)


def worth(sweep: Sequence[dict]) -> tuple[float, ...]:
    """Score of rows of rollouts by eta for `best_sweep`; greater is better."""
    times = [row["contact_time"] for row in sweep if row["cfr"] == 1]
    falls = sum(
        later < earlier for earlier, later in zip(times, times[1:], strict=False)
    )
    found = [row["cfr"] == 1 for row in sweep]
    monotone = found == sorted(found)
    return (
        not found[0],
        monotone,
        len(times),
        falls,
        times[0] - times[-1] if times else -sweep[-1]["min_dtc"],
    )
