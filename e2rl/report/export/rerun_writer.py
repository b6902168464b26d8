"""Rerun's recordings, by rerun-sdk (extra `rerun`; docs/guide/export.md)."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from uuid import uuid4

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from e2rl.report.export.episode import EGO, Episode
from e2rl.report.export.replay import (
    WIDTH,
    Box,
    alternatives,
    boxes,
    curves,
    map_lines,
    plans,
    times,
)

TIMELINE = "time"
FRAME = "scene/frame"  # of the ego, in which the scene is seen from behind and above
EYE = (-25.0, 0.0, 18.0)  # m
TARGET = (8.0, 0.0, 0.0)  # m
COMPARED = (EGO, "partner", "driver", "evasion")  # whose speeds are shown at first


def write(
    episodes: Iterable[Episode],
    folder: Path,
    open_ego: bool = False,
) -> Iterator[tuple[Episode, Path]]:
    """Write NAME.rrd of each episode, with an arrangement of views."""
    rr.set_strict_mode(True)  # else what it cannot write is a warning, and is left out
    for episode in episodes:
        path = folder / f"{episode.path.stem}.rrd"
        # A viewer joins recordings of one id, and by default all of a process have one.
        stream = rr.RecordingStream("e2rl", recording_id=uuid4())
        stream.save(path, default_blueprint=blueprint())
        stream.send_recording_name(episode.path.stem)
        log_episode(episode, stream)
        stream.flush()
        stream.disconnect()
        yield episode, path


def blueprint() -> rrb.Blueprint:
    """Views of the scene, of speeds, gaps and the verdict. All recordings that a viewer
    holds share it, so it names what each of them has."""
    scene = rrb.Spatial3DView(
        origin=FRAME,
        contents="/scene/**",
        name="scene",
        eye_controls=rrb.EyeControls3D(position=EYE, look_target=TARGET),
    )
    gaps = rrb.TimeSeriesView(origin="gap", name="gap to the partner [m]")
    speeds = rrb.TimeSeriesView(
        origin="speed",
        contents=[f"$origin/{name}" for name in COMPARED],
        name="speed [m/s]",
    )
    facts = rrb.TextDocumentView(origin="verdict")
    return rrb.Blueprint(
        rrb.Horizontal(scene, rrb.Vertical(gaps, speeds, facts), column_shares=[2, 1]),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed"),
        collapse_panels=True,
    )


def log_episode(episode: Episode, stream: rr.RecordingStream) -> None:
    """Log an episode to a recording."""
    moments = np.array(times(episode), "timedelta64[ns]")
    lines = map_lines(episode)
    road = rr.LineStrips3D(
        [points for points, _ in lines],
        colors=[colour for _, colour in lines],
        radii=WIDTH / 2,
    )
    stream.log("scene/map", road, static=True)
    facts = "\n".join(f"- {name}: {value}" for name, value in episode.facts.items())
    verdict = rr.TextDocument(facts, media_type="text/markdown")
    stream.log("verdict", verdict, static=True)
    traffic = boxes(episode)
    others = alternatives(episode)
    frame = rr.Transform3D.columns(
        translation=traffic[0].centre,
        quaternion=traffic[0].rotation,
    )
    index = rr.TimeColumn(TIMELINE, duration=moments)
    stream.send_columns(FRAME, indexes=[index], columns=frame)
    for group, members in (("traffic", traffic), ("alternatives", others)):
        for box in members:
            log_box(box, f"scene/{group}/{box.name}", moments, stream)
    for box in curves(episode, [*traffic, *others]):
        log_series(box, moments, stream)
    log_plans(episode, {box.name: box.colour for box in traffic}, moments, stream)


def log_plans(
    episode: Episode,
    colours: dict[str, tuple[float, ...]],
    moments: np.ndarray,
    stream: rr.RecordingStream,
) -> None:
    """Log the plans of an episode, if it has any.

    Args:
        episode: whose plans.
        colours: by agent.
        moments: [T + 1] of all steps.
        stream: the recording.
    """
    steps = []
    drawn: list[tuple[str, np.ndarray]] = []
    counts = []
    for step, plan in plans(episode):
        steps.append(step)
        drawn += plan.items()
        counts.append(len(plan))
    if not steps:
        return
    columns = rr.LineStrips3D.columns(
        strips=[points for _, points in drawn],
        colors=[colours[name] for name, _ in drawn],
        radii=[WIDTH / 2] * len(drawn),
    )
    index = rr.TimeColumn(TIMELINE, duration=moments[steps])
    rows = columns.partition(counts)
    stream.send_columns("scene/plans", indexes=[index], columns=rows)


def log_box(
    box: Box,
    path: str,
    moments: np.ndarray,
    stream: rr.RecordingStream,
) -> None:
    """Log the motion of a box as the entity `path`.

    Args:
        box: to log.
        path: of the entity.
        moments: [T + 1] of all steps.
        stream: the recording.
    """
    indexes = [rr.TimeColumn(TIMELINE, duration=moments)]
    # A row without boxes hides it: a box of the last row would stay.
    count = int(box.present.sum())
    columns = rr.Boxes3D.columns(
        centers=box.centre[box.present],
        quaternions=box.rotation[box.present],
        half_sizes=np.tile(np.array(box.size) / 2, (count, 1)),
    )
    rows = columns.partition(box.present.astype(int))
    stream.send_columns(path, indexes=indexes, columns=rows)
    style = rr.Boxes3D.from_fields(
        colors=[box.colour],
        labels=[box.name],
        show_labels=False,
        fill_mode="TransparentFillMajorWireframe",
    )
    stream.log(path, style, static=True)


def log_series(box: Box, moments: np.ndarray, stream: rr.RecordingStream) -> None:
    """Log the series of a box over the moments [T + 1] of all steps."""
    for name, values in box.series.items():
        path = f"{name}/{box.name}"
        line = rr.SeriesLines(colors=box.colour, names=box.name)
        stream.log(path, line, static=True)
        stream.send_columns(
            path,
            indexes=[rr.TimeColumn(TIMELINE, duration=moments)],
            columns=rr.Scalars.columns(scalars=values),
        )
