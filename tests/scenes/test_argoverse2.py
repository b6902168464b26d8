"""Argoverse 2's own files: what scenarios and sensor logs say arrives in the Recording,
in city coordinates."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from e2rl.run.errors import InputError
from e2rl.scenes.drivable_area import off_road
from e2rl.scenes.recording import (
    OTHER,
    PEDESTRIAN,
    VEHICLE,
)

pytest.importorskip("av2", reason="data=argoverse2 needs the extra argoverse2")
import pandas as pd  # noqa: E402
from av2.datasets.motion_forecasting import data_schema as schema  # noqa: E402
from av2.datasets.motion_forecasting.scenario_serialization import (
    serialize_argoverse_scenario_parquet,
)  # noqa: E402

from e2rl.scenes.argoverse2 import (
    AHEAD,
    EGO_SIZE,
    MAX_ROWS,
    Argoverse2Source,
)

RECORDED = Path(__file__).parents[3] / "shared" / "data" / "av2"
FRAMES = 110
TIMES = 0.1 * np.arange(FRAMES)


def points(*pairs) -> list[dict]:
    return [{"x": x, "y": y, "z": 0.0} for x, y in pairs]


def segment(
    number: int,
    x: tuple[float, float],
    y: float,
    successors=(),
    left=None,
    right=None,
    kind="VEHICLE",
) -> dict:
    """A lane segment of 3.6 m along +x, or along -x where x falls, with its middle at
    y."""
    half = 1.8 if x[1] > x[0] else -1.8
    return {
        "id": number,
        "is_intersection": False,
        "lane_type": kind,
        "left_lane_boundary": points(*((at, y + half) for at in x)),
        "right_lane_boundary": points(*((at, y - half) for at in x)),
        "left_lane_mark_type": "NONE",
        "right_lane_mark_type": "NONE",
        "predecessors": [],
        "successors": list(successors),
        "left_neighbor_id": left,
        "right_neighbor_id": right,
    }


def write_map(folder: Path, name: str) -> None:
    segments = [
        segment(
            1,
            (0, 100),
            y=0,
            successors=[2],
            left=3,
        ),
        segment(2, (100, 400), y=0),
        segment(
            3,
            (0, 100),
            y=3.6,
            left=4,
            right=1,
        ),
        segment(
            4,
            (100, 0),
            y=7.2,
            left=3,
        ),  # oncoming
        segment(
            5,
            (0, 100),
            y=-3.6,
            kind="BIKE",
        ),
    ]
    area = {
        "id": 9,
        "area_boundary": points(
            (0, -6),
            (400, -6),
            (400, 9),
            (0, 9),
        ),
    }
    parts = {"drivable_areas": {"9": area}, "pedestrian_crossings": {}}
    parts["lane_segments"] = {str(part["id"]): part for part in segments}
    folder.mkdir(
        parents=True,
        exist_ok=True,
    )
    (folder / f"log_map_archive_{name}.json").write_text(json.dumps(parts))


def track(
    name: str,
    kind: str,
    x: float,
    y: float,
    speed: float,
    frames: range = range(FRAMES),
) -> schema.Track:
    states = [
        schema.ObjectState(
            frame < 50,
            frame,
            (x + 0.1 * speed * frame, y),
            0.0,
            (speed, 0.0),
        )
        for frame in frames
    ]
    return schema.Track(
        name,
        states,
        schema.ObjectType(kind),
        schema.TrackCategory.SCORED_TRACK,
    )


def write_scenario(root: Path, tracks: list[schema.Track] | None = None) -> Path:
    """A scenario `made` in its folder: the ego at 8 m/s on segment 1, a bus beside it,
    and a pedestrian for 2 s."""
    tracks = tracks or [
        track(
            "7",
            "bus",
            x=40,
            y=3.6,
            speed=6,
        ),
        track(
            "AV",
            "vehicle",
            x=20,
            y=0,
            speed=8,
        ),
        track(
            "p",
            "pedestrian",
            x=30,
            y=-5,
            speed=1,
            frames=range(20),
        ),
        track(
            "c",
            "construction",
            x=60,
            y=-5,
            speed=0,
        ),
    ]
    stamps = np.linspace(315e15, 315e15 + 1e9 * TIMES[-1], FRAMES)
    scenario = schema.ArgoverseScenario(
        "made",
        stamps,
        tracks,
        "7",
        "austin",
        None,
        None,
    )
    write_map(root / "made", "made")
    serialize_argoverse_scenario_parquet(
        root / "made" / "scenario_made.parquet", scenario
    )
    return root


def write_sensor_log(root: Path, turn: float = 0.6) -> Path:
    """A sensor log whose rear axle drives at 8 m/s along `turn` from (20, 0), with a
    car 10 m ahead and 3.5 m to the left, and a pedestrian who stands in the city."""
    stamps = (315e15 + 1e9 * TIMES).astype(np.int64)
    heading = np.array([np.cos(turn), np.sin(turn)])
    place = np.array([20.0, 0.0]) + 8 * TIMES[:, None] * heading
    poses = {
        "timestamp_ns": stamps,
        "qw": np.cos(turn / 2),
        "qx": 0.0,
        "qy": 0.0,
        "qz": np.sin(turn / 2),
    }
    poses |= {"tx_m": place[:, 0], "ty_m": place[:, 1], "tz_m": 4.0}
    back = np.array([[heading[0], heading[1]], [-heading[1], heading[0]]])
    stands = (np.array([50.0, 30.0]) - place) @ back.T

    def boxes(
        name: str,
        category: str,
        at: np.ndarray,
        yaw: float,
        size: tuple[float, float],
    ) -> pd.DataFrame:
        half = {"qw": np.cos(yaw / 2), "qx": 0.0, "qy": 0.0, "qz": np.sin(yaw / 2)}
        columns = {
            "timestamp_ns": stamps,
            "track_uuid": name,
            "category": category,
        } | half
        columns |= {
            "length_m": size[0],
            "width_m": size[1],
            "height_m": 1.7,
            "num_interior_pts": 5,
        }
        return pd.DataFrame(columns | {"tx_m": at[:, 0], "ty_m": at[:, 1], "tz_m": 0.0})

    tables = [
        boxes(
            "car",
            "REGULAR_VEHICLE",
            np.tile([10.0, 3.5], (FRAMES, 1)),
            0.0,
            (4.4, 1.8),
        ),
        boxes(
            "person",
            "PEDESTRIAN",
            stands,
            -turn,
            (0.6, 0.5),
        ),
        boxes(
            "ego",
            "EGO_VEHICLE",
            np.zeros((FRAMES, 2)),
            0.0,
            EGO_SIZE,
        ),
    ]
    write_map(root / "log" / "map", "log____PIT_city_1")
    pd.DataFrame(poses).to_feather(root / "log" / "city_SE3_egovehicle.feather")
    pd.concat(tables, ignore_index=True).to_feather(
        root / "log" / "annotations.feather"
    )
    return root


def test_a_scenario_arrives(tmp_path):
    source = Argoverse2Source(str(write_scenario(tmp_path)))
    assert source.logs() == ["made/scenario_made.parquet"]
    (recording,) = source.recordings()
    kinds = dict(
        zip(["7", "AV", "c", "p"], recording.agent_type.tolist(), strict=True)
    )  # tracks in order of name
    assert kinds == {"7": VEHICLE, "AV": VEHICLE, "c": OTHER, "p": PEDESTRIAN}
    assert recording.ego == 1
    assert (recording.scene_id, recording.location, recording.dataset) == (
        "made",
        "austin",
        "argoverse2",
    )
    assert recording.valid.sum(0).tolist() == [FRAMES, FRAMES, FRAMES, 20]
    zeros = np.zeros(FRAMES)
    assert np.allclose(
        recording.states[:, 1], np.stack([20 + 8 * TIMES, zeros, zeros, zeros + 8], 1)
    )
    assert recording.size[1].tolist() == list(EGO_SIZE)
    assert recording.size[0, 0] > 10


def test_the_map_arrives(tmp_path):
    (recording,) = Argoverse2Source(str(write_scenario(tmp_path))).recordings()
    lanes = recording.lanes
    assert set(lanes) == {"1", "2", "3", "4"}  # no bike lane
    assert np.allclose(lanes["4"].points[[0, -1]], [[100, 7.2], [0, 7.2]])
    assert np.isclose(lanes["4"].width, 3.6)
    assert lanes["1"].exits == ["2"]
    assert lanes["1"].left == ["3"]
    assert lanes["3"].right == ["1"]
    assert lanes["3"].left == [] == lanes["4"].left  # oncoming
    (ring,) = recording.drivable
    assert {tuple(point) for point in ring} == {(0, -6), (400, -6), (400, 9), (0, 9)}


def test_boxes_of_a_sensor_log_stand_where_the_vehicle_saw_them(tmp_path):
    turn = 0.6
    (recording,) = Argoverse2Source(str(write_sensor_log(tmp_path, turn))).recordings()
    ahead = np.array([np.cos(turn), np.sin(turn)])
    left = np.array([-np.sin(turn), np.cos(turn)])
    axle = np.array([20.0, 0.0]) + 8 * TIMES[:, None] * ahead
    assert recording.ego == 0
    assert recording.location == "pittsburgh"
    assert recording.states.shape[1] == 3
    assert np.allclose(recording.states[:, 0, :2], axle + AHEAD * ahead)
    assert np.allclose(recording.states[:, 1, :2], axle + 10 * ahead + 3.5 * left)
    assert np.allclose(recording.states[:, :2, 2], turn)
    assert np.allclose(recording.states[:, :2, 3], 8)
    assert np.allclose(recording.states[:, 2], [50, 30, 0, 0], atol=1e-6)
    assert recording.size.tolist() == [list(EGO_SIZE), [4.4, 1.8], [0.6, 0.5]]
    assert recording.agent_type.tolist() == [VEHICLE, VEHICLE, PEDESTRIAN]


def in_map(change):
    def apply(folder: Path) -> None:
        (file,) = folder.glob("log_map_archive_*.json")
        parts = json.loads(file.read_text())
        change(parts)
        file.write_text(json.dumps(parts))

    return apply


def many_rows(folder: Path) -> None:
    (file,) = folder.glob("*.parquet")
    table = pd.read_parquet(file)
    pd.concat([table] * (MAX_ROWS // len(table) + 1)).to_parquet(file)
    assert file.stat().st_size < 1e6


def pipe(folder: Path) -> None:
    (file,) = folder.glob("*.parquet")
    file.unlink()
    os.mkfifo(file)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (many_rows, "rows of 17 columns, unpacked .* cut it"),
        (pipe, "cannot be read: no regular file"),
        (
            in_map(
                lambda parts: [
                    part.update(x="a")
                    for part in parts["drivable_areas"]["9"]["area_boundary"]
                ]
            ),
            "is none",
        ),
        (
            in_map(
                lambda parts: parts["lane_segments"]["1"]["left_lane_boundary"][
                    0
                ].update(x="a")
            ),
            "is none of",
        ),
        (
            in_map(
                lambda parts: parts["lane_segments"].update(
                    {str(k): segment(k, (0, 5), y=0) for k in range(9, 999)}
                )
            ),
            "lanes begin at one place",
        ),
    ],
)
def test_what_would_cost_much_or_is_of_another_type_is_refused(
    tmp_path,
    change,
    message,
):
    change(write_scenario(tmp_path) / "made")
    with pytest.raises(InputError, match=rf"made/scenario_made\.parquet: .*{message}"):
        Argoverse2Source(
            str(tmp_path),
            cache=str(tmp_path / "cache"),
            workers=1,
        ).load()


def test_a_folder_of_both_kinds_makes_scenes(tmp_path):
    write_sensor_log(write_scenario(tmp_path), turn=0.0)
    scenes = Argoverse2Source(
        str(tmp_path),
        cache=str(tmp_path / "cache"),
        workers=1,
    ).load()
    assert scenes.scene_id == ["log", "made"]
    assert scenes.dropped == {}
    assert scenes.scenes["logged_valid"][:, :, 0].all()


@pytest.mark.skipif(
    not RECORDED.is_dir(), reason=f"recorded logs are missing: {RECORDED}"
)
def test_recorded_logs_make_scenes_in_which_the_ego_keeps_to_the_road():
    rows = list(Argoverse2Source(str(RECORDED), workers=1).rows())
    assert len(rows) == 7
    assert not [row.reason for row in rows if row.reason]
    for row in rows:
        scene = {name: torch.from_numpy(value) for name, value in row.scene.items()}
        driven = scene["logged"][scene["logged_valid"][:, 0], 0, :2]
        beyond = off_road(
            driven[None], scene["field"][None], origin=scene["field_origin"][None]
        )
        assert (beyond < 0).all(), row.scene_id
