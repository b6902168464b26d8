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
from numpy import ndarray

from e2rl.run.errors import InputError
from e2rl.run.files import hash_files
from e2rl.scenes.log_files import (
    bounded_memory,
    check_file,
)
from e2rl.scenes.plausibility import check
from e2rl.scenes.recording import (
    CYCLIST,
    OTHER,
    PEDESTRIAN,
    VEHICLE,
    Lane,
    Recording,
    name_neighbours,
)
from e2rl.scenes.resampling import resample_uniform
from e2rl.scenes.smoothing import (
    signed_speed,
    speeds,
)
from e2rl.scenes.source import Source

FILES = ("scenario_*.parquet", "annotations*.feather")
LEVELS = ("", "*/", "*/*/")  # of folders below `path` in which logs are looked for
KINDS = {  # object types of scenarios, categories of annotations; others are OTHER
    VEHICLE: "vehicle regular_vehicle large_vehicle box_truck truck truck_cab "
    "vehicular_trailer bus school_bus articulated_bus railed_vehicle motorcyclist "
    "motorcycle",
    PEDESTRIAN: "pedestrian official_signaler stroller wheelchair",
    CYCLIST: "cyclist bicyclist wheeled_rider",
}
TYPES = {name: kind for kind, names in KINDS.items() for name in names.split()}
SIZES = {  # m, of the object types of scenarios, which hold no sizes
    "vehicle": (4.7, 1.9),
    "bus": (12.0, 2.7),
    "motorcyclist": (2.2, 0.8),
    "cyclist": (1.8, 0.7),
    "riderless_bicycle": (1.8, 0.6),
}
SMALL = (0.7, 0.7)  # m, of a pedestrian and of every other type
EGO = "AV"  # its track in a scenario
EGO_BOX = "EGO_VEHICLE"  # its annotation, which some logs have
EGO_SIZE = (4.877, 2.0)  # m
AHEAD = 1.425  # m from the vehicle's rear axle, its origin, to its middle
CITIES = {  # by the code in the name of a sensor log's map; scenarios have the name
    "ATX": "austin",
    "DTW": "dearborn",
    "MIA": "miami",
    "PAO": "palo-alto",
    "PIT": "pittsburgh",
    "WDC": "washington-dc",
}
MID_POINTS = 10  # of a lane segment's centreline
MAX_ROWS, MAX_COLUMNS = 500_000, 64  # of a scenario
MAX_TABLE = 1 << 28  # bytes of it, unpacked


@dataclass
class Argoverse2Source(Source):
    """The scenarios and sensor logs in the folder `path`, up to two folders below it."""

    holds = "Argoverse 2 scenarios or sensor logs"
    mend = "download it again or leave it out"
    extra = "argoverse2"

    def logs(self) -> list[str]:
        root = self.root()
        logs = {
            file.parent: str(file.relative_to(root))
            for level in LEVELS
            for kind in FILES
            for file in sorted(root.glob(level + kind))
        }
        if not logs:
            raise InputError(
                f"data.path={root}: holds neither {FILES[0]} nor {FILES[1]}; "
                f"pass a folder of {self.holds}"
            )
        return sorted(logs.values())

    def read(self, log: str) -> Iterator[Recording]:
        from av2.map.map_api import ArgoverseStaticMap

        path = self.root() / log
        files = _files(path)
        for file in files:
            check_file(file)
        with bounded_memory():
            kind = _scenario if path.suffix == ".parquet" else _sensor_log
            recording = kind(path)
            static_map = ArgoverseStaticMap.from_json(files[-1])
            recording.lanes, recording.drivable = _map(static_map)
        yield recording

    def fingerprint(self) -> bytes:
        root = self.root()
        return hash_files(file for log in self.logs() for file in _files(root / log))


def _files(path: Path) -> list[Path]:
    """The files of the log at `path`, its map last; raises InputError where there is no
    map."""
    folder = path.parent
    maps = [
        *folder.glob("log_map_archive_*.json"),
        *folder.glob("map/log_map_archive_*.json"),
    ]
    if not maps:
        raise InputError(
            f"{folder}: holds no log_map_archive_*.json; download the map beside the log"
        )
    poses = [folder / "city_SE3_egovehicle.feather"]
    return [path, *(poses if path.suffix == ".feather" else ()), min(maps)]


def _scenario(path: Path) -> Recording:
    """A motion-forecasting scenario, still without a map."""
    from av2.datasets.motion_forecasting.scenario_serialization import (
        load_argoverse_scenario_parquet,
    )

    _check_table(path)
    scenario = load_argoverse_scenario_parquet(path)
    tracks = scenario.tracks
    shape = (len(scenario.timestamps_ns), len(tracks))
    check({"states": shape[0] * shape[1]}, scenario.scenario_id)
    states = np.zeros((*shape, 4))
    valid = np.zeros(shape, bool)
    for index, track in enumerate(tracks):
        for state in track.object_states:
            place = (state.timestep, index)
            if valid[place]:
                raise InputError(
                    f"track {track.track_id} is recorded twice at step "
                    f"{state.timestep}; leave one out"
                )
            speed = signed_speed(np.array(state.velocity), np.array(state.heading))
            states[place] = [*state.position, state.heading, float(speed)]
            valid[place] = True
    names = [track.track_id for track in tracks]
    if EGO not in names:
        raise InputError(
            f"no ego: none of its {len(names)} tracks is {EGO!r}; leave it out"
        )
    ego = names.index(EGO)
    kinds = [track.object_type.value for track in tracks]
    size = np.array([SIZES.get(kind, SMALL) for kind in kinds])
    size[ego] = EGO_SIZE
    stamps = np.asarray(scenario.timestamps_ns, float)
    seconds = (stamps - scenario.timestamps_ns[0]) / 1e9
    states, valid, _ = resample_uniform(states, valid, seconds)
    return Recording(
        scene_id=scenario.scenario_id,
        location=scenario.city_name,
        dataset="argoverse2",
        states=states,
        valid=valid,
        size=size,
        agent_type=_types(kinds),
        ego=ego,
        lanes={},
        current=None,
    )


def _check_table(path: Path) -> None:
    """InputError where a table claims to be larger than any scenario."""
    from pyarrow.parquet import read_metadata

    table = read_metadata(path)
    groups = map(table.row_group, range(table.num_row_groups))
    size = sum(group.total_byte_size for group in groups)
    if table.num_rows > MAX_ROWS or table.num_columns > MAX_COLUMNS or size > MAX_TABLE:
        raise InputError(
            f"{table.num_rows} rows of {table.num_columns} columns, unpacked "
            f"{size / 1e6:.0f} MB: more than {MAX_ROWS}, {MAX_COLUMNS}, "
            f"{MAX_TABLE / 1e6:.0f} MB; cut it, or leave it out"
        )


def _sensor_log(path: Path) -> Recording:
    """An annotated sensor log, still without a map. Boxes are given from the ego's pose
    at their time stamp."""
    from av2.utils.io import (
        read_city_SE3_ego,
        read_feather,
    )

    table = read_feather(path)
    table = table[table["category"] != EGO_BOX]
    stamps, frame = np.unique(table["timestamp_ns"], return_inverse=True)
    names, first, track = np.unique(
        table["track_uuid"].astype(str),
        return_index=True,
        return_inverse=True,
    )
    track = track + 1  # behind the ego's
    shape = (len(stamps), len(names) + 1)
    check({"states": shape[0] * shape[1]}, path.parent.name)
    if len(np.unique(np.stack([frame, track]), axis=1).T) < len(frame):
        raise InputError("a track is annotated twice at one time stamp; leave one out")
    poses = read_city_SE3_ego(path.parent)
    rotation = np.stack([poses[int(stamp)].rotation for stamp in stamps])
    place = np.stack([poses[int(stamp)].translation for stamp in stamps])
    boxes = table[["tx_m", "ty_m", "tz_m"]].to_numpy(float)
    position = np.einsum("kij,kj->ki", rotation[frame], boxes) + place[frame]
    quaternions = table[["qw", "qx", "qy", "qz"]].to_numpy(float)
    axis = np.einsum("kij,kj->ki", rotation[frame], _forward(quaternions))
    states = np.zeros((*shape, 4))
    valid = np.zeros(shape, bool)
    heights = np.repeat(place[:, 2:], shape[1], axis=1)
    states[:, 0, :2] = (place + AHEAD * rotation[..., 0])[:, :2]
    states[:, 0, 2] = _heading(rotation[..., 0])
    valid[:, 0] = True
    states[frame, track, :2] = position[:, :2]
    states[frame, track, 2] = _heading(axis)
    valid[frame, track] = True
    heights[frame, track] = position[:, 2]
    seconds = (stamps - stamps[0]) / 1e9
    states, valid, resampled = resample_uniform(
        states,
        valid,
        seconds,
        heights,
    )
    states[..., 3] = speeds(states, valid)
    code = _files(path)[-1].stem.split("____")[-1].split("_")[0]
    sizes = table[["length_m", "width_m"]].to_numpy(float)[first]
    return Recording(
        scene_id=path.parent.name,
        location=CITIES.get(code, code),
        dataset="argoverse2",
        states=states,
        valid=valid,
        size=np.stack([EGO_SIZE, *sizes]),
        agent_type=_types(["vehicle", *table["category"].to_numpy()[first]]),
        ego=0,
        lanes={},
        current=None,
        heights=resampled,
    )


def _types(kinds: list[str]) -> ndarray:
    return np.array([TYPES.get(kind.lower(), OTHER) for kind in kinds])


def _forward(quaternions: ndarray) -> ndarray:
    """The x axis [K, 3] that unit quaternions [K, 4] turn to."""
    w, x, y, z = quaternions.T
    return np.stack(
        [
            1 - 2 * (y * y + z * z),
            2 * (x * y + w * z),
            2 * (x * z - w * y),
        ],
        -1,
    )


def _heading(axis: ndarray) -> ndarray:
    return np.arctan2(axis[..., 1], axis[..., 0])


def _map(static_map: Any) -> tuple[dict[str, Lane], list[ndarray]]:
    """Lanes for motor vehicles by segment id, and the drivable areas."""
    from av2.geometry.interpolate import compute_midpoint_line
    from av2.map.lane_segment import LaneType

    lanes = {}
    beside = {}
    for key, segment in static_map.vector_lane_segments.items():
        if segment.lane_type == LaneType.BIKE:
            continue
        points, width = compute_midpoint_line(
            segment.left_lane_boundary.xyz,
            segment.right_lane_boundary.xyz,
            MID_POINTS,
        )
        lanes[str(key)] = Lane(
            points=points[:, :2],
            width=float(width),
            exits=[str(other) for other in segment.successors],
            heights=points[:, 2],
        )
        beside[str(key)] = (segment.left_neighbor_id, segment.right_neighbor_id)
    name_neighbours(lanes, beside)
    areas = static_map.vector_drivable_areas.values()
    return lanes, [np.asarray(area.xyz[:, :2], float) for area in areas]
