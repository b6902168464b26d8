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
from e2rl.report.drawing import Shape, TrafficMap, Trail, new_figure, save_figure
from e2rl.run.config import load_choice
from e2rl.run.endings import ending
from e2rl.run.errors import InputError
from e2rl.scenes.paths import arc_length
from e2rl.scenes.recording import (
    AGENT_TYPES,
    LIGHT_GREEN,
    LIGHT_RED,
    LIGHT_UNKNOWN,
    LIGHT_YELLOW,
    VEHICLE,
)
from e2rl.scenes.source import Row, Source, source_of
from e2rl.sim.rollouts import road_of

FOUND = (
    "scenarionet",
    "commonroad",
    "argoverse2",
    "py123d",
)  # groups of data that a path can belong to
SIDE, HEAD, FOOT = 900, 34, 30  # points: of a picture, of its header and of its legend
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
MOVES = 0.5  # m/s
MOST_LIMITS = 8  # values of speed limits that are told
TENTHS = (
    "median length of vehicles, m",
    "speed of the ego at the start, m/s",
    "km of lanes",
)  # told to one decimal


Counts = dict[str, float]  # of one scene, by what a line of the report says
LIMIT = "limit: "  # of a scene's route vertices by the speed limit there, which one line of the report tells together


def content(scene: dict[str, np.ndarray]) -> Counts:
    """Returns the counts of one scene; agents are those present at its start frame."""
    present = scene["valid"]
    kinds = scene["agent_type"]
    ego = scene["logged"][scene["logged_valid"][:, 0], 0, :2]
    vehicles = present & (kinds == VEHICLE)
    index = scene["lane_index"]
    count = len(scene["lane_width"])
    beside = (scene["lane_left"] >= 0) | (scene["lane_right"] >= 0)
    agents = {
        f"{name}s": (present & (kinds == kind)).sum()
        for kind, name in enumerate(AGENT_TYPES)
    }
    return agents | {
        "vehicles that move, beside the ego": (
            vehicles & (abs(scene["start"][:, 3]) > MOVES)
        )[1:].sum(),
        "vehicles that appear later, near": (
            scene["logged_valid"].any(0) & ~present & (kinds == VEHICLE)
        ).sum(),
        "vehicles near that none drives": scene["left_out"],
        "median length of vehicles, m": np.median(scene["size"][vehicles, 0]),
        "speed of the ego at the start, m/s": scene["start"][0, 3],
        "distance driven by the ego, m": np.linalg.norm(
            np.diff(ego, axis=0), axis=1
        ).sum(),
        "lanes": count,
        "km of lanes": sum(
            arc_length(scene["lane_points"][index == lane])[-1] for lane in range(count)
        )
        / 1000,
        "% of lanes with a successor": 100 * (scene["lane_exits"] >= 0).any(1).mean(),
        "% of lanes with a neighbour": 100 * beside.mean(),
        "% of routes with a speed limit": 100
        * (scene["route_limit"][scene["route_valid"]] > 0).mean(),
        "drivable polygons": len(np.unique(scene["drivable_index"])),
        "traffic lights": len(scene["light_points"]),
        **limits_of(scene),
    }


def limits_of(scene: dict[str, np.ndarray]) -> Counts:
    """Returns how many vertices of routes in a scene have each speed limit, by LIMIT
    and its km/h."""
    limits = np.round(3.6 * scene["route_limit"][scene["route_valid"]]).astype(int)
    return {
        f"{LIMIT}{value}": int(count)
        for value, count in zip(*np.unique(limits, return_counts=True), strict=True)
    }


def limits_line(contents: Sequence[Counts]) -> str:
    """Returns the line of the speed limits on the routes of all scenes, the most
    frequent ones first."""
    total: Counter[str] = Counter()
    for counts in contents:
        total.update(
            {
                name.removeprefix(LIMIT): count
                for name, count in counts.items()
                if name.startswith(LIMIT)
            }
        )
    values = [
        f"{'unknown' if value == '0' else value} {100 * count / total.total():.0f}%"
        for value, count in total.most_common(MOST_LIMITS)
    ]
    more = len(total) - len(values)
    return (
        "limits       km/h on the routes: "
        + ", ".join(values)
        + (f", and {more} others" if more else "")
    )


def report(
    source: Source, rows: Sequence[Row], contents: Sequence[Counts]
) -> list[str]:
    """Returns the lines about a data set: `rows` of all its logs, `contents` of those
    that made a scene."""
    scenes = [row for row in rows if not row.reason]
    reasons = Counter(row.reason for row in rows if row.reason)
    places = {row.location for row in scenes}
    lines = [
        f"logs         {len(source.logs())}",
        f"scenes       {len(scenes)}, "
        + ("places not known" if places == {""} else f"of {len(places)} places"),
        f"left out     {sum(reasons.values())}",
        *(
            f"             {count} x {reason}"
            for reason, count in reasons.most_common()
        ),
    ]
    repairs = sum((row.repairs for row in rows), Counter())
    lines += [
        f"mended       {count} {phrase}" for phrase, count in repairs.most_common()
    ]
    if contents:
        about = "of the agents that take part, those present at the start frame"
        lines += [
            limits_line(contents),
            f"in a scene   median (least to most); {about}",
        ]
    for name in (
        [name for name in contents[0] if not name.startswith(LIMIT)] if contents else ()
    ):
        values = [float(counts[name]) for counts in contents]
        digits = 1 if name in TENTHS else 0
        middle, low, high = (
            f"{value:.{digits}f}"
            for value in (np.median(values), min(values), max(values))
        )
        lines.append(f"  {name:<36}{middle:>8} ({low} to {high})")
    return lines


def picture(scene: dict[str, np.ndarray], title: str, metres: float) -> Figure:
    """Returns a picture of a scene at its start frame, `metres` wide, with the recorded
    paths of its agents."""
    height = SIDE + HEAD + FOOT
    figure = new_figure(SIDE, height)
    axes = figure.add_axes((0, FOOT / height, 1, SIDE / height))
    figure.text(14 / SIDE, 1 - 22 / height, title, fontsize=13, color=drawing.INK)
    drawing.add_legend(figure, LEGEND, size=11)
    TrafficMap(axes, road_of(TensorDict(scene)), metres=metres).show(
        scene["start"][0, :2], _trails(scene), _shapes(scene)
    )
    return figure


def _trails(scene: dict[str, np.ndarray]) -> list[Trail]:
    """The recorded paths, the ego's on top; each fades towards the start frame."""
    agents = np.flatnonzero(scene["valid"])[::-1]
    paths = [
        scene["logged"][scene["logged_valid"][:, agent], agent, :2] for agent in agents
    ]
    return [
        Trail(path, _colour(scene, k), width=0.4)
        for k, path in zip(agents, paths, strict=True)
        if len(path) > 1
    ]


def _shapes(scene: dict[str, np.ndarray]) -> list[Shape]:
    """Lights, then agents, the ego on top."""
    states = scene["light_state"][0].tolist()
    points = zip(scene["light_points"], states, strict=True)
    shapes = [
        drawing.disc(point, 0.7, fill=LIGHTS[state], edge=drawing.INK)
        for point, state in points
    ]
    for agent in np.flatnonzero(scene["valid"])[::-1]:
        state = scene["start"][agent]
        size = scene["size"][agent]
        kind = AGENT_TYPES[scene["agent_type"][agent]]
        shapes += drawing.agent(kind, state, size=size, colour=_colour(scene, agent))
    return shapes


def _colour(scene: dict[str, np.ndarray], agent: int) -> str:
    return (
        drawing.EGO
        if agent == 0
        else COLOURS.get(AGENT_TYPES[scene["agent_type"][agent]], drawing.REPLAYED)
    )


def open_source(path: Path, data: str | None, workers: int) -> tuple[str, Source]:
    """Returns the data group that reads `path`, and its source; raises InputError where
    none does."""
    refusals = []
    for name in [data] if data else FOUND:
        source = source_of(
            {**load_choice("data", name), "path": str(path), "workers": workers}
        )
        try:
            source.logs()
        except InputError as error:
            refusals.append(str(error))
        else:
            return name, source
    raise InputError("; ".join(dict.fromkeys(refusals)))


def inspect(
    source: Source, chosen: str | None
) -> tuple[list[Row], list[Counts], Row | None]:
    """Returns all rows of a source without their scenes, the counts of its scenes, and
    the row to draw.

    That is the scene `chosen`, by default the first; None where no log makes a scene.
    Raises InputError where there is no such scene.
    """
    rows = []
    contents = []
    drawn = None
    with closing(source.rows()) as found:
        for row in found:
            rows.append(row._replace(scene=None))
            if row.scene is not None:
                contents.append(content(row.scene))
                drawn = (
                    row if drawn is None and chosen in (None, row.scene_id) else drawn
                )
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
    here = {row.location for row in rows if not row.reason}
    there = {recording.location for recording in other.recordings()}
    for path, places in ((source.path, here), (other.path, there)):
        if "" in places:
            raise InputError(
                f"{path}: the place of some logs is not known; name it in index.csv (docs/guide/data.md)"
            )
    if shared := sorted(here & there):
        common = f"{len(shared)} places in common ({', '.join(shared[:5])})"
        raise InputError(
            f"{source.path} and {other.path}: {common}; part them by place"
        )
    return f"apart        from the {len(there)} places of {other.path}"


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
        "--scene", metavar="ID", help="the scene that is drawn (default: the first)"
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
        "--workers", type=int, default=2, help="processes (default %(default)s)"
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
        print(
            f"data         {name}, {options.path}",
            *report(source, rows, contents=contents),
            sep="\n",
        )
        if drawn is None:
            raise InputError(
                f"{options.path}: no log makes a scene, the first for this reason: {rows[0].reason}"
            )
        if options.apart:
            print(
                check_apart(
                    rows,
                    source,
                    other=open_source(options.apart, name, workers=options.workers)[1],
                )
            )
        assert drawn.scene is not None
        title = f"{drawn.scene_id}   {drawn.location}"
        save_figure(options.out, picture(drawn.scene, title, metres=options.metres))
        print(f"drawn        {drawn.scene_id}: {options.out}")
