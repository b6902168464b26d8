"""Logs in other units, mirrored or beside their map are refused with the reason; logs
like those recorded are not."""

import copy
import tracemalloc

import numpy as np
import pytest

from e2rl.run.errors import InputError
from e2rl.scenes.builder import BuildSettings, build_scene
from e2rl.scenes.bundled import read_recordings, unpack
from e2rl.scenes.lane_graph import LaneGraph
from e2rl.scenes.plausibility import (
    LIMITS,
    check,
    extent,
    lane_spacing,
    map_fit,
    motion,
)
from e2rl.scenes.recording import VEHICLE, Lane

SMALL = BuildSettings(
    steps=20,
    vehicles=4,
    others=2,
    field_cells=32,
)


@pytest.fixture(scope="module")
def genuine():
    return read_recordings(unpack("tune"))[0]


def scaled(
    recording,
    factor,
    parts,
):
    """Parts of a recording in units that are `factor` times smaller."""
    if "positions" in parts:
        recording.states[..., :2] *= factor
    if "speeds" in parts:
        recording.states[..., 3] *= factor
    if "sizes" in parts:
        recording.size = recording.size * factor
    if "map" in parts:
        recording.lanes = {
            name: Lane(lane.points * factor, lane.width * factor, exits=lane.exits)
            for name, lane in recording.lanes.items()
        }
        recording.drivable = [ring * factor for ring in recording.drivable]


def moved(recording, change):
    """The map with every point [P, 2] changed."""
    recording.lanes = {
        name: Lane(change(lane.points), exits=lane.exits)
        for name, lane in recording.lanes.items()
    }
    recording.drivable = [change(ring) for ring in recording.drivable]


def setting(where, value):
    def change(recording):
        recording.states[where] = value

    return change


def far_away(recording):
    agent = 1 - recording.ego if recording.ego < 2 else 0
    recording.states[:, agent, 0] += 1e9


def fastest(recording):
    """The vehicle other than the ego that drives farthest."""
    steps = np.linalg.norm(np.diff(recording.states[..., :2], axis=0), axis=-1)
    way = (steps * (recording.valid[1:] & recording.valid[:-1])).sum(0) * (
        recording.agent_type == VEHICLE
    )
    way[recording.ego] = 0
    return int(way.argmax())


def one_vehicle(part, change):
    def apply(recording):
        recording.states[:, fastest(recording), part] = change(
            recording.states[:, fastest(recording), part]
        )

    return apply


def twice(recording):
    every = [*range(recording.states.shape[1]), fastest(recording)]
    recording.states = recording.states[:, every]
    recording.valid = recording.valid[:, every]
    recording.size = recording.size[every]
    recording.agent_type = recording.agent_type[every]


ALL = ("positions", "speeds", "sizes", "map")
MUTATIONS = {
    "degrees": (
        lambda r: setting((..., 2), np.degrees(r.states[..., 2]))(r),
        "rad lie between|rad is the largest",
    ),
    "mirrored tracks": (
        lambda r: setting((..., 1), -r.states[..., 1])(r),
        "rad lie between",
    ),
    "reversed headings": (
        lambda r: setting((..., 2), r.states[..., 2] + np.pi)(r),
        "rad lie between",
    ),
    "mirrored map": (
        lambda r: moved(r, lambda points: points * [1, -1] + [0, 17]),
        "m is the ego from|drive along a lane",
    ),
    "feet": (lambda r: scaled(r, 3.28, ALL), "median length of vehicles"),
    "positions and map in feet": (
        lambda r: scaled(
            r,
            3.28,
            ["positions", "map"],
        ),
        "is what the recorded speeds make",
    ),
    "one vehicle in degrees": (
        one_vehicle(2, lambda angle: np.degrees(angle) + 40),
        "displacement of a vehicle|rad is the largest",
    ),
    "one vehicle in km/h": (
        one_vehicle(3, lambda speed: speed * 3.6),
        "displacement of a vehicle",
    ),
    "one vehicle twice": (twice, "at the same place"),
    "millimetres": (lambda r: scaled(r, 1000.0, ALL), "m is"),
    "km/h": (lambda r: scaled(r, 3.6, ["speeds"]), "is what the recorded speeds make"),
    "coordinates of 1e9": (far_away, "m is the largest coordinate"),
}


@pytest.mark.parametrize("name", MUTATIONS)
def test_what_is_no_traffic_in_metres_on_its_map_is_refused_with_the_reason(
    genuine, name
):
    change, reason = MUTATIONS[name]
    recording = copy.deepcopy(genuine)
    change(recording)
    with pytest.raises(InputError, match=rf"^scene '.*({reason}).*, plausible is .*; "):
        build_scene(recording, SMALL)


@pytest.mark.parametrize("part", ["coupled", "towed"])
def test_vehicles_with_trailers_do_not_tell_the_usual_size(genuine, part):
    """They are long, and an ego that is one may be alone."""
    recording = copy.deepcopy(genuine)
    others = [track for track in range(len(recording.size)) if track != recording.ego]
    recording.size[recording.ego] = (18.0, 2.5)
    recording.valid[:, others] = False
    assert motion(recording)["vehicle_length"] == 18.0
    setattr(recording, part, (recording.ego,))
    assert np.isnan(motion(recording)["vehicle_length"])
    assert np.isnan(motion(recording)["vehicle_width"])
    build_scene(recording, SMALL)


@pytest.mark.parametrize("size", [0, 1])
def test_a_log_of_one_frame_is_not_told_to_be_cut(size):
    with pytest.raises(InputError, match="fewer than two frames"):
        check({"states": size}, "short")


def copies_of_a_lane(recording):
    lane = next(iter(recording.lanes.values()))
    recording.lanes |= {f"copy {number}": lane for number in range(4000)}


def lanes_that_lead_everywhere(recording):
    for lane in recording.lanes.values():
        lane.exits = [*recording.lanes, *map(str, range(200))]


def zigzag(recording):
    recording.drivable.append(
        recording.states[0, recording.ego, :2]
        + np.tile([[0.0, 0], [40_000, 1]], (1000, 1))
    )


def crowd(recording):
    agents = np.full(4000, fastest(recording))
    for part, axis in (("states", 1), ("valid", 1), ("size", 0), ("agent_type", 0)):
        value = getattr(recording, part)
        setattr(
            recording, part, np.concatenate([value, value.take(agents, axis)], axis)
        )


@pytest.mark.parametrize(
    "change", [copies_of_a_lane, lanes_that_lead_everywhere, zigzag, crowd]
)
def test_a_small_log_of_large_cost_is_refused_before_it_costs(genuine, change):
    """Each would make millions of pairs or points."""
    recording = copy.deepcopy(genuine)
    change(recording)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="plausible is at most"):
            build_scene(recording, SMALL)
        assert tracemalloc.get_traced_memory()[1] < 3e8
    finally:
        tracemalloc.stop()


def test_genuine_recordings_stay_well_inside_the_limits():
    """At half of each limit and twice each least value they would still pass."""
    for recording in read_recordings(unpack("tune"))[::8]:
        measures = (
            extent(recording)
            | motion(recording)
            | map_fit(recording, LaneGraph(recording.lanes))
        )
        assert measures.keys() == LIMITS.keys()
        assert measures["speed_ratio"] == pytest.approx(1, abs=0.05)
        for name, value in measures.items():
            low, high, *_ = LIMITS[name]
            assert not value < low, name
            assert not value > high, name
            if name not in (
                "speed_ratio",
                "ego_speed_ratio",
                "on_lanes",
                "lane_spacing",
                "vehicle_length",
            ):
                assert not value > high / 1.5, name


def test_a_slow_vehicle_may_drive_backwards_and_a_short_way_tells_nothing(genuine):
    recording = copy.deepcopy(genuine)
    agent = fastest(recording)
    frames = np.arange(len(recording.states))
    recording.valid[:], recording.valid[:, agent] = False, True
    for speed, name, other in (
        (2.5, "slow_direction", "track_direction"),
        (7.0, "track_direction", "slow_direction"),
    ):
        states = [
            0.1 * speed * frames,
            0 * frames,
            0 * frames + np.pi,
            0 * frames + speed,
        ]
        recording.states[:, agent] = np.stack(states, 1)
        measured = motion(recording)
        assert measured[name] == pytest.approx(0.0 if speed == 2.5 else np.pi)
        assert np.isnan(measured[other])
    recording.valid[10:, agent] = False  # 6 m
    assert np.isnan(motion(recording)["track_direction"])


def test_the_same_traffic_elsewhere_and_turned_is_as_plausible(genuine):
    recording = copy.deepcopy(genuine)
    angle = 0.7
    away = np.array([30_000.0, -4_000.0])
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    recording.states[..., :2] = recording.states[..., :2] @ turn + away
    recording.states[..., 2] += angle
    moved(recording, lambda points: points @ turn + away)
    ours = motion(recording) | map_fit(recording, LaneGraph(recording.lanes))
    theirs = motion(genuine) | map_fit(genuine, LaneGraph(genuine.lanes))
    for name, value in theirs.items():
        assert ours[name] == pytest.approx(
            value,
            rel=0.05,
            abs=0.02,
            nan_ok=True,
        ), name


def apart(
    distance: float,
    *,
    oncoming: bool = False,
    width: float = 0.0,
    named: bool = False,
) -> float:
    """The spacing of two lanes of 400 m `distance` m from each other."""
    ends = (
        [[400.0, distance], [0.0, distance]]
        if oncoming
        else [[0.0, distance], [400.0, distance]]
    )
    lines = {
        "0": Lane(
            np.array([[0.0, 0.0], [400.0, 0.0]]), width, left=["1"] if named else []
        ),
        "1": Lane(np.array(ends), width),
    }
    return lane_spacing(LaneGraph(lines))


def test_roads_and_carriageways_apart_tell_no_unit():
    assert np.isnan(apart(12.0, oncoming=True))
    assert np.isnan(
        apart(
            12.0,
            oncoming=True,
            width=3.7,
        )
    )
    assert np.isnan(apart(15.0, width=3.5)), "two streets in one direction"


@pytest.mark.parametrize("foot", [1.0, 3.28])
def test_lanes_that_adjoin_tell_the_unit(foot):
    """A map in feet is seen where its lanes are named, or are as wide as they lie
    apart, or run beside each other."""
    assert apart(3.5 * foot) == pytest.approx(3.5 * foot)
    assert apart(
        3.5 * foot,
        width=3.5 * foot,
        oncoming=True,
    ) == pytest.approx(3.5 * foot)
    assert apart(
        3.5 * foot,
        width=3.5,
        named=True,
    ) == pytest.approx(3.5 * foot)


@pytest.mark.parametrize("apart", [3.0, 4.5])
def test_lanes_side_by_side_lie_as_far_apart_as_they_do(apart):
    lines = {
        str(k): Lane(np.array([[0.0, k * apart], [400.0, k * apart]])) for k in range(3)
    }
    assert lane_spacing(LaneGraph(lines)) == pytest.approx(apart)
    assert np.isnan(lane_spacing(LaneGraph({"0": lines["0"]})))
