"""What a data set holds: its scenes, agents and maps, what is left out and why; and a
picture of a scene.

`e2rl inspect PATH` finds out which data group reads the files at PATH; `--data` names
it. `--apart OTHER` also checks that no scene at PATH is at a place of the logs at
OTHER, as a split needs it.
"""

import argparse
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from tensordict import TensorDict

from e2rl.report import drawing
from e2rl.report.drawing import TrafficMap, Trail, new_figure, save_figure
from e2rl.run.endings import ending
from e2rl.run.errors import InputError
from e2rl.scenes.content import Content, Scene, content
from e2rl.scenes.recording import (
    AGENT_TYPES,
    LIGHT_GREEN,
    LIGHT_RED,
    LIGHT_UNKNOWN,
    LIGHT_YELLOW,
)
from e2rl.scenes.source import Row, Source, open_source
from e2rl.sim.rollouts import road_of

SIDE = 900  # points, of a picture
HEAD = 34  # points, of its header
FOOT = 30  # points, of its legend
COLOURS = {
    "vehicle": drawing.BACKGROUND,
    "pedestrian": drawing.VULNERABLE,
    "cyclist": drawing.VULNERABLE,
}
LIGHTS = {
    LIGHT_UNKNOWN: drawing.MUTED,
    LIGHT_RED: "#d62828",
    LIGHT_YELLOW: "#f2b705",
    LIGHT_GREEN: "#2a9d4a",
}
LEGEND = {
    "ego": drawing.EGO,
    "vehicle": drawing.BACKGROUND,
    "pedestrian, cyclist": drawing.VULNERABLE,
}
MOST_LIMITS = 8  # values of speed limits that are told
TENTHS = (  # told to one decimal
    "median length of vehicles, m",
    "speed of the ego at the start, m/s",
    "km of lanes",
)


def limits_line(contents: Sequence[Content]) -> str:
    """The line of the speed limits on the routes of all scenes, the most frequent ones
    first."""
    total = sum((content.limits for content in contents), Counter())
    values = [
        f"{value or 'unknown'} {100 * count / total.total():.0f}%"
        for value, count in total.most_common(MOST_LIMITS)
    ]
    if len(total) > len(values):
        values.append(f"and {len(total) - len(values)} others")
    return f"limits       km/h on the routes: {', '.join(values)}"


def report(
    source: Source,
    rows: Sequence[Row],
    contents: Sequence[Content],
) -> list[str]:
    """The lines about a data set: `rows` of all its logs, `contents` of those that made
    a scene."""
    scenes = [row for row in rows if not row.reason]
    reasons = Counter(row.reason for row in rows if row.reason)
    repairs = sum((row.repairs for row in rows), Counter())
    places = {row.location for row in scenes}
    of = "places not known" if places == {""} else f"of {len(places)} places"
    lines = [
        f"logs         {len(source.logs())}",
        f"scenes       {len(scenes)}, {of}",
        f"left out     {reasons.total()}",
        *(
            f"             {count} x {reason}"
            for reason, count in reasons.most_common()
        ),
        *(f"mended       {count} {phrase}" for phrase, count in repairs.most_common()),
    ]
    if not contents:
        return lines
    about = "of the agents that take part, those present at the start frame"
    lines.append(limits_line(contents))
    lines.append(f"in a scene   median (least to most); {about}")
    for name in contents[0].counts:
        values = [float(content.counts[name]) for content in contents]
        digits = 1 if name in TENTHS else 0
        middle, low, high = (
            f"{value:.{digits}f}"
            for value in (np.median(values), min(values), max(values))
        )
        lines.append(f"  {name:<36}{middle:>8} ({low} to {high})")
    return lines


def picture(scene: Scene, title: str, metres: float) -> Figure:
    """A picture of a scene at its start frame, `metres` wide, with the recorded paths
    of its agents, which fade towards the start frame; the ego lies on top."""
    height = SIDE + HEAD + FOOT
    figure = new_figure(SIDE, height)
    axes = figure.add_axes((0, FOOT / height, 1, SIDE / height))
    figure.text(14 / SIDE, 1 - 22 / height, title, fontsize=13, color=drawing.INK)
    drawing.add_legend(figure, LEGEND, size=11)
    lights = zip(scene["light_points"], scene["light_state"][0].tolist(), strict=True)
    shapes = [
        drawing.disc(point, 0.7, fill=LIGHTS[state], edge=drawing.INK)
        for point, state in lights
    ]
    trails = []
    for agent in np.flatnonzero(scene["valid"])[::-1]:
        kind = AGENT_TYPES[scene["agent_type"][agent]]
        colour = COLOURS.get(kind, drawing.REPLAYED) if agent else drawing.EGO
        path = scene["logged"][scene["logged_valid"][:, agent], agent, :2]
        if len(path) > 1:
            trails.append(Trail(path, colour, width=0.4))
        shapes += drawing.agent(
            kind,
            scene["start"][agent],
            size=scene["size"][agent],
            colour=colour,
        )
    area = TrafficMap(axes, road_of(TensorDict(scene)), metres=metres)
    area.show(scene["start"][0, :2], trails, shapes)
    return figure


def inspect(
    source: Source, chosen: str | None
) -> tuple[list[Row], list[Content], Row | None]:
    """Returns all rows of a source without their scenes, the contents of its scenes,
    and the row to draw.

    That is the scene `chosen`, by default the first; None where no log makes a scene.
    Raises InputError where there is no such scene.
    """
    rows = []
    contents = []
    drawn = None
    with closing(source.rows()) as every:
        for row in every:
            rows.append(row._replace(scene=None))
            if row.scene is None:
                continue
            contents.append(content(row.scene))
            if drawn is None and chosen in (None, row.scene_id):
                drawn = row
    if drawn is None and contents:
        example = next(row.scene_id for row in rows if not row.reason)
        raise InputError(
            f"--scene={chosen}: name a scene of {source.path}, such as {example}"
        )
    return rows, contents, drawn


def check_apart(rows: Sequence[Row], source: Source, other: Source) -> str:
    """Returns a line on the places of the scenes `rows` of a source and of another's
    recordings.

    Raises InputError where they share some, or where a place is not known.
    """
    places = {row.location for row in rows if not row.reason}
    others = {recording.location for recording in other.recordings()}
    for path, locations in ((source.path, places), (other.path, others)):
        if "" in locations:
            raise InputError(
                f"{path}: the place of some logs is not known; name it in index.csv "
                "(docs/guide/data.md)"
            )
    if shared := sorted(places & others):
        common = f"{len(shared)} places in common ({', '.join(shared[:5])})"
        raise InputError(
            f"{source.path} and {other.path}: {common}; part them by place"
        )
    return f"apart        from the {len(others)} places of {other.path}"


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(
        prog="e2rl inspect", description=__doc__.splitlines()[0]
    )
    parser.add_argument("path", type=Path, metavar="PATH", help="folder or zip of logs")
    parser.add_argument(
        "--data",
        metavar="NAME",
        help="file of conf/data that reads them (default: the one that can)",
    )
    parser.add_argument(
        "--scene",
        metavar="ID",
        help="the scene that is drawn (default: the first)",
    )
    parser.add_argument(
        "--metres",
        type=float,
        default=140.0,
        help="width of the picture (default %(default)s)",
    )
    parser.add_argument(
        "--apart",
        type=Path,
        metavar="OTHER",
        help="logs that must share no place with those at PATH",
    )
    parser.add_argument(
        "--workers",
        type=int,
        default=2,
        help="processes (default %(default)s)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default="runs/inspect/scene.png",
        help="picture, with a PDF (%(default)s)",
    )
    options = parser.parse_args(arguments)
    with ending():
        name, source = open_source(options.path, options.data, workers=options.workers)
        rows, contents, drawn = inspect(source, options.scene)
        print(f"data         {name}, {options.path}")
        print(*report(source, rows, contents), sep="\n")
        if drawn is None:
            raise InputError(
                f"{options.path}: no log makes a scene, the first for this reason: "
                f"{rows[0].reason}"
            )
        if options.apart:
            _, other = open_source(options.apart, name, workers=options.workers)
            print(check_apart(rows, source, other))
        assert drawn.scene is not None
        title = f"{drawn.scene_id}   {drawn.location}"
        save_figure(options.out, picture(drawn.scene, title, metres=options.metres))
        print(f"drawn        {drawn.scene_id}: {options.out}")
