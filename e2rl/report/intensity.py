"""The intensity figure: one scene and seed at several intensities, each at its contact."""

import math
from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from e2rl.report.drawing import new_figure
from e2rl.report.picture import SIDE, Panel
from e2rl.report.replay import load_replay

METRES, GAP = 60.0, 10  # side of a panel in m, points between panels
COLUMNS = 2


def intensity_figure(paths: Sequence[Path]) -> Figure:
    """A panel for each rollout file, in the order of intensity: the moment of its contact.

    A rollout without contact is shown when the next one that has a contact has it, else at its end.
    """
    replays = [load_replay(path, METRES) for path in paths]
    rows = math.ceil(len(replays) / COLUMNS)
    figure = new_figure(*(count * (SIDE + GAP) - GAP for count in (COLUMNS, rows)))
    wide, high = ([SIDE, *[GAP, SIDE] * (count - 1)] for count in (COLUMNS, rows))
    places = figure.add_gridspec(len(high), len(wide), width_ratios=wide, height_ratios=high)
    for index, replay in enumerate(replays):
        contacts = [other.contact for other in replays[index:] if other.contact is not None]
        phase = None if replay.contact is None else 0.25
        place = places[2 * (index // COLUMNS), 2 * (index % COLUMNS)]
        Panel(replay, figure.add_subfigure(place)).show(contacts[0] if contacts else replay.last, phase)
    return figure
