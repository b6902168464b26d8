"""Source of logs that py123d has converted: nuScenes, nuPlan, Waymo, Argoverse 2,
KITTI-360 and others in one format (Arrow; extra `py123d`; docs/data.md).

The ego is the recording vehicle. Logs of a higher rate are read at about 10 Hz, long
ones and those with pauses in pieces.
"""

import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from e2rl.run.errors import InputError
from e2rl.run.files import hash_files
from e2rl.scenes.log_files import bounded_memory, check_file
from e2rl.scenes.plausibility import check
from e2rl.scenes.recording import (
    CYCLIST,
    DT,
    LIGHT_UNKNOWN,
    OTHER,
    PEDESTRIAN,
    VEHICLE,
    Lane,
    Recording,
    light_colour,
    same_way,
)
from e2rl.scenes.smoothing import (
    latest_frames,
    resample_heights,
    resample_uniform,
    speeds,
)
from e2rl.scenes.source import Source

SYNC = "sync.arrow"  # every log's folder holds one
FILES = (
    SYNC,
    "ego_state_se3.arrow",
    "box_detections_se3.arrow",
    "traffic_light_detections.arrow",
    "map.arrow",
)
MAX_BYTES = 1 << 29  # of one of these files
LONGEST, PIECE, SHORTEST = (
    30.0,
    20.0,
    5.0,
)  # s: longer logs are cut into pieces; the least between two pauses
PAUSE = 1.0  # s without the ego or boxes at which a log is cut
REACH = 250.0  # m around the ego's path in which the map is taken
TYPES = {
    "VEHICLE": VEHICLE,
    "TRAIN": VEHICLE,
    "TWO_WHEELER": CYCLIST,
    "PERSON": PEDESTRIAN,
}  # others are OTHER
LEFT_OUT = (
    "EGO",
    "TRAFFIC_SIGN",
    "TRAFFIC_LIGHT",
)  # the ego's own box, and what stands beside or hangs over the road
EGO = ""  # the name of its track
OWN = "py123d."  # modules that a file may name


class Frame(NamedTuple):
    """A moment: time [s], boxes {track: (type, x, y, z, heading, length, width)} with
    the ego's first, named EGO, and lights {lane: state}."""

    time: float
    boxes: dict[str, tuple[int, float, float, float, float, float, float]]
    lights: dict[str, int]


@dataclass
class Py123dSource(Source):
    """The converted logs below `path`: the folder with logs/ and maps/, or one inside
    of logs/, such as a split's."""

    holds = "logs converted by py123d, with logs/ and maps/"
    mend = "convert it again or leave it out"
    extra = "py123d"

    def logs(self) -> list[str]:
        root = self.root()
        found = sorted(str(file.parent.relative_to(root)) for file in root.rglob(SYNC))
        if not found:
            raise InputError(
                f"data.path={root}: holds no {SYNC}; pass a folder of {self.holds}"
            )
        return found

    def maps(self) -> Path:
        """The folder of maps that several logs share."""
        root = self.root().resolve()
        above = [
            folder.parent for folder in (root, *root.parents) if folder.name == "logs"
        ]
        return (above[0] if above else root) / "maps"

    def read(self, log: str) -> Iterator[Recording]:
        with bounded_memory():
            recordings = list(self._recordings(self.root() / log))
        yield from recordings

    def _recordings(self, folder: Path) -> Iterator[Recording]:
        from py123d.api.scene.arrow.arrow_scene_api import ArrowSceneAPI

        _check_files(folder)
        for file in self.maps().rglob("*.arrow"):
            check_file(file, sys.maxsize)
        scene = ArrowSceneAPI(folder, maps_root=self.maps())
        frames = _frames(scene)
        about = scene.log_metadata
        land = scene.get_map_api()
        if len(frames) < 2:
            raise InputError(
                "fewer than two frames with the ego and boxes; leave it out"
            )
        if land is None:
            raise InputError(
                f"no map, neither map.arrow beside it nor {self.maps()}; convert the maps as well"
            )
        for number, piece in enumerate(_pieces(frames)):
            scene_id = (
                about.log_name
                if len(piece) == len(frames)
                else f"{about.log_name}#{number}"
            )
            recording = _recording(scene_id, piece)
            recording.location = about.location or ""
            recording.dataset = about.dataset
            recording.lanes, recording.drivable = _map(land, recording.states[:, 0, :2])
            yield recording

    def fingerprint(self) -> bytes:
        files = [self.root() / log / name for log in self.logs() for name in FILES]
        return hash_files(
            [file for file in files if file.is_file()]
            + sorted(self.maps().rglob("*.arrow"))
        )


def _check_files(folder: Path) -> None:
    """InputError for files of a log that are too large, or that have py123d import code
    other than its own."""
    import msgpack
    import pyarrow as pa

    for file in sorted(folder.glob("*.arrow")):
        check_file(file, MAX_BYTES if file.name in FILES else sys.maxsize)
        with pa.memory_map(str(file)) as source:
            about = (pa.ipc.open_file(source).schema.metadata or {}).get(b"metadata")
        if about is None:
            continue
        for key, value in _texts(
            msgpack.unpackb(about, raw=False, strict_map_key=False)
        ):
            if "class" in key and "." in value and not value.startswith(OWN):
                raise InputError(
                    f"{file.name} names the code {value[:100]}, which is none of py123d's; leave it out"
                )


def _texts(value: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """(key, text) of every text in nested containers."""
    if isinstance(value, str):
        yield key, value
    for name, part in value.items() if isinstance(value, Mapping) else ():
        yield from _texts(part, str(name))
    for part in value if isinstance(value, list) else ():
        yield from _texts(part, key)


def _frames(scene: Any) -> list[Frame]:
    """The moments of a log that have the ego and boxes, about DT apart or farther."""
    stride = max(1, round(DT / scene.scene_metadata.iteration_duration_s))
    found = []
    for step in range(0, scene.number_of_iterations, stride):
        ego = scene.get_ego_state_se3_at_iteration(step)
        boxes = scene.get_box_detections_se3_at_iteration(step)
        if ego is None or boxes is None:
            continue
        pose = ego.center_se3
        box = ego.metadata
        agents = {
            EGO: (VEHICLE, pose.x, pose.y, pose.z, pose.yaw, box.length, box.width)
        }
        for other in boxes:
            kind = other.attributes.default_label.name
            body = other.bounding_box_se3
            if kind not in LEFT_OUT:
                place = body.center_se3
                shape = (place.x, place.y, place.z, place.yaw, body.length, body.width)
                agents[other.attributes.track_token] = (TYPES.get(kind, OTHER), *shape)
        lights = scene.get_traffic_light_detections_at_iteration(step) or ()
        states = {
            str(light.lane_id): light_colour(light.status.name) for light in lights
        }
        found.append(Frame(boxes.timestamp.time_us / 1e6, agents, lights=states))
    return found


def _pieces(frames: list[Frame]) -> Iterator[list[Frame]]:
    """Yields the frames of a log, those of a long one, or of one with pauses, in
    pieces.

    What is too short to be one, between two pauses or at the end, is left out.

    Args:
        frames: two or more.
    """
    times = np.array([frame.time for frame in frames])
    steps = np.diff(times)
    pauses = (
        np.flatnonzero(steps > max(PAUSE, 1.5 * float(np.median(steps)))) + 1
    )  # some logs are of 1 Hz
    for begin, end in pairwise([0, *pauses, len(frames)]):
        length = times[end - 1] - times[begin]
        if length > LONGEST:
            for start in np.arange(
                times[begin], times[end - 1] - PIECE + DT / 2, PIECE
            ):
                first, last = np.searchsorted(
                    times, (start - 1e-6, start + PIECE + 1e-6)
                )
                yield frames[first:last]
        elif length >= SHORTEST or not len(pauses):
            yield frames[begin:end]


def _recording(scene_id: str, frames: list[Frame]) -> Recording:
    """Tracks and lights of a piece at 10 Hz, still without a map."""
    names = list(
        dict.fromkeys(name for frame in frames for name in frame.boxes)
    )  # the ego first
    check({"states": len(frames) * len(names)}, scene_id)
    column = {name: index for index, name in enumerate(names)}
    states = np.zeros((len(frames), len(names), 4))
    valid = np.zeros((len(frames), len(names)), bool)
    sizes: list[list[tuple[float, float]]] = [[] for _ in names]
    heights = np.zeros(valid.shape)
    types = np.full(len(names), OTHER)
    for row, frame in enumerate(frames):
        for name, (kind, x, y, z, heading, length, width) in frame.boxes.items():
            index = column[name]
            states[row, index, :3], valid[row, index], types[index] = (
                (x, y, heading),
                True,
                kind,
            )
            heights[row, index] = z
            sizes[index].append((length, width))
    seconds = np.array([frame.time for frame in frames])
    seconds -= seconds[0]
    lanes = dict.fromkeys(lane for frame in frames for lane in frame.lights)
    lights = {
        lane: np.array([frame.lights.get(lane, LIGHT_UNKNOWN) for frame in frames])
        for lane in lanes
    }
    resampled = resample_heights(heights, valid, ts=seconds)
    states, valid = resample_uniform(states, valid, ts=seconds)
    states[..., 3] = speeds(states, valid)
    latest = latest_frames(seconds, len(states))
    size = np.array([np.median(found, axis=0) for found in sizes])
    recording = Recording(
        scene_id,
        "",
        dataset="",
        states=states,
        valid=valid,
        size=size,
        agent_type=types,
        ego=0,
        lanes={},
        current=None,
        heights=resampled,
    )
    recording.lights = {lane: values[latest] for lane, values in lights.items()}
    return recording


def _map(land: Any, path: np.ndarray) -> tuple[dict[str, Lane], list[np.ndarray]]:
    """Lanes for motor vehicles by id, and the surfaces to drive on, within REACH of the
    ego's path [F, 2]."""
    from py123d.datatypes import MapLayer
    from shapely import LineString

    surfaces = [MapLayer.GENERIC_DRIVABLE, MapLayer.INTERSECTION, MapLayer.CARPARK]
    found = land.query(
        LineString(path).buffer(REACH),
        [MapLayer.LANE, *surfaces],
        predicate="intersects",
    )
    segments = {
        str(lane.object_id): lane
        for lane in found.get(MapLayer.LANE, ())
        if lane.lane_type.name != "BIKE_LANE"
    }
    lanes = {name: _lane(segment, land.map_has_z) for name, segment in segments.items()}
    for name, lane in lanes.items():
        lane.exits = [
            str(other) for other in segments[name].successor_ids if str(other) in lanes
        ]
        lane.left = same_way(lanes, lane, neighbour=segments[name].left_lane_id)
        lane.right = same_way(lanes, lane, neighbour=segments[name].right_lane_id)
    areas = [
        area.outline_2d.array for layer in surfaces for area in found.get(layer, ())
    ]
    return lanes, [np.asarray(area, float)[:, :2] for area in areas]


def _lane(segment: Any, has_z: bool) -> Lane:
    """A lane without its links; its width is that of its area over its length."""
    points = np.asarray(
        segment.centerline_3d.array if has_z else segment.centerline_2d.array, float
    )
    length = np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1).sum()
    width = segment.shapely_polygon.area / length if length > 0 else 0.0
    limit = segment.speed_limit_mps
    heights = points[:, 2] if has_z else None
    return Lane(
        points[:, :2],
        float(width),
        speed_limit=float(limit) if limit else 0.0,
        heights=heights,
    )
