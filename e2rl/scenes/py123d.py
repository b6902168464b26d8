"""Source of logs that py123d has converted: nuScenes, nuPlan, Waymo, Argoverse 2,
KITTI-360 and others in one format (Arrow; extra `py123d`; docs/guide/data.md).

The ego is the recording vehicle. Logs of a higher rate are read at about 10 Hz, long
ones and those with pauses in pieces.
"""

import sys
from collections.abc import (
    Iterator,
    Mapping,
)
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import (
    Any,
    NamedTuple,
)

import numpy as np

from e2rl.run.errors import InputError
from e2rl.run.files import hash_files
from e2rl.scenes.log_files import (
    bounded_memory,
    check_file,
)
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
    name_neighbours,
)
from e2rl.scenes.resampling import (
    latest_frames,
    resample_uniform,
)
from e2rl.scenes.smoothing import speeds
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
LONGEST = 30.0  # s: longer logs are cut into pieces
PIECE = 20.0  # s of such a piece
SHORTEST = 5.0  # s, the least between two pauses
PAUSE = 1.0  # s without the ego or boxes at which a log is cut
REACH = 250.0  # m around the ego's path in which the map is taken
TYPES = {  # others are OTHER
    "VEHICLE": VEHICLE,
    "TRAIN": VEHICLE,
    "TWO_WHEELER": CYCLIST,
    "PERSON": PEDESTRIAN,
}
LEFT_OUT = (
    "EGO",
    "TRAFFIC_SIGN",
    "TRAFFIC_LIGHT",
)  # the ego's own box, and no obstacles
EGO = ""  # the name of its track
OWN = "py123d."  # modules that a file may name


class Box(NamedTuple):
    """An agent at a moment: its type, place [m], heading [rad] and size [m]."""

    kind: int
    x: float
    y: float
    z: float
    heading: float
    length: float
    width: float


class Frame(NamedTuple):
    """A moment: time [s], boxes {track: box} with the ego's first, named EGO, and
    lights {lane: state}."""

    time: float
    boxes: dict[str, Box]
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
        logs = sorted(str(file.parent.relative_to(root)) for file in root.rglob(SYNC))
        if not logs:
            raise InputError(
                f"data.path={root}: holds no {SYNC}; pass a folder of {self.holds}"
            )
        return logs

    def maps(self) -> Path:
        """The folder of maps that several logs share."""
        root = self.root().resolve()
        for folder in (root, *root.parents):
            if folder.name == "logs":
                return folder.parent / "maps"
        return root / "maps"

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
        log = scene.log_metadata
        area = scene.get_map_api()
        if len(frames) < 2:
            raise InputError(
                "fewer than two frames with the ego and boxes; leave it out"
            )
        if area is None:
            raise InputError(
                f"no map, neither map.arrow beside it nor {self.maps()}; "
                "convert the maps as well"
            )
        for number, piece in enumerate(_pieces(frames)):
            whole = len(piece) == len(frames)
            name = log.log_name if whole else f"{log.log_name}#{number}"
            recording = _recording(name, piece)
            recording.location = log.location or ""
            recording.dataset = log.dataset
            recording.lanes, recording.drivable = _map(area, recording.states[:, 0, :2])
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
            packed = (pa.ipc.open_file(source).schema.metadata or {}).get(b"metadata")
        if packed is None:
            continue
        metadata = msgpack.unpackb(
            packed,
            raw=False,
            strict_map_key=False,
        )
        for key, value in _texts(metadata):
            if "class" in key and "." in value and not value.startswith(OWN):
                raise InputError(
                    f"{file.name} names the code {value[:100]}, which is none of "
                    "py123d's; leave it out"
                )


def _texts(value: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """(key, text) of every text in nested containers."""
    if isinstance(value, str):
        yield key, value
    elif isinstance(value, Mapping):
        for name, part in value.items():
            yield from _texts(part, str(name))
    elif isinstance(value, list):
        for part in value:
            yield from _texts(part, key)


def _frames(scene: Any) -> list[Frame]:
    """The moments of a log that have the ego and boxes, about DT apart or farther."""
    stride = max(1, round(DT / scene.scene_metadata.iteration_duration_s))
    frames = []
    for step in range(0, scene.number_of_iterations, stride):
        ego = scene.get_ego_state_se3_at_iteration(step)
        boxes = scene.get_box_detections_se3_at_iteration(step)
        if ego is None or boxes is None:
            continue
        agents = {EGO: _box(VEHICLE, ego.center_se3, ego.metadata)}
        for other in boxes:
            kind = other.attributes.default_label.name
            body = other.bounding_box_se3
            if kind not in LEFT_OUT:
                box = _box(TYPES.get(kind, OTHER), body.center_se3, body)
                agents[other.attributes.track_token] = box
        detections = scene.get_traffic_light_detections_at_iteration(step) or ()
        lights = {
            str(light.lane_id): light_colour(light.status.name) for light in detections
        }
        frames.append(Frame(boxes.timestamp.time_us / 1e6, agents, lights))
    return frames


def _box(
    kind: int,
    pose: Any,
    size: Any,
) -> Box:
    return Box(
        kind,
        pose.x,
        pose.y,
        pose.z,
        pose.yaw,
        size.length,
        size.width,
    )


def _pieces(frames: list[Frame]) -> Iterator[list[Frame]]:
    """Yields two or more frames of a log, those of a long one, or of one with pauses,
    in pieces.

    What is too short to be one, between two pauses or at the end, is left out.
    """
    times = np.array([frame.time for frame in frames])
    steps = np.diff(times)
    pause = max(PAUSE, 1.5 * float(np.median(steps)))  # some logs are of 1 Hz
    pauses = np.flatnonzero(steps > pause) + 1
    for begin, end in pairwise([0, *pauses, len(frames)]):
        last = times[end - 1]
        if last - times[begin] > LONGEST:
            for start in np.arange(times[begin], last - PIECE + DT / 2, PIECE):
                ends = (start - 1e-6, start + PIECE + 1e-6)
                yield frames[slice(*np.searchsorted(times, ends))]
        elif last - times[begin] >= SHORTEST or not len(pauses):
            yield frames[begin:end]


def _recording(scene_id: str, frames: list[Frame]) -> Recording:
    """Tracks and lights of a piece at 10 Hz, still without a map."""
    # the ego first
    names = list(dict.fromkeys(name for frame in frames for name in frame.boxes))
    check({"states": len(frames) * len(names)}, scene_id)
    boxes = np.full((len(frames), len(names), len(Box._fields)), np.nan)
    for row, frame in enumerate(frames):
        for column, name in enumerate(names):
            if name in frame.boxes:
                boxes[row, column] = frame.boxes[name]
    valid = ~np.isnan(boxes[..., 0])
    states = np.zeros((*valid.shape, 4))
    states[valid, :3] = boxes[valid][:, [1, 2, 4]]
    heights = np.where(valid, boxes[..., 3], 0.0)
    last = len(frames) - 1 - valid[::-1].argmax(0)
    kinds = boxes[last, np.arange(len(names)), 0].astype(int)
    seconds = np.array([frame.time for frame in frames])
    seconds -= seconds[0]
    recorded = valid
    states, valid, resampled = resample_uniform(
        states,
        valid,
        seconds,
        heights,
    )
    states[..., 3] = speeds(states, valid)
    sizes = [
        np.median(boxes[recorded[:, column], column, 5:], axis=0)
        for column in range(len(names))
    ]
    latest = latest_frames(seconds, len(states))
    lanes = dict.fromkeys(lane for frame in frames for lane in frame.lights)
    return Recording(
        scene_id=scene_id,
        location="",
        dataset="",
        states=states,
        valid=valid,
        size=np.array(sizes),
        agent_type=kinds,
        ego=0,
        lanes={},
        lights={
            lane: np.array([frames[k].lights.get(lane, LIGHT_UNKNOWN) for k in latest])
            for lane in lanes
        },
        current=None,
        heights=resampled,
    )


def _map(area: Any, path: np.ndarray) -> tuple[dict[str, Lane], list[np.ndarray]]:
    """Lanes for motor vehicles by id, and the surfaces to drive on, within REACH of the
    ego's path [F, 2]."""
    from py123d.datatypes import MapLayer
    from shapely import LineString

    surfaces = [MapLayer.GENERIC_DRIVABLE, MapLayer.INTERSECTION, MapLayer.CARPARK]
    layers = area.query(
        LineString(path).buffer(REACH),
        [MapLayer.LANE, *surfaces],
        predicate="intersects",
    )
    segments = {
        str(lane.object_id): lane
        for lane in layers.get(MapLayer.LANE, ())
        if lane.lane_type.name != "BIKE_LANE"
    }
    lanes = {name: _lane(segment, area.map_has_z) for name, segment in segments.items()}
    beside = {}
    for name, segment in segments.items():
        exits = map(str, segment.successor_ids)
        lanes[name].exits = [other for other in exits if other in lanes]
        beside[name] = (segment.left_lane_id, segment.right_lane_id)
    name_neighbours(lanes, beside)
    drivable = [
        np.asarray(surface.outline_2d.array, float)[:, :2]
        for layer in surfaces
        for surface in layers.get(layer, ())
    ]
    return lanes, drivable


def _lane(segment: Any, has_z: bool) -> Lane:
    """A lane without its links; its width is that of its area over its length."""
    line = segment.centerline_3d if has_z else segment.centerline_2d
    points = np.asarray(line.array, float)
    step = np.diff(points[:, :2], axis=0)
    length = np.linalg.norm(step, axis=1).sum()
    return Lane(
        points=points[:, :2],
        width=float(segment.shapely_polygon.area / length) if length > 0 else 0.0,
        speed_limit=float(segment.speed_limit_mps or 0.0),
        heights=points[:, 2] if has_z else None,
    )
