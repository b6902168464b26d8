"""SUMO runs: what nets and FCD outputs say arrives in the Recording, and nonsense is
refused by name."""

from math import sqrt

import numpy as np
import pytest

from e2rl.run.errors import InputError
from e2rl.scenes.recording import (
    CYCLIST,
    LIGHT_GREEN,
    LIGHT_RED,
    LIGHT_UNKNOWN,
    PEDESTRIAN,
    VEHICLE,
)
from e2rl.scenes.source import open_source

pytest.importorskip("sumolib", reason="data=sumo needs the extra sumo")
from e2rl.scenes.sumo import JUMPED, Net, SumoSource  # noqa: E402

# Two lanes beside a footpath lead over a junction with a light into one lane.
NET = """<net version="1.20"{}>
  <location netOffset="0,0" convBoundary="0,0,200,0" origBoundary="0,0,1,1" projParameter="!"/>
  <edge id=":j_0" function="internal">
    <lane id=":j_0_0" index="0" speed="9" length="10" shape="100,-4.8 110,-4.8"/></edge>
  <edge id="in" from="a" to="j" priority="1">
    <lane id="in_0" index="0" allow="pedestrian" speed="13" length="100" width="2" shape="0,-7.4 100,-7.4"/>
    <lane id="in_1" index="1" speed="13" length="100" shape="0,-4.8 100,-4.8"/>
    <lane id="in_2" index="2" speed="13" length="100" shape="0,-1.6 100,-1.6"/></edge>
  <edge id="out" from="j" to="b" priority="1">
    <lane id="out_0" index="0" speed="20" length="90" shape="110,-4.8 200,-4.8"/></edge>
  <junction id="a" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape="0,0 0,-8.4"/>
  <junction id="j" type="traffic_light" x="105" y="0" incLanes="in_1 in_2" intLanes=":j_0_0" shape="100,0 110,0 110,-6.4 100,-8.4"/>
  <junction id="b" type="dead_end" x="200" y="0" incLanes="out_0" intLanes="" shape="200,0 200,-6"/>
  <connection from="in" to="out" fromLane="1" toLane="0" via=":j_0_0" tl="j" linkIndex="1" dir="s" state="o"/>
  <connection from=":j_0" to="out" fromLane="0" toLane="0" dir="s" state="M"/>
</net>"""
TYPES = """<routes><vType id="van" vClass="delivery" width="2"/>
  <vTypeDistribution id="mix"><vType id="short" length="3.5"/></vTypeDistribution></routes>"""
FRAMES = 60


def body(kind: str, name: str, x: float, y: float, **values) -> str:
    angle = values.get("angle", 90)
    return (
        f'<{kind} id="{name}" x="{x:.2f}" y="{y:.2f}" angle="{angle}" '
        f'type="{values.get("type", "DEFAULT_VEHTYPE")}" speed="{values.get("speed", 5)}"/>'
    )


def fcd(*tracks, frames: int = FRAMES, dt: float = 0.1) -> str:
    """An output in which each of `tracks` tells its element at a time, or None."""
    steps = []
    for frame in range(frames):
        inner = "".join(filter(None, (track(frame * dt) for track in tracks)))
        steps.append(f'<timestep time="{7 + frame * dt:.2f}">{inner}</timestep>')
    return f"<fcd-export>{''.join(steps)}</fcd-export>"


def drives(name: str = "car", y: float = -4.8, speed: float = 5.0, **values):
    return lambda t: body("vehicle", name, 20 + speed * t, y, speed=speed, **values)


def folder_of(path, output: str, **files: str):
    """A folder with an output, the net, the types, and other files."""
    files = {
        "n.net.xml": NET.format(""),
        "t.rou.xml": TYPES,
        "fcd.xml": output,
        **{name.replace("_", "."): text for name, text in files.items()},
    }
    for name, text in files.items():
        (path / name).write_text(text)
    return path


def read(path, output: str, **files: str):
    source = SumoSource(str(folder_of(path, output, **files)))
    (recording,) = source.read("fcd.xml")
    return recording


def test_the_position_is_the_front_bumper_and_the_angle_that_of_a_compass(tmp_path):
    def north_east(t: float) -> str:
        return body(
            "vehicle",
            "van",
            50 + 5 * t / sqrt(2),
            5 * t / sqrt(2),
            angle=45,
            type="van",
        )

    recording = read(tmp_path, fcd(drives(), north_east))
    car, van = recording.states[20]
    assert car == pytest.approx([20 + 5 * 2 - 2.5, -4.8, 0.0, 5.0], abs=0.01)
    back = (5 * 2 - 6.5 / 2) / sqrt(2)
    assert van == pytest.approx([50 + back, back, np.pi / 4, 5.0], abs=0.01)
    assert recording.size.tolist() == [[5.0, 1.8], [6.5, 2.0]]


def test_lanes_have_the_links_neighbours_and_limits_of_the_net(tmp_path):
    lanes = read(tmp_path, fcd(drives())).lanes
    assert set(lanes) == {"in_1", "in_2", ":j_0_0", "out_0"}  # no footpath
    assert lanes["in_1"].exits == [":j_0_0"]
    assert lanes[":j_0_0"].exits == ["out_0"]
    assert (lanes["in_1"].left, lanes["in_1"].right) == (["in_2"], [])
    assert (lanes["in_2"].left, lanes["in_2"].right) == ([], ["in_1"])
    assert (lanes["in_1"].width, lanes["in_1"].speed_limit) == (3.2, 13.0)
    mirrored = Net(NET.format(' lefthand="true"').encode()).lanes
    assert (mirrored["in_1"].left, mirrored["in_1"].right) == ([], ["in_2"])


def test_lights_let_into_the_lane_of_their_link(tmp_path):
    states = [(7.0 + 2.0, "Gr"), (7.0 + 4.0, "rG")]
    tls = "".join(
        f'<tlsState time="{time}" id="j" programID="0" phase="0" state="{state}"/>'
        for time, state in states
    )
    lights = read(
        tmp_path, fcd(drives()), tls_xml=f"<tlsStates>{tls}</tlsStates>"
    ).lights
    assert set(lights) == {":j_0_0"}
    assert lights[":j_0_0"][[19, 20, 39, 40]].tolist() == [
        LIGHT_UNKNOWN,
        LIGHT_RED,
        LIGHT_RED,
        LIGHT_GREEN,
    ]


def test_who_rides_in_a_vehicle_is_no_pedestrian(tmp_path):
    def rider(t: float) -> str:
        x = 20 + 5 * max(t, 3.0)  # waits for the car
        return body("person", "p", x, -4.8, type="DEFAULT_PEDTYPE")

    def walker(t: float) -> str:
        return body("person", "w", 30 + t, -7.4, type="DEFAULT_PEDTYPE", speed=1)

    bike = drives("b", y=-5.5, type="DEFAULT_BIKETYPE")
    train = drives("t", y=40.0, type="DEFAULT_RAILTYPE")
    recording = read(tmp_path, fcd(drives(), rider, walker, bike, train))
    kinds = recording.agent_type.tolist()
    assert kinds == [VEHICLE, CYCLIST, PEDESTRIAN, PEDESTRIAN]  # no train
    present = recording.valid.sum(0)
    assert present.tolist() == [FRAMES, FRAMES, 30, FRAMES]


def test_a_teleport_makes_another_vehicle_and_a_jump_sideways_is_told(tmp_path):
    def teleports(t: float) -> str:
        return body("vehicle", "a", 20 + 5 * t + (60 if t > 2.95 else 0), -4.8)

    def changes(t: float) -> str:
        return body("vehicle", "b", 40 + 5 * t, -4.8 if t < 2.95 else -1.6)

    recording = read(tmp_path, fcd(teleports, changes))
    assert recording.valid.sum(0).tolist() == [30, 30, FRAMES]
    assert recording.repairs == {JUMPED: 1}


def test_the_ego_is_named_so_or_drives_farthest(tmp_path):
    fast = drives("fast", y=-1.6, speed=9.0)
    assert read(tmp_path, fcd(drives(), fast)).ego == 1
    assert read(tmp_path, fcd(fast, drives("Ego"))).ego == 1


def test_heights_of_tracks_and_lanes_tell_levels(tmp_path):
    def climbs(t: float) -> str:
        car = body("vehicle", "car", 20 + 5 * t, -4.8)
        return car.replace(" angle", f' z="{t:.1f}" angle')

    net = NET.format("").replace("110,-4.8 200,-4.8", "110,-4.8,6 200,-4.8,6")
    recording = read(tmp_path, fcd(climbs), n_net_xml=net)
    assert recording.heights[[0, 20], 0] == pytest.approx([0.0, 2.0])
    assert recording.lanes["out_0"].heights.tolist() == [6.0, 6.0]


def test_steps_of_a_second_are_interpolated(tmp_path):
    recording = read(tmp_path, fcd(drives(), frames=20, dt=1.0))
    assert len(recording.states) == 191
    assert recording.states[25, 0] == pytest.approx([30.0, -4.8, 0.0, 5.0])


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        (
            "n_net_xml",
            '<!DOCTYPE net [<!ENTITY a "b">]>' + NET.format(""),
            "document type",
        ),
        ("t_rou_xml", '<!DOCTYPE routes SYSTEM "x">' + TYPES, "document type"),
        ("fcd_xml", '<!DOCTYPE f [<!ENTITY a "b">]>' + fcd(drives()), "document type"),
        ("fcd_xml", fcd(drives(type="lorry")), "'lorry' is in no .rou.xml"),
        ("fcd_xml", fcd(), "nobody on the road"),
        ("fcd_xml", fcd(drives())[:500], "run SUMO again"),
        ("fcd_xml", fcd(drives()).replace(' angle="90"', "", 1), "run SUMO again"),
        ("other_net_xml", NET.format(""), "2 files .net.xml beside it"),
    ],
)
def test_what_cannot_be_read_is_refused_by_name(tmp_path, file, text, message):
    source = SumoSource(str(folder_of(tmp_path, fcd(drives()), **{file: text})))
    with pytest.raises(InputError, match=message) as error:
        list(source.recordings())
    assert str(error.value).startswith("fcd.xml")


def test_a_log_has_the_files_of_its_own_name_before_those_of_its_folder(tmp_path):
    wide = NET.format("").replace('speed="20"', 'speed="30"')
    folder_of(tmp_path, fcd(drives()))
    (tmp_path / "b.fcd.xml").write_text(fcd(drives()))
    (tmp_path / "b.net.xml").write_text(wide)
    (tmp_path / "n.net.xml").rename(tmp_path / "a.net.xml")
    (tmp_path / "fcd.xml").rename(tmp_path / "a.fcd.xml")
    name, source = open_source(tmp_path, None, workers=1)
    recordings = list(source.recordings())
    assert name == "sumo"
    assert [item.scene_id for item in recordings] == ["a", "b"]
    assert [item.location for item in recordings] == ["a", "b"]
    assert [item.lanes["out_0"].speed_limit for item in recordings] == [20.0, 30.0]
