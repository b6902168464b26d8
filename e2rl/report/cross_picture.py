"""The matrix of planners and attacks as a picture."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.patches import Rectangle

from e2rl.evaluation.transfer import REPLAY, Matrix
from e2rl.report import drawing
from e2rl.report.cross import percent

CELL = 90  # points
NAMES = 170  # points, beside and above the cells
EDGE = 14  # points, around them
LETTERS = 15  # points


def draw_matrix(path: Path, matrix: Matrix) -> None:
    """Write a picture of preventable failures in attacks that drive as they did: the
    redder, the more; framed where they are a planner's own."""
    names = [entry["name"] for entry in matrix.sets]
    shares = np.zeros((len(matrix.egos), len(names)))
    style: dict[str, Any] = {"fontsize": LETTERS, "color": drawing.INK}
    faint = style | {"color": drawing.MUTED}
    shape = (CELL * len(names), CELL * len(matrix.egos))
    width = NAMES + shape[0] + EDGE
    height = NAMES + shape[1] + EDGE
    figure = drawing.new_figure(width, height)
    axes = figure.add_axes(
        (NAMES / width, EDGE / height, shape[0] / width, shape[1] / height)
    )
    figure.text(EDGE / width, 1 - NAMES / height, "driven", **faint)
    figure.text(NAMES / width, 1 - 1.5 * EDGE / height, "attacks on", **faint)
    for row, ego in enumerate(matrix.egos):
        axes.text(-0.6, row, ego, ha="right", va="center", **style)
        for column, entry in enumerate(matrix.sets):
            rate = matrix.rate(REPLAY, entry["name"], ego, "preventable")
            shares[row, column] = rate["mean"]
            axes.text(column, row, percent(rate), ha="center", va="center", **style)
            if ego == entry["ego"]:
                corner = (column - 0.5, row - 0.5)
                frame = Rectangle(corner, 1, 1, fill=False, clip_on=False)
                frame.set(edgecolor=drawing.INK, linewidth=2.5)
                axes.add_patch(frame)
    for column, name in enumerate(names):
        axes.text(column - 0.1, -0.6, name, rotation=45, **style)
    colours = (drawing.PANEL, drawing.ADVERSARY)
    scale = LinearSegmentedColormap.from_list("share", colours)
    axes.imshow(shares, cmap=scale, vmin=0, vmax=1)
    axes.set(xticks=(), yticks=())
    axes.spines[:].set_visible(False)
    drawing.save_figure(path, figure)
