"""The intensity figure: one scene and seed at several intensities, each at its contact.

The rollouts shown in the intensity figure: one scene and seed at every eta.
"""

import math
from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from e2rl.evaluation.rollout_files import TABLE, read_rows
from e2rl.report.drawing import new_figure
from e2rl.report.picture import SIDE, Panel
from e2rl.report.videos import load_replay

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


def intensity_ladder(folder: Path) -> list[Path]:
    """The rollout files, by eta, of the one (method, scene, seed) of a run's folder that best shows the effect of eta:
    no contact at the lowest eta, contact at as many others as possible, earlier at greater eta, late at first."""
    groups: dict[tuple, list[dict]] = {}
    for row in read_rows(Path(folder) / TABLE):
        groups.setdefault((row["method"], row["ego_policy"], row["scene_id"], row["seed"]), []).append(row)
    ladders = [sorted(group, key=lambda row: row["eta"]) for group in groups.values()]
    most = max(map(len, ladders))
    best = max((ladder for ladder in ladders if len(ladder) == most), key=worth)
    return [Path(folder) / ROLLOUTS / rollout_name(row) for row in best]


def worth(ladder: Sequence[dict]) -> tuple[float, ...]:
    """Score of rows of rollouts by eta for `intensity_ladder`; greater is better."""
    times = [row["contact_time"] for row in ladder if row["cfr"] == 1]
    falls = sum(later < earlier for earlier, later in zip(times, times[1:], strict=False))
    found = [row["cfr"] == 1 for row in ladder]
    monotone = found == sorted(found)
    return (not found[0], monotone, len(times), falls, times[0] - times[-1] if times else -ladder[-1]["min_dtc"])
