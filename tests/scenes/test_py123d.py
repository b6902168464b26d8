"""Logs converted by py123d: what its writers wrote arrives in the Recording; files of
strangers import nothing."""

import numpy as np
import pytest

from e2rl.run.errors import InputError
from e2rl.scenes.recording import (
    CYCLIST,
    LIGHT_GREEN,
    LIGHT_RED,
    LIGHT_UNKNOWN,
    OTHER,
    PEDESTRIAN,
    VEHICLE,
)
from e2rl.scenes.source import load_scenes

pytest.importorskip("py123d", reason="data=py123d needs the extra py123d")
import msgpack  # noqa: E402
import pyarrow as pa  # noqa: E402
from py123d import datatypes as d  # noqa: E402
from py123d.api.map.arrow.arrow_map_writer import ArrowMapWriter  # noqa: E402
from py123d.api.scene.arrow.arrow_log_writer import ArrowLogWriter  # noqa: E402
from py123d.api.scene.arrow.utils.log_writer_config import LogWriterConfig  # noqa: E402
from py123d.datatypes.detections.box_detections_metadata import BoxDetectionsSE3Metadata  # noqa: E402
from py123d.datatypes.vehicle_state.ego_state_metadata import EgoStateSE3Metadata  # noqa: E402
from py123d.geometry import (
    BoundingBoxSE3,
    Polyline3D,
    PoseSE3,
)  # noqa: E402
from py123d.parser.base_dataset_parser import ModalitiesSync  # noqa: E402
from py123d.parser.registry import NuPlanBoxDetectionLabel as Label  # noqa: E402

from e2rl.scenes.py123d import PIECE, Py123dSource

EGO = EgoStateSE3Metadata(
    "made",
    2.0,
    5.0,
    1.6,
    3.0,
    PoseSE3(
        1.5,
        0,
        0.5,
        1,
        0,
        0,
        0,
    ),
    PoseSE3(
        0,
        0,
        0,
        1,
        0,
        0,
        0,
    ),
)  # its middle is 1.5 m ahead of its origin
BOXES = BoxDetectionsSE3Metadata(Label)


def turned(
    x,
    y,
    heading,
    height=0.0,
):
    return PoseSE3(
        x,
        y,
        height,
        np.cos(heading / 2),
        0,
        0,
        np.sin(heading / 2),
    )


def box(
    name,
    label,
    x,
    y,
    heading,
    size,
    height=0.0,
):
    shape = BoundingBoxSE3(
        turned(
            x,
            y,
            heading=heading,
            height=height,
        ),
        *size,
        1.5,
    )
    return d.BoxDetectionSE3(d.BoxDetectionAttributes(label, name), shape, None)


def lane(
    number,
    x,
    y,
    kind=d.LaneType.SURFACE_STREET,
    **more,
):
    """A lane of 3.6 m along +x, or along -x where x falls."""
    side = 1.8 if x[1] > x[0] else -1.8
    lines = [
        Polyline3D.from_array(np.array([[at, y + off, 1.0] for at in x], float))
        for off in (side, -side, 0)
    ]
    return d.Lane(
        number,
        kind,
        *lines,
        speed_limit_mps=13.5,
        **more,
    )


def write_map(root, location="town"):
    about = d.MapMetadata(
        "made",
        location,
        map_has_z=True,
        map_is_per_log=False,
    )
    writer = ArrowMapWriter(False, root / "maps", root / "logs")
    assert writer.reset(about)
    for part in (
        lane(
            1,
            (0, 100),
            y=0,
            successor_ids=[2, 99],
            left_lane_id=3,
        ),
        lane(
            2,
            (100, 700),
            y=0,
            predecessor_ids=[1],
        ),
        lane(
            3,
            (0, 100),
            y=3.6,
            left_lane_id=4,
            right_lane_id=1,
        ),
        lane(
            4,
            (100, 0),
            y=7.2,
            left_lane_id=3,
        ),  # oncoming
        lane(
            5,
            (0, 100),
            y=-3.6,
            kind=d.LaneType.BIKE_LANE,
        ),
        lane(6, (9000, 9100), y=0),  # elsewhere in town
        d.GenericDrivable(
            9,
            outline=Polyline3D.from_array(
                np.array([[0, -6, 0], [700, -6, 0], [700, 9, 0], [0, 9, 0.0]])
            ),
        ),
    ):
        writer.write_map_object(part)
    writer.close()
    return about


def write_log(
    root,
    name="log",
    seconds=12.0,
    rate=10.0,
    location="town",
    about=None,
    pauses=(),
):
    """The ego at 8 m/s from x = 20 m, a truck that turns, a cyclist, a pedestrian for 2
    s, a cone, a sign; a light.

    Nothing is there between the times of pauses [(begin, end)] in s.
    """
    writer = ArrowLogWriter(LogWriterConfig(), root / "logs", root / "sensors")
    assert writer.reset(
        d.LogMetadata(
            "made",
            "made_val",
            name,
            location,
            about,
        )
    )
    for step in range(int(seconds * rate) + 1):
        time = step / rate
        if any(begin < time < end for begin, end in pauses):
            continue
        stamp = d.Timestamp.from_us(1_000_000_000 + round(1e6 * time))
        ego = d.EgoStateSE3.from_imu(
            turned(20 + 8 * time - 1.5, 0, heading=0), EGO, stamp
        )
        items = [
            box(
                "truck",
                Label.VEHICLE,
                x=60 + 6 * time,
                y=3.6,
                heading=0.02 * time,
                size=(9.0, 2.5),
                height=0.05 * time,
            ),
            box(
                "rider",
                Label.BICYCLE,
                x=30 + 4 * time,
                y=-4,
                heading=0,
                size=(1.8, 0.7),
            ),
            box(
                "cone",
                Label.TRAFFIC_CONE,
                x=70,
                y=-5,
                heading=0,
                size=(0.4, 0.4),
            ),
            box(
                "sign",
                Label.CZONE_SIGN,
                x=80,
                y=-5,
                heading=0,
                size=(0.4, 0.4),
            ),
        ]
        if time < 2:
            items.append(
                box(
                    "walker",
                    Label.PEDESTRIAN,
                    x=40,
                    y=-7 + time,
                    heading=1.5,
                    size=(0.6, 0.5),
                )
            )
        green = d.TrafficLightStatus.GREEN if time >= 4 else d.TrafficLightStatus.RED
        lights = [
            d.TrafficLightDetection(2, green),
            d.TrafficLightDetection(3, d.TrafficLightStatus.OFF),
        ]
        parts = [
            ego,
            d.BoxDetectionsSE3(items, stamp, BOXES),
            d.TrafficLightDetections(lights, stamp),
        ]
        writer.write_sync(ModalitiesSync(stamp, parts))
    writer.close()
    return root


def recordings(root, path=None):
    source = Py123dSource(path=str(path or root))
    items = []
    for log in source.logs():
        with source.named(log):
            items += source.read(log)
    return items


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    root = tmp_path_factory.mktemp("made")
    write_map(root)
    return write_log(root)


def rows_of(recording):
    """{type: row} of the only agents of their type beside the ego."""
    return {int(kind): row for row, kind in enumerate(recording.agent_type) if row}


def test_tracks_arrive_as_they_were_written(made):
    (recording,) = recordings(made)
    assert (recording.scene_id, recording.location, recording.dataset) == (
        "log",
        "town",
        "made",
    )
    assert recording.states.shape == (121, 5, 4)
    assert recording.ego == 0
    assert recording.current is None
    row = rows_of(recording)
    time = 0.1 * np.arange(121)
    assert set(row) == {VEHICLE, CYCLIST, PEDESTRIAN, OTHER}, "signs are left out"
    assert np.allclose(
        recording.states[:, 0],
        np.stack([20 + 8 * time, 0 * time, 0 * time, 0 * time + 8], 1),
        atol=1e-6,
    )
    truck = recording.states[:, row[VEHICLE]]
    assert np.allclose(truck[:, 0], 60 + 6 * time)
    assert np.allclose(truck[:, 2], 0.02 * time, atol=1e-6)
    height = recording.heights
    assert np.allclose(height[:, 0], 0.5)
    assert np.allclose(height[:, row[VEHICLE]], 0.05 * time, atol=1e-6)
    assert recording.size[[0, row[VEHICLE], row[CYCLIST]]].tolist() == [
        [5, 2],
        [9, 2.5],
        [1.8, 0.7],
    ]
    assert recording.valid[:, row[PEDESTRIAN]].sum() == 20
    assert recording.valid[:, :3].all()
    assert set(recording.lights) == {"2", "3"}
    assert (recording.lights["3"] == LIGHT_UNKNOWN).all()
    assert (recording.lights["2"][:40] == LIGHT_RED).all()
    assert (recording.lights["2"][40:] == LIGHT_GREEN).all()


def test_the_map_is_that_around_the_ego_s_way(made):
    (recording,) = recordings(made)
    lanes = recording.lanes
    assert set(lanes) == {"1", "2", "3", "4"}, "no bicycle lane, nothing of elsewhere"
    assert lanes["1"].exits == ["2"]
    assert lanes["1"].left == ["3"]
    assert lanes["3"].right == ["1"]
    assert lanes["3"].left == []
    assert lanes["1"].points.tolist() == [[0, 0], [100, 0]]
    assert lanes["1"].heights.tolist() == [1, 1]
    assert lanes["4"].points[0].tolist() == [100, 7.2]
    assert lanes["1"].width == pytest.approx(3.6)
    assert lanes["1"].speed_limit == pytest.approx(13.5)
    assert len(recording.drivable) == 1
    assert recording.drivable[0][:4].tolist() == [
        [0, -6],
        [700, -6],
        [700, 9],
        [0, 9],
    ]


@pytest.mark.parametrize("rate", [2.0, 20.0])
def test_other_rates_come_out_at_10_hz(tmp_path, rate):
    write_map(tmp_path)
    (recording,) = recordings(write_log(tmp_path, rate=rate))
    time = 0.1 * np.arange(121)
    assert np.allclose(recording.states[:, 0, 0], 20 + 8 * time, atol=1e-3)
    assert recording.valid[:, 0].all()
    assert (recording.lights["2"][42:] == LIGHT_GREEN).all()
    assert (recording.lights["2"][:38] == LIGHT_RED).all()


def test_a_long_log_is_cut_into_pieces(tmp_path):
    write_map(tmp_path)
    pieces = recordings(write_log(tmp_path, seconds=45.0))
    assert [piece.scene_id for piece in pieces] == ["log#0", "log#1"]
    assert [len(piece.states) for piece in pieces] == [201, 201]
    assert pieces[1].states[0, 0, 0] == pytest.approx(20 + 8 * PIECE)


def test_a_log_is_cut_at_its_pauses(tmp_path):
    write_map(tmp_path)
    log = write_log(
        tmp_path,
        seconds=78.0,
        pauses=[(12.0, 30.0), (30.15, 35.0)],
    )
    pieces = recordings(log)
    assert [piece.scene_id for piece in pieces] == ["log#0", "log#1", "log#2"]
    assert [len(piece.states) for piece in pieces] == [121, 201, 201], (
        "nothing of the 0.1 s between the pauses"
    )
    assert [piece.states[0, 0, 0] for piece in pieces] == pytest.approx(
        [20, 20 + 8 * 35, 20 + 8 * 55]
    )
    assert all(piece.valid[:, 0].all() for piece in pieces)


def test_a_log_of_1_hz_has_no_pauses(tmp_path):
    write_map(tmp_path)
    assert (
        len(
            recordings(
                write_log(
                    tmp_path,
                    rate=0.9,
                    seconds=20.0,
                )
            )
        )
        == 1
    )


def test_it_makes_scenes_from_the_root_and_from_a_split(made, tmp_path):
    build = {"field_cells": 64, "steps": 80}
    for path in (made, made / "logs" / "made_val"):
        data = {
            "_target_": "e2rl.scenes.py123d.Py123dSource",
            "path": str(path),
            "cache": str(tmp_path),
            "workers": 1,
        }
        scenes = load_scenes(data | {"build": build})
        assert scenes.scene_id == ["log"]
        assert scenes.dataset == "made"
        assert scenes.location == ["town"]
        assert scenes.split == path.name
        assert len(scenes.files) == 64


@pytest.mark.parametrize("file", ["box_detections_se3.arrow", "custom.x.arrow"])
def test_a_stranger_s_log_imports_no_code(
    tmp_path,
    file,
    monkeypatch,
):
    """py123d imports the module that a file's metadata name; here it would be one
    beside the user's files."""
    write_map(tmp_path)
    root = write_log(tmp_path)
    path = root / "logs" / "made_val" / "log" / file
    source = path if path.is_file() else path.with_name("box_detections_se3.arrow")
    with pa.memory_map(str(source)) as content:
        table = pa.ipc.open_file(content).read_all()
    about = msgpack.packb({"box_detection_label_class": "evil_module.Label"})
    table = table.replace_schema_metadata({b"metadata": about})
    path.unlink(missing_ok=True)
    with (
        pa.OSFile(str(path), "wb") as sink,
        pa.ipc.new_file(sink, table.schema) as writer,
    ):
        writer.write_table(table)
    (tmp_path / "evil_module.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(InputError, match=rf"{file} names the code evil_module\.Label"):
        recordings(tmp_path)
    assert not (tmp_path / "ran").exists()
