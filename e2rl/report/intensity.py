"""The intensity figure: one scene and seed at several intensities, each at its contact."""

import math
from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from e2rl.evaluation.rollout_files import TABLE, read_rows
from e2rl.report.drawing import new_figure
from e2rl.report.picture import SIDE, Panel, Replay
from e2rl.sim.rollout_file import Failure

METRES, GAP, COLUMNS = 60.0, 10, 2  # side of a panel in m, points between panels, panels in a row


def intensity_figure(sweep: Sequence[Failure]) -> Figure:
    """Returns a panel for each rollout, in the order of intensity, at the moment of its contact; one without contact is
    shown when the next one that has a contact has it, else at its end."""
    replays = [Replay(each.rollout, each.row, METRES) for each in sweep]
    sizes = COLUMNS, math.ceil(len(replays) / COLUMNS)
    figure = new_figure(*(count * (SIDE + GAP) - GAP for count in sizes))
    wide, high = ([SIDE, *[GAP, SIDE] * (count - 1)] for count in sizes)
    places = figure.add_gridspec(len(high), len(wide), width_ratios=wide, height_ratios=high)
    for index, replay in enumerate(replays):
        contacts = [other.contact for other in replays[index:] if other.contact is not None]
        phase = None if replay.contact is None else 0.25
        place = places[2 * (index // COLUMNS), 2 * (index % COLUMNS)]
        Panel(replay, figure.add_subfigure(place)).show(contacts[0] if contacts else replay.last, phase)
    return figure


def intensity_sweep(folder: Path) -> list[Failure]:
    """Returns the rollouts of `best_sweep` of a run's folder."""
    return [Failure.read(folder, row) for row in best_sweep(read_rows(Path(folder) / TABLE))]


def best_sweep(rows: Sequence[dict]) -> list[dict]:
    """Returns the rows, by eta, of the one (method, scene, seed) that best shows the effect of eta: no contact at the
    lowest eta, contact at as many others as possible, earlier at greater eta, late at first."""
    groups: dict[tuple, list[dict]] = {}
    for row in rows:
        groups.setdefault((row["method"], row["ego_policy"], row["scene_id"], row["seed"]), []).append(row)
    sweeps = [sorted(group, key=lambda row: row["eta"]) for group in groups.values()]
    most = max(map(len, sweeps))
    return max((sweep for sweep in sweeps if len(sweep) == most), key=worth)


def worth(sweep: Sequence[dict]) -> tuple[float, ...]:
    """Score of rows of rollouts by eta for `best_sweep`; greater is better."""
    times = [row["contact_time"] for row in sweep if row["cfr"] == 1]
    falls = sum(later < earlier for earlier, later in zip(times, times[1:], strict=False))
    found = [row["cfr"] == 1 for row in sweep]
    monotone = found == sorted(found)
    return (not found[0], monotone, len(times), falls, times[0] - times[-1] if times else -sweep[-1]["min_dtc"])
