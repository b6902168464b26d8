"""ScenarioDescription files: nothing in them is ever run, and what they say arrives in
the Recording."""

import os
import pickle
import struct
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from e2rl.run.errors import InputError
from e2rl.scenes.log_files import MAX_BYTES
from e2rl.scenes.recording import (
    LIGHT_GREEN,
    LIGHT_RED,
    LIGHT_UNKNOWN,
    LIGHT_YELLOW,
    OTHER,
    PEDESTRIAN,
    VEHICLE,
)
from e2rl.scenes.scenarionet import ScenarioNetSource
from tests.scenes.descriptions import (
    ALL,
    FRAMES,
    description,
    fork,
    recordings_in,
    straight,
    write_folder,
    write_zip,
)


def read(scene: dict, starts=None) -> list:
    return recordings_in(ScenarioNetSource, pickle.dumps(scene), starts=starts)


def contents(path: Path) -> list[bytes]:
    source = ScenarioNetSource(str(path))
    return [source.content(log) for log in source.logs()]


def test_folders_and_zips_hold_the_same_scenes_and_an_index_beside_them_their_places(
    tmp_path,
):
    scenes = [description(), description(scenario_id="other")]
    folder = write_folder(tmp_path / "data" / "part", scenes).parent
    (folder / "dataset_summary.pkl").write_bytes(b"summary")
    (folder / "notes.txt").write_text("x")
    expected = contents(folder)
    assert len(expected) == 2
    for method in (zipfile.ZIP_LZMA, zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED):
        path = write_zip(tmp_path / f"{method}.zip", scenes, method=method)
        assert contents(path) == expected
    assert ScenarioNetSource(str(path)).locations == {}
    (tmp_path / "index.csv").write_text("file,location_group\npart/sd_00.pkl,17\n")
    assert ScenarioNetSource(str(path)).locations == {"sd_00": "17"}
    assert [
        recording.location for recording in ScenarioNetSource(str(path)).recordings()
    ] == ["17", ""]
    (tmp_path / "index.csv").write_text("name\nx\n")
    assert ScenarioNetSource(str(path)).locations == {}


def test_what_is_no_regular_file_is_named_or_passed_over(tmp_path):
    folder = write_folder(tmp_path / "x", [description()])
    (folder / "folder.pkl").mkdir()
    os.mkfifo(folder / "pipe.pkl")
    (folder / "nothing.pkl").symlink_to(folder / "nowhere")
    source = ScenarioNetSource(
        str(folder),
        cache=str(tmp_path / "cache"),
        workers=1,
        skip_invalid=True,
    )
    assert source.logs() == ["nothing.pkl", "pipe.pkl", "sd_00.pkl"]
    for log in source.logs()[:2]:
        with pytest.raises(
            InputError,
            match=f"{log} in .*x: cannot be read: (no regular file|No such file)",
        ):
            source.content(log)
    assert source.load().dropped == {"invalid": 2}
    with pytest.raises(InputError, match="neither a folder nor a zip file"):
        ScenarioNetSource(str(folder / "pipe.pkl")).logs()


@pytest.mark.parametrize(
    ("method", "claimed"),
    [(zipfile.ZIP_LZMA, 1000), (zipfile.ZIP_BZIP2, 1000), (zipfile.ZIP_DEFLATED, None)],
)
def test_a_bomb_is_not_unpacked(
    tmp_path,
    method,
    claimed,
):
    """Neither where the zip says how much would come out, nor where it lies."""
    path = tmp_path / "bomb.zip"
    size = 3 * MAX_BYTES
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.writestr("bomb.pkl", bytes(size))
    if claimed:
        path.write_bytes(
            path.read_bytes().replace(
                struct.pack("<I", size), struct.pack("<I", claimed)
            )
        )
    tracemalloc.start()
    try:
        with pytest.raises(
            InputError, match=r"bomb\.pkl in .*bomb\.zip: cannot be read"
        ):
            ScenarioNetSource(str(path)).content("bomb.pkl")
        assert tracemalloc.get_traced_memory()[1] < 2 * MAX_BYTES
    finally:
        tracemalloc.stop()


def test_a_damaged_zip_is_named(tmp_path):
    path = write_zip(tmp_path / "x.zip", [description()])
    torn = bytearray(path.read_bytes())
    torn[200:400] = bytes(200)
    (tmp_path / "torn.zip").write_bytes(torn)
    with pytest.raises(InputError, match=r"sd_00\.pkl in .*torn\.zip: cannot be read"):
        contents(tmp_path / "torn.zip")
    content = path.read_bytes()
    place = content.index(b"PK\x01\x02")
    path.write_bytes(content[:place] + b"XXXX" + content[place + 4 :])
    with pytest.raises(InputError, match="damaged zip"):
        ScenarioNetSource(str(path)).logs()


def test_tracks_types_sizes_and_the_map_arrive():
    tracks = {
        "ego": straight(20, 0, speed=8),
        5: straight(
            40,
            0,
            speed=6,
            size=(1.7, 4.1),
        ),
        "cone": straight(
            60,
            0,
            speed=0,
            kind="TRAFFIC_CONE",
        ),
        "p": straight(
            0,
            9,
            speed=1,
            kind="PEDESTRIAN",
            size=(0.5, 0.6),
        ),
    }
    tracks["p"]["state"]["valid"] = np.where(ALL < 30, 1.0, 0.0)[
        :, None
    ]  # as nuScenes files have it
    tracks["p"]["state"]["length"] = tracks["p"]["state"]["length"][:, None]
    tracks["p"]["state"]["position"][30:] = np.nan
    (recording,) = read(description(tracks))
    assert recording.validate_log() is recording
    assert (
        recording.scene_id,
        recording.location,
    ) == ("fork", "place")
    assert recording.dataset == "made"
    assert recording.current == 10
    assert recording.ego == 0
    assert recording.agent_type.tolist() == [VEHICLE, VEHICLE, OTHER, PEDESTRIAN]
    assert recording.size.tolist() == [
        [4.5, 1.9],
        [4.1, 1.7],
        [4.5, 1.9],
        [0.5, 0.6],
    ]  # a car is longer than wide
    assert recording.valid.sum(0).tolist() == [91, 91, 91, 30]
    assert np.isfinite(recording.states).all()
    assert np.allclose(
        recording.states[:, 0],
        np.stack([20 + 0.8 * ALL, 0 * ALL, 0 * ALL, 0 * ALL + 8], 1),
    )
    assert set(recording.lanes) == {
        "in",
        "on",
        "left",
        "near",
    }  # no bike lane, no single point
    assert recording.lanes["in"].exits == ["on", "left"]
    assert recording.lanes["in"].width == 3.6
    assert np.isclose(recording.lanes["on"].speed_limit, 20.0)


def test_lane_polygons_are_drivable_and_neighbours_named():
    lanes = fork()
    lanes["in"] |= {
        "polygon": np.array([[0, -2, 0], [100, -2, 0], [100, 2, 0]]),
        "left_neighbor": [{"feature_id": "near"}],
        "right_neighbor": ["bike"],
    }
    (recording,) = read(description(lanes=lanes))
    assert [ring.tolist() for ring in recording.drivable] == [
        [[0, -2], [100, -2], [100, 2]]
    ]
    assert recording.lanes["in"].left == ["near"]
    assert recording.lanes["in"].right == ["bike"]
    assert recording.lanes["in"].heights is None
    assert recording.lanes["on"].heights is not None


def test_lights_keep_their_last_known_state():
    states = [
        "LANE_STATE_UNKNOWN",
        "LANE_STATE_ARROW_STOP",
        None,
        "LANE_STATE_CAUTION",
        "LANE_STATE_GO",
    ]
    scene = description() | {
        "dynamic_map_states": {
            "a": {"lane": "on", "state": {"object_state": states}},
            "left": {"state": {"object_state": ["TRAFFIC_LIGHT_RED"]}},
            "b": {"lane": "nowhere", "state": {"object_state": states}},
            "near": {"state": {}},
        }
    }
    (recording,) = read(scene)
    assert recording.lights.keys() == {"on", "left", "near"}
    names = [
        LIGHT_UNKNOWN,
        LIGHT_RED,
        LIGHT_RED,
        LIGHT_YELLOW,
        LIGHT_GREEN,
        LIGHT_GREEN,
    ]
    assert recording.lights["on"][:6].tolist() == names
    assert (recording.lights["left"] == LIGHT_RED).all()
    assert (recording.lights["near"] == LIGHT_UNKNOWN).all()
    assert all(len(light) == FRAMES for light in recording.lights.values())


@pytest.mark.parametrize(
    ("limit", "expected"),
    [
        ({"speed_limit_kmh": 36}, 10.0),
        ({"speed_limit_mps": 10.0}, 10.0),
        ({"speed_limit_mph": 25.0}, 11.176),
        ({"speed_limit_kmh": None, "speed_limit_mps": 10.0}, 10.0),
        ({"speed_limit_kmh": 0, "speed_limit_mph": "25 mph"}, 11.176),
        ({"speed_limit_kmh": "36"}, 10.0),
        ({"speed_limit_kmh": ["none", 72, "36"]}, 10.0),
        ({"speed_limit_kmh": np.array([36.0, np.nan])}, 10.0),
        *(
            ({"speed_limit_kmh": value}, 0.0)
            for value in (None, -1.0, "", "none", [], np.inf, np.nan)
        ),
        ({}, 0.0),
    ],
)
def test_a_limit_is_read_in_every_unit_and_form(limit, expected):
    lanes = fork()
    del lanes["on"]["speed_limit_kmh"]
    lanes["on"] |= limit
    (recording,) = read(description(lanes=lanes))
    assert np.isclose(recording.lanes["on"].speed_limit, expected)


@pytest.mark.parametrize(
    ("name", "colour"),
    [
        *(
            ("LANE_STATE_" + name, LIGHT_UNKNOWN)
            for name in ("FLASHING_STOP", "FLASHING_CAUTION")
        ),
        *(
            ("LANE_STATE_ARROW_" + name, colour)
            for name, colour in (("STOP", LIGHT_RED), ("GO", LIGHT_GREEN))
        ),
        ("LANE_STATE_ARROW_CAUTION", LIGHT_YELLOW),
        ("TRAFFIC_LIGHT_OFF", LIGHT_UNKNOWN),
        *(
            ("TRAFFIC_LIGHT_" + name, colour)
            for name, colour in (("YELLOW", LIGHT_YELLOW), ("RED", LIGHT_RED))
        ),
        *((name, LIGHT_RED) for name in ("red_yellow", "redYellow")),
    ],
)
def test_a_light_that_flashes_binds_nobody_and_arrows_are_their_colours(name, colour):
    """After a solid red, which does not go on."""
    states = {"on": {"state": {"object_state": ["LANE_STATE_STOP", name]}}}
    (recording,) = read(description() | {"dynamic_map_states": states})
    assert recording.lights["on"][0] == LIGHT_RED
    assert (recording.lights["on"][1:] == colour).all()


def test_skipped_time_stamps_move_start_frame_and_lights():
    scene = description(ts=np.where(ALL > 4, ALL + 2, ALL) * 0.1 + 77.0)
    tracks = scene["tracks"]["ego"]["state"]
    tracks["position"][5:, 0] += 1.6  # 0.2 s at 8 m/s
    scene["dynamic_map_states"] = {
        "on": {
            "state": {"object_state": ["LANE_STATE_GO"] * 5 + ["LANE_STATE_STOP"] * 86}
        }
    }
    (recording,) = read(scene)
    assert len(recording.states) == 93
    assert recording.current == 12
    assert recording.valid[:, 0].all()
    assert np.allclose(recording.states[:, 0, 0], 20 + 0.8 * np.arange(93), atol=1e-6)
    assert np.flatnonzero(np.diff(recording.lights["on"])).tolist() == [6]
    assert len(recording.lights["on"]) == 93


def test_start_frames():
    assert [r.scene_id for r in read(description(), [10, 30, 50, 90])] == [
        "fork@10",
        "fork@30",
        "fork@50",
    ]
    (recording,) = read(description(current_time_index=12))
    assert recording.current == 12
    assert recording.scene_id == "fork"
    long = description()
    del long["metadata"]["current_time_index"]
    assert [r.current for r in read(long)] == [10]

    def repeat(value):
        return (
            np.concatenate([value, value, value])
            if isinstance(value, np.ndarray)
            else value
        )  # noqa: E731

    for track in long["tracks"].values():
        track["state"] = {key: repeat(value) for key, value in track["state"].items()}
    long["metadata"]["ts"] = np.arange(273) * 0.1
    assert [r.current for r in read(long)] == [10, 101, 192]


def long_description(**metadata) -> dict:
    """27.3 s, in which the ego waits three times where it began."""
    scene = description(
        ts=np.arange(273) * 0.1,
        **metadata,
    )
    for agent in scene["tracks"].values():
        agent["state"] = {
            key: np.concatenate([value] * 3) for key, value in agent["state"].items()
        }
    return scene


@pytest.mark.parametrize(
    ("named", "start"),
    [(0, 10), (3, 10), (9, 10), (10, 10), (40, 40), (233, 233), (250, 10)],
)
def test_a_start_frame_with_too_little_past_or_future_is_moved_and_that_is_counted(
    named, start
):
    (recording,) = read(long_description(current_time_index=named))
    assert recording.current == start
    assert recording.scene_id == "fork"
    assert sum(recording.repairs.values()) == (named != start)


def test_a_moved_start_frame_is_where_the_ego_has_been_for_a_second():
    scene = long_description(current_time_index=0)
    scene["tracks"]["ego"]["state"]["valid"] = np.arange(273) >= 25
    (recording,) = read(scene)
    assert recording.current == 35


@pytest.mark.parametrize(
    "form", ["columns", "three numbers", "metadata", "scalars", "metadata size"]
)
def test_sizes_are_read_wherever_converters_write_them(form):
    scene = description()
    for agent in scene["tracks"].values():
        state = agent["state"]
        length = float(state.pop("length")[0])
        width = float(state.pop("width")[0])
        if form == "columns":
            state["size"] = np.tile([length, width, 1.5], (FRAMES, 1))
        elif form == "three numbers":
            state["size"] = [length, width, 1.5]
        elif form == "scalars":
            state |= {"length": length, "width": width}
        else:
            agent["metadata"] = (
                {"length": length, "width": width}
                if form == "metadata"
                else {"size": [length, width]}
            )
    (recording,) = read(scene)
    assert recording.size.tolist() == [[4.5, 1.9], [4.5, 1.9], [0.6, 0.6]]
    assert not recording.repairs


@pytest.mark.parametrize("value", [None, 0.0, np.nan])
def test_a_size_that_is_missing_or_not_positive_is_the_usual_one_of_the_type(value):
    kinds = {
        "VEHICLE": (4.6, 1.9),
        "TRAFFIC_CONE": (0.4, 0.4),
        "TRAFFIC_BARRIER": (2.0, 0.5),
        "PEDESTRIAN": (0.7, 0.7),
    }
    others = {
        kind: straight(
            50 + 10 * number,
            -6,
            speed=0,
            kind=kind,
        )
        for number, kind in enumerate(kinds)
    }
    for agent in others.values():
        for name in ("length", "width"):
            agent["state"].pop(name)
            if value is not None:
                agent["state"][name] = np.full(FRAMES, value)
    (recording,) = read(description({"ego": straight(20, 0, speed=8)} | others))
    assert recording.validate_log().size[1:].tolist() == [
        list(size) for size in kinds.values()
    ]
    assert sum(recording.repairs.values()) == len(kinds)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda s: s["metadata"].update(sdc_id="nobody"),
            r"no ego: metadata\.sdc_id='nobody'",
        ),
        (lambda s: s.update(metadata=3), "is none of ScenarioDescription pickles"),
        (
            lambda s: s["tracks"]["7"]["state"]["position"].fill(np.nan),
            "track 7 is NaN or infinite at frame 0",
        ),
        (
            lambda s: s["metadata"].update(ts=ALL[::-1] * 0.1),
            "time stamps do not increase",
        ),
        (
            lambda s: s["metadata"].update(current_time_index=-80),
            "current_time_index=-80 is no frame of 91",
        ),
        (
            lambda s: s["metadata"].update(ts=np.append(ALL[:90] * 0.1, 1e9)),
            "scene 'fork': 3e.10 frames x agents",
        ),
        (
            lambda s: s.update(
                id=["x"] * 200,
                metadata=s["metadata"] | {"scenario_id": "y"},
            ),
            "it has no id",
        ),
        (
            lambda s: s["tracks"].update({7: s["tracks"]["7"]}),
            "two of its tracks have the id '7'",
        ),
        (
            lambda s: s["tracks"]["7"].update(type="SPACESHIP"),
            "track 7 is of the unknown type 'SPACESHIP'; known are",
        ),
    ],
)
def test_what_is_wrong_is_named_with_the_file(change, message):
    scene = description()
    change(scene)
    with pytest.raises(InputError, match=rf"^made\.pkl: {message}"):
        read(scene)


def test_a_light_without_states_is_unknown():
    scene = description() | {
        "dynamic_map_states": {"on": {"state": {"object_state": None}}}
    }
    (recording,) = read(scene)
    assert (recording.lights["on"] == LIGHT_UNKNOWN).all()
