"""The intensity figure: one scene and seed at several intensities, each at its contact."""

import math
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from e2rl.report import drawing
from e2rl.report.replay import load_replay

SIDE, METRES, GAP = 720, 60.0, 10  # of a panel in pixels and m, pixels between panels
COLUMNS = 2


def intensity_figure(paths: Sequence[Path]) -> Image.Image:
    """A panel for each rollout file, in the order of intensity: the moment of its contact.

    A rollout without contact is shown when the next one that has a contact has it, else at its end.
    """
    replays = [load_replay(path, METRES, SIDE) for path in paths]
    rows = math.ceil(len(replays) / COLUMNS)
    figure = Image.new("RGB", (COLUMNS * (SIDE + GAP) - GAP, rows * (SIDE + GAP) - GAP), drawing.PANEL)
    for index, replay in enumerate(replays):
        row, column = divmod(index, COLUMNS)
        contacts = [other.contact for other in replays[index:] if other.contact is not None]
        phase = None if replay.contact is None else 0.25
        panel = replay.picture(contacts[0] if contacts else replay.last, phase)
        figure.paste(panel, (column * (SIDE + GAP), row * (SIDE + GAP)))
    return figure
