"""Source of Argoverse 2 in its own files, read by av2 (extra `argoverse2`):
motion-forecasting scenarios (parquet) and annotated sensor logs (feather), each with
its vector map (json).

The ego is the recording vehicle: the track "AV" of a scenario, the vehicle's pose in a
sensor log. Scenarios hold no sizes, so agents get the typical one of their type.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from e2rl.run.errors import InputError
from e2rl.run.files import hash_files
from e2rl.scenes.log_files import bounded_memory, check_file
from e2rl.scenes.plausibility import check
from e2rl.scenes.recording import (
    CYCLIST,
    OTHER,
    PEDESTRIAN,
    VEHICLE,
    Lane,
    Recording,
    same_way,
)
from e2rl.scenes.smoothing import (
    resample_heights,
    resample_uniform,
    signed_speed,
    speeds,
)
from e2rl.scenes.source import Source

FILES = ("scenario_*.parquet", "annotations*.feather")
LEVELS = ("", "*/", "*/*/")  # of folders below `path` in which logs are looked for
TYPES = {  # by the object types of scenarios and the categories of annotations, in lower case; others are OTHER
    **dict.fromkeys(
        [
            "vehicle",
            "regular_vehicle",
            "large_vehicle",
            "box_truck",
            "truck",
            "truck_cab",
        ],
        VEHICLE,
    ),
    **dict.fromkeys(
        ["vehicular_trailer", "bus", "school_bus", "articulated_bus", "railed_vehicle"],
        VEHICLE,
    ),
    **dict.fromkeys(["motorcyclist", "motorcycle"], VEHICLE),
    **dict.fromkeys(
        ["pedestrian", "official_signaler", "stroller", "wheelchair"], PEDESTRIAN
    ),
    **dict.fromkeys(["cyclist", "bicyclist", "wheeled_rider"], CYCLIST),
}
SIZES = {  # m, of the object types of scenarios, which hold no sizes
    "vehicle": (4.7, 1.9),
    "bus": (12.0, 2.7),
    "motorcyclist": (2.2, 0.8),
    "cyclist": (1.8, 0.7),
    "riderless_bicycle": (1.8, 0.6),
}
SMALL = (0.7, 0.7)  # m, of a pedestrian and of every other type
EGO, EGO_BOX = (
    "AV",
    "EGO_VEHICLE",
)  # its track in a scenario; its annotation, which some logs have
EGO_SIZE, AHEAD = (
    (4.877, 2.0),
    1.425,
)  # m: the recording vehicle, and its middle ahead of its rear axle, its origin
CITIES = {  # by the code in the name of a sensor log's map; scenarios have the name
    "ATX": "austin",
    "DTW": "dearborn",
    "MIA": "miami",
    "PAO": "palo-alto",
    "PIT": "pittsburgh",
    "WDC": "washington-dc",
}
MID_POINTS = 10  # of a lane segment's centreline
MAX_ROWS, MAX_COLUMNS, MAX_TABLE = (
    500_000,
    64,
    1 << 28,
)  # of a scenario; the last in bytes, unpacked


@dataclass
class Argoverse2Source(Source):
    """The scenarios and sensor logs in the folder `path`, up to two folders below it."""

    holds = "Argoverse 2 scenarios or sensor logs"
    mend = "download it again or leave it out"
    extra = "argoverse2"

    def logs(self) -> list[str]:
        root = self.root()
        found = {
            file.parent: file
            for level in LEVELS
            for kind in FILES
            for file in sorted(root.glob(level + kind))
        }
        if not found:
            neither = f"holds neither {FILES[0]} nor {FILES[1]}"
            raise InputError(
                f"data.path={root}: {neither}; pass a folder of {self.holds}"
            )
        return sorted(str(file.relative_to(root)) for file in found.values())

    def read(self, log: str) -> Iterator[Recording]:
        from av2.map.map_api import ArgoverseStaticMap

        path = self.root() / log
        for file in _files(path):
            check_file(file)
        with bounded_memory():
            recording = (
                _scenario(path) if path.suffix == ".parquet" else _sensor_log(path)
            )
            recording.lanes, recording.drivable = _map(
                ArgoverseStaticMap.from_json(_files(path)[-1])
            )
        yield recording

    def fingerprint(self) -> bytes:
        return hash_files(
            file for log in self.logs() for file in _files(self.root() / log)
        )


def _files(path: Path) -> list[Path]:
    """The files of the log at `path`, its map last; raises InputError where there is no
    map."""
    maps = [
        *path.parent.glob("log_map_archive_*.json"),
        *path.parent.glob("map/log_map_archive_*.json"),
    ]
    if not maps:
        raise InputError(
            f"{path.parent}: holds no log_map_archive_*.json; download the map beside the log"
        )
    poses = path.parent / "city_SE3_egovehicle.feather"
    return [path, *([poses] if path.suffix == ".feather" else ()), sorted(maps)[0]]


def _scenario(path: Path) -> Recording:
    """A motion-forecasting scenario, still without a map."""
    from av2.datasets.motion_forecasting.scenario_serialization import (
        load_argoverse_scenario_parquet,
    )

    _check_table(path)
    scenario = load_argoverse_scenario_parquet(path)
    frames = len(scenario.timestamps_ns)
    tracks = scenario.tracks
    check({"states": frames * len(tracks)}, scenario.scenario_id)
    states = np.zeros((frames, len(tracks), 4))
    valid = np.zeros((frames, len(tracks)), bool)
    for index, track in enumerate(tracks):
        for state in track.object_states:
            if valid[state.timestep, index]:
                raise InputError(
                    f"track {track.track_id} is recorded twice at step {state.timestep}; leave one out"
                )
            speed = float(
                signed_speed(np.array(state.velocity), np.array(state.heading))
            )
            states[state.timestep, index] = [*state.position, state.heading, speed]
            valid[state.timestep, index] = True
    kinds = [track.object_type.value for track in tracks]
    names = [track.track_id for track in tracks]
    if EGO not in names:
        raise InputError(
            f"no ego: none of its {len(names)} tracks is {EGO!r}; leave it out"
        )
    ego = names.index(EGO)
    size = np.array([SIZES.get(kind, SMALL) for kind in kinds])
    size[ego] = EGO_SIZE
    seconds = (
        np.asarray(scenario.timestamps_ns, float) - scenario.timestamps_ns[0]
    ) / 1e9
    arrays = (*resample_uniform(states, valid, ts=seconds), size, _types(kinds))
    return Recording(
        scenario.scenario_id,
        scenario.city_name,
        "argoverse2",
        *arrays,
        ego,
        {},
        current=None,
    )


def _check_table(path: Path) -> None:
    """InputError where a table claims to be larger than any scenario."""
    from pyarrow.parquet import read_metadata

    about = read_metadata(path)
    size = sum(
        about.row_group(index).total_byte_size for index in range(about.num_row_groups)
    )
    if about.num_rows > MAX_ROWS or about.num_columns > MAX_COLUMNS or size > MAX_TABLE:
        claim = f"{about.num_rows} rows of {about.num_columns} columns, unpacked {size / 1e6:.0f} MB"
        raise InputError(
            f"{claim}: more than {MAX_ROWS}, {MAX_COLUMNS}, {MAX_TABLE / 1e6:.0f} MB; cut it, or leave it out"
        )


def _sensor_log(path: Path) -> Recording:
    """An annotated sensor log, still without a map. Boxes are given from the ego's pose
    at their time stamp."""
    from av2.utils.io import read_city_SE3_ego, read_feather

    table = read_feather(path)
    table = table[table["category"] != EGO_BOX]
    stamps, frame = np.unique(table["timestamp_ns"], return_inverse=True)
    names, first, track = np.unique(
        table["track_uuid"].astype(str), return_index=True, return_inverse=True
    )
    check({"states": len(stamps) * (len(names) + 1)}, path.parent.name)
    if len(np.unique(np.stack([frame, track]), axis=1).T) < len(frame):
        raise InputError("a track is annotated twice at one time stamp; leave one out")
    poses = read_city_SE3_ego(path.parent)
    turn = np.stack([poses[int(stamp)].rotation for stamp in stamps])
    place = np.stack([poses[int(stamp)].translation for stamp in stamps])
    boxes = table[["tx_m", "ty_m", "tz_m"]].to_numpy(float)
    axis = _forward(*table[["qw", "qx", "qy", "qz"]].to_numpy(float).T)
    states = np.zeros((len(stamps), len(names) + 1, 4))
    valid = np.zeros(states.shape[:2], bool)
    position = np.einsum("kij,kj->ki", turn[frame], boxes) + place[frame]
    states[frame, track + 1, :2] = position[:, :2]
    heights = np.repeat(place[:, 2:], states.shape[1], axis=1)
    heights[frame, track + 1] = position[:, 2]
    states[frame, track + 1, 2] = _heading(np.einsum("kij,kj->ki", turn[frame], axis))
    states[:, 0, :2], states[:, 0, 2] = (
        (place + AHEAD * turn[..., 0])[:, :2],
        _heading(turn[..., 0]),
    )
    valid[frame, track + 1], valid[:, 0] = True, True
    seconds = (stamps - stamps[0]) / 1e9
    resampled = resample_heights(heights, valid, ts=seconds)
    states, valid = resample_uniform(states, valid, ts=seconds)
    states[..., 3] = speeds(states, valid)
    size = np.stack([EGO_SIZE, *table[["length_m", "width_m"]].to_numpy(float)[first]])
    kinds = ["regular_vehicle", *table["category"].to_numpy()[first]]
    code = _files(path)[-1].stem.split("____")[-1].split("_")[0]
    arrays = (states, valid, size, _types(kinds))
    place_name = CITIES.get(code, code)
    return Recording(
        path.parent.name,
        place_name,
        "argoverse2",
        *arrays,
        0,
        {},
        current=None,
        heights=resampled,
    )


def _types(kinds: list[str]) -> np.ndarray:
    return np.array([TYPES.get(kind.lower(), OTHER) for kind in kinds])


def _forward(w: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """The x axis [K, 3] that unit quaternions [K] turn to."""
    return np.stack(
        [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], -1
    )


def _heading(axis: np.ndarray) -> np.ndarray:
    return np.arctan2(axis[..., 1], axis[..., 0])


def _map(static_map: Any) -> tuple[dict[str, Lane], list[np.ndarray]]:
    """Lanes for motor vehicles by segment id, and the drivable areas."""
    from av2.geometry.interpolate import compute_midpoint_line
    from av2.map.lane_segment import LaneType

    segments = {
        str(key): segment for key, segment in static_map.vector_lane_segments.items()
    }
    lanes = {}
    for key, segment in segments.items():
        if segment.lane_type == LaneType.BIKE:
            continue
        left = segment.left_lane_boundary.xyz
        right = segment.right_lane_boundary.xyz
        points, width = compute_midpoint_line(left, right, MID_POINTS)
        exits = [str(other) for other in segment.successors]
        lanes[key] = Lane(
            points[:, :2], float(width), exits=exits, heights=points[:, 2]
        )
    for key, lane in lanes.items():
        lane.left = same_way(lanes, lane, neighbour=segments[key].left_neighbor_id)
        lane.right = same_way(lanes, lane, neighbour=segments[key].right_neighbor_id)
    return lanes, [
        np.asarray(area.xyz[:, :2], float)
        for area in static_map.vector_drivable_areas.values()
    ]
