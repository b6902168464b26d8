"""A heat map of what a curriculum chose.

Rounds run to the right, the arms (intensity within causal template) upwards. Left: the
fraction of a round's draws; right: the fraction of the policy's episodes in these
attacks that failed.
"""

import csv
import math
import os
from collections.abc import Mapping, Sequence
from itertools import islice
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from e2rl.evaluation.rollout_files import MOST_ROWS, cause, opened
from e2rl.report import drawing
from e2rl.report.drawing import new_figure, save_figure
from e2rl.run.errors import InputError
from e2rl.run.files import CsvReader
from e2rl.traffic.traffic import TEMPLATES

CHOICES, PICTURE = "curriculum.csv", "curriculum.png"  # of a run's folder
Choice = Mapping[str, float | str]  # a row of curriculum.csv
TEXT = "template"
NEEDED = ("round", "eta", "template", "draws", "episodes", "failures")
LINE, MARGIN, WIDTH, DPI = (
    14,
    90,
    900,
    144,
)  # points: a line of an arm, the space around them, the width
PANELS = (
    ("fraction of the round's draws", "viridis"),
    ("fraction of failed episodes", "magma"),
)


def grids(
    rows: Sequence[Choice],
) -> tuple[list[int], list[tuple[str, float]], np.ndarray, np.ndarray]:
    """Rounds [R], arms [A] as (template, eta), and by arm and round the fraction of the
    round's draws and the fraction of failed episodes, both [A, R]; NaN where nobody was
    drawn, or no episode driven."""
    rounds = sorted({int(row["round"]) for row in rows})
    found = {(str(row["template"]), float(row["eta"])) for row in rows}
    arms = sorted(found, key=lambda arm: (TEMPLATES.index(arm[0]), arm[1]))
    draws, episodes, failures = np.zeros((3, len(arms), len(rounds)))
    for row in rows:
        at = (
            arms.index((str(row["template"]), float(row["eta"]))),
            rounds.index(int(row["round"])),
        )
        for table, name in (
            (draws, "draws"),
            (episodes, "episodes"),
            (failures, "failures"),
        ):
            table[at] = float(row[name])
    drawn = draws / draws.sum(0, keepdims=True).clip(min=1)
    rate = np.where(episodes > 0, failures / episodes.clip(min=1), np.nan)
    return rounds, arms, np.where(draws > 0, drawn, np.nan), rate


def choice_map(rows: Sequence[Choice]) -> Figure:
    """The heat map of a table of choices."""
    rounds, arms, *tables = grids(rows)
    figure = new_figure(WIDTH, MARGIN + LINE * max(len(arms), 6), dpi=DPI)
    figure.set_layout_engine("constrained")
    panels = list(figure.subplots(1, len(PANELS), sharey=True))
    for axes, table, (title, colours) in zip(panels, tables, PANELS, strict=True):
        axes.set_facecolor(drawing.GROUND)
        edges = np.arange(len(rounds) + 1) - 0.5, np.arange(len(arms) + 1) - 0.5
        top = 1.0 if table is tables[1] else max(np.nanmax(table, initial=0), 1e-6)
        mesh = axes.pcolormesh(
            *edges, np.ma.masked_invalid(table), cmap=colours, vmin=0, vmax=top
        )
        figure.colorbar(mesh, ax=axes)
        axes.set_title(title, fontsize=10)
        _label(axes, rounds, arms=arms)
    panels[0].set_ylabel("causal template, η")
    return figure


def _label(
    axes: Axes, rounds: Sequence[int], arms: Sequence[tuple[str, float]]
) -> None:
    """Names of the arms, at most a dozen rounds, and a line between templates."""
    shown = range(0, len(rounds), -(-len(rounds) // 12))
    axes.set_xticks(list(shown), [str(rounds[k]) for k in shown])
    axes.set_yticks(
        range(len(arms)), [f"{name} {eta:g}" for name, eta in arms], fontsize=7
    )
    axes.set_xlabel("round")
    for k in range(1, len(arms)):
        if arms[k][0] != arms[k - 1][0]:
            axes.axhline(k - 0.5, color=drawing.INK, linewidth=0.8)


def read_choices(path: Path) -> list[Choice]:
    """The columns NEEDED of a curriculum.csv, finite numbers but for the template;
    InputError where it is none."""
    try:
        with opened(path) as file:
            rows = list(islice(CsvReader(file), MOST_ROWS))
        if not {row[TEXT] for row in rows} <= set(TEMPLATES):
            raise ValueError("a template")
        numbers = [
            {name: float(row[name]) for name in NEEDED if name != TEXT} for row in rows
        ]
        if not all(math.isfinite(value) for row in numbers for value in row.values()):
            raise ValueError("an infinite number")
        return [
            {TEXT: row[TEXT], **own} for row, own in zip(rows, numbers, strict=True)
        ]
    except (OSError, KeyError, ValueError, TypeError, csv.Error) as error:
        raise InputError(
            f"{path}: no table of a curriculum's choices ({cause(error)}); remove it"
        ) from None


def draw_choices(folder: Path) -> Path | None:
    """Draw curriculum.png and .pdf from the curriculum.csv of a run's folder; returns
    the picture, None where the run has logged none."""
    rows = read_choices(folder / CHOICES) if os.path.lexists(folder / CHOICES) else []
    if not rows:
        return None
    save_figure(folder / PICTURE, choice_map(rows))
    return folder / PICTURE
