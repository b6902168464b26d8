"""Who is above or below the ego's road is left out where heights tell, and nobody else
is."""

import warnings

import numpy as np
import pytest

from e2rl.scenes.builder import (
    OTHER_LEVEL,
    BuildSettings,
    SceneBuilder,
    build_scene,
)
from e2rl.scenes.scenarionet import recording_of
from tests.scenes.descriptions import (
    ALL,
    description,
    lane,
    straight,
    track,
)

SETTINGS = BuildSettings(field_cells=32)
MAST = 50.0  # m, x of the road that crosses


def crossing(
    y: float,
    speed: float,
    height: float,
    **options,
) -> dict:
    """A vehicle towards +y at x = MAST, at `y` m at frame 0, at a height."""
    car = track(
        np.stack([np.full(len(ALL), MAST), y + 0.1 * speed * ALL], 1),
        np.pi / 2,
        speed=speed,
        **options,
    )
    car["state"]["position"][:, 2] = height
    return car


def lanes(height: float, known: bool = True) -> dict:
    """A road along x at height 0 and one across it along y at a height; flat lanes
    where heights are not known."""
    roads = {
        "low": lane([[-100, 0], [300, 0]]),
        "beside": lane([[-100, 3.5], [300, 3.5]]),
        "high": lane([[MAST, -250], [MAST, 250]]),
    }
    roads["high"]["polyline"][:, 2] = height if known else 0.0
    return roads


def built(
    height: float,
    *,
    y: float = -40.0,
    known: bool = True,
    lift: float = 0.0,
) -> tuple[int, int]:
    """How many agents are present at the start beside the ego, and how many are left
    out as on another level."""
    tracks = {
        "ego": straight(0, 0, speed=8),
        "beside": straight(-20, 3.5, speed=8),
        "crossing": crossing(y, 10.0, height=height),
    }
    for item in tracks.values():
        item["state"]["position"][:, 2] += lift
    roads = lanes(height, known)
    recording = recording_of(description(tracks, roads))
    builder = SceneBuilder(recording, SETTINGS)
    return int(builder.scene(recording)["valid"].sum()) - 1, builder.repairs[
        OTHER_LEVEL
    ]


@pytest.mark.parametrize("lift", [0.0, 0.8, 300.0])
def test_who_crosses_the_ego_s_road_on_a_bridge_or_below_one_is_left_out(lift):
    """Whether heights are of the ground or of the middles of boxes, and wherever zero
    is."""
    assert built(7.0, lift=lift) == (1, 1)
    assert built(-6.0, lift=lift) == (1, 1)
    assert built(0.0, lift=lift) == (2, 0)
    assert built(1.5, lift=lift) == (2, 0), "a slope, or a tall box"


def test_a_lane_tells_who_would_cross_although_nobody_has_yet():
    """The car ends 60 m before the ego's road, towards which its lane leads above."""
    assert built(7.0, y=-150.0) == (1, 1)
    assert built(0.0, y=-150.0) == (2, 0)


def test_heights_of_tracks_suffice_and_without_any_nobody_is_left_out():
    assert built(7.0, known=False) == (1, 1)
    recording = recording_of(
        description(
            {
                "ego": straight(0, 0, speed=8),
                "crossing": crossing(-40.0, 10.0, height=0.0),
            },
            lanes(7.0),
        )
    )
    assert recording.heights is None
    assert not SceneBuilder(recording, SETTINGS).repairs


def test_a_hill_is_no_bridge():
    """The car ahead is 10 m higher than the ego now, and on the same road."""
    roads = {"up": lane([[-100, 0], [0, 0], [100, 0], [300, 0]])}
    roads["up"]["polyline"][:, 2] = [-10, 0, 10, 30]
    tracks = {"ego": straight(0, 0, speed=8), "ahead": straight(100, 0, speed=8)}
    for item in tracks.values():
        item["state"]["position"][:, 2] = 0.1 * item["state"]["position"][:, 0]
    recording = recording_of(description(tracks, roads))
    builder = SceneBuilder(recording, SETTINGS)
    assert builder.scene(recording)["valid"].sum() == 2
    assert not builder.repairs[OTHER_LEVEL]


@pytest.mark.parametrize(("height", "limit"), [(0.0, 50.0), (7.0, 90.0)])
def test_a_vehicle_is_on_the_lane_of_its_level_where_two_lie_one_above_the_other(
    height, limit
):
    roads = {
        "deck": lane([[-100, 0], [300, 0]], speed_kmh=90.0),
        "below": lane([[-100, 0], [300, 0]]),
    }
    roads["deck"]["polyline"][:, 2] = 7.0
    tracks = {
        "ego": straight(0, 0, speed=8),
        "above": straight(30, 0, speed=8),
        "under": straight(-30, 0, speed=8),
    }
    for name, own_height in (("ego", height), ("above", 7.0), ("under", 0.0)):
        tracks[name]["state"]["position"][:, 2] = own_height
    scene = build_scene(recording_of(description(tracks, roads)), SETTINGS)
    assert scene["valid"].sum() == 2, "one of the others is on the ego's level"
    limits = scene["route_limit"][scene["route_valid"]]
    assert np.allclose(limits, limit / 3.6)


def test_headings_in_the_place_of_heights_are_none():
    """ScenarioNet's converter of nuScenes writes them: a lane to the west would lie 3 m
    above one to the east."""
    roads = {
        "west": lane([[300, 0], [0, 0], [-100, 0]]),
        "north": lane([[50, -200], [50, 0], [50, 200]]),
    }
    roads["west"]["polyline"][:, 2] = 3.1
    roads["north"]["polyline"][:, 2] = 1.6
    recording = recording_of(description({"ego": straight(0, 0, speed=8)}, roads))
    assert [item.heights for item in recording.lanes.values()] == [None, None]


def test_an_ego_whose_height_is_always_0_tells_nothing_of_those_ahead_uphill():
    """Heights of the others are relative to it (nuScenes): the car ahead stays 5 m
    above it on the same road."""
    tracks = {
        "ego": straight(0, 0, speed=8),
        "ahead": straight(60, 0, speed=8),
        "behind": straight(-60, 0, speed=8),
    }
    wobble = 0.05 * np.sin(np.arange(len(tracks["ego"]["state"]["position"])))
    for name, height in (("ahead", 5.0), ("behind", -5.0)):
        tracks[name]["state"]["position"][:, 2] = height + wobble
    recording = recording_of(description(tracks, {"road": lane([[-100, 0], [300, 0]])}))
    builder = SceneBuilder(recording, SETTINGS)
    assert builder.scene(recording)["valid"].sum() == 3


def test_a_flat_map_below_tracks_with_heights_takes_no_lane_from_who_is_on_a_hill():
    roads = {"road": lane([[-100, 0], [0, 0], [300, 0]])}
    tracks = {"ego": straight(0, 0, speed=8), "hill": straight(100, 0, speed=8)}
    tracks |= {f"flat{k}": straight(-20.0 * k, 0, speed=8) for k in range(1, 5)}
    for item in tracks.values():
        x = item["state"]["position"][:, 0]
        item["state"]["position"][:, 2] = 0.1 * np.maximum(x - 50.0, 0.0)
    recording = recording_of(description(tracks, roads))
    levels = SceneBuilder(recording, SETTINGS).levels
    assert np.isnan(levels.lane_height).all()


def test_where_a_lane_leads_does_not_depend_on_where_its_vehicle_is_on_it():
    """A car 400 m along a deck of 500 m, which a ramp of 100 m then brings down onto
    the ego's road."""
    deck = lane([[-600, 50], [-100, 50]], exits=["ramp"])
    ramp = lane([[-100, 50], [-50, 25], [0, 0]], exits=["road"])
    road = lane([[0, 0], [300, 0]])
    deck["polyline"][:, 2], ramp["polyline"][:, 2] = 7.0, [7.0, 3.5, 0.0]
    tracks = {"ego": straight(20, 0, speed=8), "comes": straight(-160, 50, speed=8)}
    tracks["comes"]["state"]["position"][:, 2] = 7.0
    recording = recording_of(
        description(tracks, {"deck": deck, "ramp": ramp, "road": road})
    )
    builder = SceneBuilder(recording, SETTINGS)
    assert builder.scene(recording)["valid"].sum() == 2


def test_a_track_without_heights_takes_those_of_the_others_from_nobody():
    """No warning, no change: the bridge is told by the tracks that have heights."""
    tracks = {
        "ego": straight(0, 0, speed=8),
        "beside": straight(-20, 3.5, speed=8),
        "crossing": crossing(-40.0, 10.0, height=7.0),
    }
    recording = recording_of(description(tracks, lanes(7.0)))
    recording.heights[:, 1] = np.nan
    with warnings.catch_warnings(action="error"):
        builder = SceneBuilder(recording, SETTINGS)
    assert builder.repairs[OTHER_LEVEL] == 1
