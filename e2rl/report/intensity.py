"""The intensity figure: one scene and seed at several intensities, each at its contact."""

import math
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from e2rl.report import drawing
from e2rl.report.picture import Replay
from e2rl.report.replay import load_replay

SIDE, METRES, GAP = 720, 60.0, 10  # of a panel in pixels and m, pixels between panels
ACROSS = 2  # panels beside each other


def intensity_figure(paths: Sequence[Path]) -> Image.Image:
    """A panel for each rollout file: at its contact, or, where there is none, when the first of the others' contacts
    at greater intensity happens (at the end where there is none)."""
    replays = [load_replay(path, METRES, SIDE) for path in paths]
    down = math.ceil(len(replays) / ACROSS)
    figure = Image.new("RGB", (ACROSS * (SIDE + GAP) - GAP, down * (SIDE + GAP) - GAP), drawing.PANEL)
    for index, replay in enumerate(replays):
        place = ((index % ACROSS) * (SIDE + GAP), (index // ACROSS) * (SIDE + GAP))
        figure.paste(panel(replay, replays[index + 1 :]), place)
    return figure


def panel(replay: Replay, stronger: Sequence[Replay]) -> Image.Image:
    if replay.contact is not None:
        return replay.picture(replay.contact, phase=0.25)
    contacts = [other.contact for other in stronger if other.contact is not None]
    return replay.picture(contacts[0] if contacts else replay.last)
