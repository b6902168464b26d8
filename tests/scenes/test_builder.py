"""From recordings to scenes: causal, complete, on routes that fit, with what stands
still marked so."""

from pathlib import Path

import numpy as np
import pytest
import torch

from e2rl.run.errors import InputError
from e2rl.scenes.builder import (
    BuildSettings,
    SceneBuilder,
    build_scene,
    ego_overlaps,
)
from e2rl.scenes.recording import PEDESTRIAN, VEHICLE
from e2rl.scenes.route import project
from e2rl.scenes.scenarionet import ScenarioNetSource, recording_of
from e2rl.scenes.scene import KEYS, validate
from e2rl.scenes.smoothing import TOP_SPEED
from e2rl.sim.mission import mission_of
from tests.scenes.descriptions import (
    ALL,
    FRAMES,
    description,
    fork,
    lane,
    straight,
    track,
)

SETTINGS = BuildSettings(field_cells=64)
DATA = Path(__file__).parents[2] / ".." / "shared" / "data"
# nuScenes: left-hand traffic, lanes without connectivity.
RECORDED = {
    "waymo": (DATA / "waymo" / "tune.zip", 7),
    "nuscenes": (DATA / "nuscenes_mini" / "scenes.zip", 4),
}


def recorded(
    tracks=None,
    lanes=None,
    **metadata,
):
    return recording_of(description(tracks, lanes, **metadata))


def build(
    tracks=None,
    lanes=None,
    settings: BuildSettings = SETTINGS,
    **metadata,
):
    return build_scene(recorded(tracks, lanes, **metadata), settings)


def left_turn() -> dict:
    """An ego at 8 m/s that turns onto `left` (arc of 20 m radius from x = 100)."""
    s = 60 + 0.8 * ALL
    angle = np.clip((s - 100) / 20, 0, np.pi / 2)
    x = np.minimum(s, 100) + 20 * np.sin(angle)
    y = 20 * (1 - np.cos(angle)) + np.maximum(s - 100 - 10 * np.pi, 0)
    return track(np.stack([x, y], 1), angle, speed=8.0)


def lane_change(y_end: float = 3.5) -> dict:
    """An ego at 8 m/s from y = 0 to y_end between x = 30 and x = 70."""
    x = 15 + 0.8 * ALL
    y = y_end * (1 - np.cos(np.pi * np.clip((x - 30) / 40, 0, 1))) / 2
    return track(
        np.stack([x, y], 1), np.arctan2(np.gradient(y), np.gradient(x)), speed=8.0
    )


def test_scenes_of_one_log_are_those_built_one_by_one():
    windows = list(
        recorded({"ego": left_turn(), "7": straight(50, 3.5, speed=0)}).windows(
            [10, 12, 30, 48], 80
        )
    )
    builder = SceneBuilder(windows[0], SETTINGS)
    for window in windows:
        scene = builder.scene(window)
        alone = build_scene(window, SETTINGS)
        assert all(torch.equal(scene[key], alone[key]) for key in KEYS)


def test_a_scene_keeps_the_schema_and_its_frame():
    scene = build()
    validate(scene, "made")
    assert set(scene.keys()) == set(KEYS)
    assert scene["start"].shape == (48, 4)
    assert scene["logged"].shape == (81, 48, 4)
    assert scene["valid"].sum() == 3
    assert scene["valid"][[0, 1, 32]].all()
    assert scene["agent_type"][[0, 1, 32]].tolist() == [VEHICLE, VEHICLE, PEDESTRIAN]
    assert scene["start"][0].tolist() == pytest.approx(
        [0, 0, 0, 8], abs=1e-4
    )  # origin: the ego's rounded position
    assert scene["start"][1].tolist() == pytest.approx([28, 3.5, 0, 6], abs=1e-4)
    way = 0.8 * torch.arange(81)
    assert scene["logged"][:, 0, 0].allclose(way, atol=1e-4)
    assert scene["logged_valid"][:, [0, 1, 32]].all()
    assert scene["lane_points"][:, 0].min() == -28.0
    assert scene["size"][32].tolist() == pytest.approx([0.6, 0.6])


def test_the_start_sees_nothing_of_the_future():
    scene = build()
    other = description()
    for agent in other["tracks"].values():
        state = agent["state"]
        state["position"][11:, 0] += np.linspace(0, 20, FRAMES - 11)
        state["heading"][11:] += np.linspace(0, 0.2, FRAMES - 11)
    changed = build(other["tracks"])
    for key in (
        "start",
        "start_accel",
        "start_yaw_rate",
        "valid",
        "parked",
        "route_points",
        "route_valid",
    ):
        assert torch.equal(scene[key], changed[key]), key
    assert not torch.equal(scene["logged"], changed["logged"])


def test_the_start_of_what_stands_sees_nothing_of_the_future():
    wobble = np.random.default_rng(0).normal(0, 0.1, FRAMES)
    parked = track([[60, 3.5]], wobble, speed=0.0)
    other = track([[60, 3.5]], np.where(ALL > 10, 0.5 + wobble, wobble), speed=0.0)
    ego = straight(20, 0, speed=8)
    scene = build({"ego": ego, "7": parked})
    changed = build({"ego": ego, "7": other})
    assert torch.equal(scene["start"], changed["start"])
    assert torch.equal(scene["past"], changed["past"])
    assert len(scene["logged"][:, 1, 2].unique()) == 1, "it never turns"


def test_headings_are_mended_counted_and_drop_nobody():
    flipped = straight(20, 0, speed=8)
    flipped["state"]["heading"][8:12] = np.pi
    tracks = {
        "ego": flipped,
        "back": track(
            np.stack([30 + 0.9 * ALL, np.full(FRAMES, 3.5)], 1), np.pi, speed=-9.0
        ),
        "spins": track([[60, -5]], 0.08 * ALL, speed=0.0),
        "reverses": track(
            np.stack([90 - 0.2 * ALL, np.full(FRAMES, -5.0)], 1), 0.0, speed=-2.0
        ),
        "spiked": straight(50, 0, speed=8),
    }
    tracks["spiked"]["state"]["heading"][[30, 60]] = 1.3
    builder = SceneBuilder(recorded(tracks), SETTINGS)
    scene = builder.scene(recorded(tracks))
    assert builder.repairs["headings turned round"] == 2
    assert (
        builder.repairs["headings held while standing"]
        == builder.repairs["heading spikes"]
        == 1
    )
    assert scene["start"][0].tolist() == pytest.approx([0, 0, 0, 8], abs=1e-4)
    assert scene["logged_valid"][:, :5].all()
    assert scene["logged"][:, :5, 2].abs().max() < 0.1
    row = {float(x): row for row, x in enumerate(scene["start"][:5, 0].round())}
    assert scene["logged"][:, row[60.0], 3].allclose(torch.tensor(-2.0), atol=1e-4)
    assert scene["start"][row[60.0], 3] == pytest.approx(-2.0, abs=1e-4)


def test_the_log_ends_where_the_recording_does():
    tracks = description()["tracks"]
    tracks["7"]["state"]["valid"] = (ALL < 40) | (ALL > 60)
    scene = build(tracks, current_time_index=30)
    assert scene["logged_valid"][:, 0].sum() == 61
    assert scene["logged_valid"][:, 1].sum() == 40
    assert not scene["logged"][~scene["logged_valid"]].any()


def test_the_nearest_take_part_the_ego_first():
    cars = {
        f"c{k}": straight(40 + 8.0 * k, 0 if k % 2 else 3.5, speed=8) for k in range(6)
    }
    late = straight(
        48,
        3.5,
        speed=8,
        valid=ALL > 30,
    )
    people = {
        f"p{k}": straight(
            30,
            -5 - k,
            speed=8,
            kind="PEDESTRIAN",
            valid=5 * k < ALL,
        )
        for k in range(4)
    }
    scene = build(
        cars | {"late": late, "ego": straight(20, 0, speed=8)} | people,
        settings=BuildSettings(
            field_cells=64,
            vehicles=4,
            others=3,
        ),
    )
    assert scene["start"][:4, 0].tolist() == pytest.approx([0, 20, 28, 36], abs=0.01)
    assert (scene["start"][4:, 1] * scene["valid"][4:]).tolist() == pytest.approx(
        [-5, -6, 0], abs=0.01
    )
    assert scene["logged_valid"][:, 4:].any(0).all()
    assert scene["valid"].tolist() == [True] * 6 + [False]


def crossing(start_y: float, **options) -> dict:
    """A car that crosses the ego's path at x = 60 at 6 m/s."""
    y = start_y + 0.6 * ALL
    return track(
        np.stack([np.full(FRAMES, 60.0), y], 1),
        np.pi / 2,
        speed=6.0,
        **options,
    )


def test_cars_that_stand_leave_their_rows_to_those_that_move():
    """Those farthest from the ego's path first; where the rows suffice, nobody is left
    out."""
    stands = {f"p{k}": straight(24 + 6.0 * k, -8 - k, speed=0) for k in range(6)}
    settings = BuildSettings(
        field_cells=64,
        vehicles=6,
        others=0,
    )
    scene = build(
        {"ego": straight(20, 0, speed=8), "x": crossing(-40)} | stands,
        settings=settings,
    )
    moving = scene["valid"] & (scene["start"][:, 3] > 1)
    assert moving.sum() == 2
    assert scene["valid"].all()
    assert sorted(scene["start"][~moving, 1].tolist()) == pytest.approx(
        [-11, -10, -9, -8]
    )
    assert scene["left_out"] == 0  # the others stand more than 10 m from the ego's path
    assert (
        build({"ego": straight(20, 0, speed=8), "x": crossing(-40)} | stands)[
            "valid"
        ].sum()
        == 8
    )


def test_who_appears_later_and_comes_near_is_replayed_and_counted():
    late = {
        "x": crossing(-30, valid=ALL > 30),
        "far": straight(
            0,
            60,
            speed=8,
            valid=ALL > 30,
        ),
    }
    scene = build(
        {"ego": straight(20, 0, speed=8), "7": straight(50, 3.5, speed=6)} | late
    )
    assert scene["valid"].sum() == 2
    assert scene["left_out"] == 1
    assert scene["logged_valid"].any(0).nonzero()[:, 0].tolist() == [0, 1, 2]
    assert scene["logged_valid"][:, 2].nonzero()[0] == 21
    assert scene["route_log"][2] == -1
    assert not scene["start"][2].any()
    assert not scene["parked"][2]
    crowded = build(
        {"ego": straight(20, 0, speed=8)} | late,
        settings=BuildSettings(
            field_cells=64,
            vehicles=2,
        ),
    )
    assert crowded["left_out"] == 1
    assert crowded["logged_valid"][:, 1].any()


def test_the_way_driven_is_found_and_is_the_mission():
    scene = build(
        {
            "ego": left_turn(),
            "7": straight(50, 3.5, speed=6),
            "p": straight(70, 0, speed=8),
        }
    )
    assert scene["route_valid"][0].sum() == 3  # on, left, and the lane beside
    mission = mission_of(scene[None])
    _, offset, _ = project(scene["logged"][:, 0, :2], mission.points[0])
    assert offset.abs().max() < 0.4
    assert torch.isinf(mission.end).all()
    follower = scene["route_log"][1]
    assert (
        scene["route_points"][1, follower, 40:, 1].abs().max() < 0.1
    )  # that one went straight on


@pytest.mark.parametrize(("y_end", "more"), [(7.0, 120.0), (-12.0, 0.0)])
def test_a_mission_without_lane_is_the_recorded_way_and_ends_with_what_is_known(
    y_end, more
):
    scene = build(
        {"ego": lane_change(y_end)}, fork() | {"second": lane([[0, 7], [207, 7]])}
    )
    slot = int(scene["route_log"][0])
    assert slot == scene["route_valid"][0].sum() - 1 > 0  # the lane routes stay
    assert scene["route_recorded"].nonzero().tolist() == [[0, slot]]
    track = scene["logged"][:, 0, :2]
    points = scene["route_points"][0, slot]
    s, offset, _ = project(track, points)
    assert offset.abs().max() < 0.15
    assert s[0].item() == pytest.approx(20, abs=0.1)
    assert scene["route_open"][0, slot]
    beyond = (
        scene["route_length"][0, slot].item() - s[-1].item()
    )  # the recording ends at x = 87
    assert beyond == pytest.approx(more or 10.0, abs=1.5)


def test_limits_and_lights_lie_on_the_route():
    full = description({"ego": straight(40, 0, speed=8)})
    states = ["LANE_STATE_STOP"] * 50 + ["LANE_STATE_GO"] * 41
    full["dynamic_map_states"] = {"left": {"state": {"object_state": states}}}
    scene = build_scene(recording_of(full), SETTINGS)
    turning = int((scene["route_light"][0, :, 0] == 0).nonzero())
    assert scene["route_valid"][0, turning]
    assert (scene["route_light"][0] == 0).sum() == 1
    assert scene["route_light_s"][0, turning, 0].item() == pytest.approx(
        20 + 52, abs=0.5
    )  # the ego is at x = 48
    assert scene["light_points"].tolist() == [[52.0, 0.0]]
    assert scene["light_state"][:, 0].tolist() == [1] * 40 + [3] * 41
    straight_on = next(r for r in range(6) if scene["route_points"][0, r, -1, 0] > 200)
    assert scene["route_limit"][0, straight_on, 10].item() == pytest.approx(
        50 / 3.6, abs=1e-3
    )
    assert scene["route_limit"][0, straight_on, 80].item() == pytest.approx(
        20, abs=1e-3
    )


def test_only_vehicles_that_stand_beside_the_lanes_are_parked():
    scene = build(
        {
            "ego": straight(20, 0, speed=8),
            "queue": straight(60, 0, speed=0),
            "kerb": straight(60, -6, speed=0),
            "slow": straight(60, 9, speed=1.0),
        }
    )
    parked = {
        round(y): bool(p)
        for y, p, v in zip(
            scene["start"][:, 1].tolist(),
            scene["parked"],
            scene["valid"],
            strict=True,
        )
        if v
    }
    assert parked == {0: False, -6: True, 9: False}
    assert scene["parked"].sum() == 1


def test_overlap_with_the_ego_is_seen_and_only_that():
    far = {
        "ego": straight(20, 0, speed=8),
        "a": straight(24.6, 0, speed=8),
        "b": straight(50, 0, speed=8),
        "c": straight(51, 0.5, speed=8),
    }
    assert not ego_overlaps(build(far))
    assert ego_overlaps(build(far | {"a": straight(24.4, 0, speed=8)}))
    aside = np.stack([20 + 0.8 * ALL + 3.5, np.full(FRAMES, 2.1)], 1)
    assert not ego_overlaps(
        build({"ego": straight(20, 0, speed=8), "a": track(aside, -0.4, speed=8.0)})
    )
    assert ego_overlaps(
        build({"ego": straight(20, 0, speed=8), "a": track(aside, 0.4, speed=8.0)})
    )
    for kind, word in (
        ("PEDESTRIAN", "a pedestrian"),
        ("CYCLIST", "a cyclist"),
        ("TRAFFIC_CONE", "an object"),
    ):
        other = {
            "p": straight(
                21,
                0,
                speed=8,
                kind=kind,
                size=(0.5, 0.5),
            ),
            "far": straight(
                60,
                0,
                speed=8,
                kind=kind,
            ),
        }
        assert ego_overlaps(build({"ego": straight(20, 0, speed=8)} | other)) == word


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: setattr(r, "ego", 2), "the ego is a pedestrian"),
        (lambda r: setattr(r, "current", 90), "start frame 90"),
        (
            lambda r: r.states.__setitem__((40, 1, 0), np.nan),
            "NaN or infinite state of agent 1 at frame 40",
        ),
        (
            lambda r: [
                setattr(map_lane, "points", map_lane.points[:1])
                for map_lane in r.lanes.values()
            ],
            "no lane is at least",
        ),
    ],
)
def test_recordings_that_make_no_scene_say_why(change, message):
    recording = recorded()
    change(recording)
    with pytest.raises(InputError, match=f"scene 'fork': .*{message}"):
        build_scene(recording, SETTINGS)


@pytest.fixture(
    scope="module",
    params=RECORDED,
)
def recorded_scenes(request):
    path, stride = RECORDED[request.param]
    if not path.exists():
        pytest.skip(
            f"needs {path.parent.name}/{path.name} in ../shared/data, "
            "which is not in the repository"
        )
    source = ScenarioNetSource(str(path))
    logs = [
        recording for log in source.logs()[::stride] for recording in source.read(log)
    ]
    return [
        build_scene(window, SETTINGS)
        for log in logs
        for window in log.windows(None, SETTINGS.steps)
    ]


def test_recorded_scenes_keep_the_schema_and_their_parked_cars_stay(recorded_scenes):
    parked = moved = 0
    for index, scene in enumerate(recorded_scenes):
        validate(scene, str(index))
        assert torch.isfinite(scene["logged"]).all()
        assert (scene["logged"][..., 3].abs() <= TOP_SPEED).all()
        assert scene["start"][0, 3] >= 0, "no ego of these logs reverses"
        stay = scene["parked"] & scene["valid"]
        visible = scene["logged_valid"][:, stay] & scene["logged_valid"][:1, stay]
        way = (scene["logged"][:, stay, :2] - scene["logged"][:1, stay, :2]).norm(
            dim=-1
        )
        parked += int(stay.sum())
        moved += int((way.masked_fill(~visible, 0).amax(0) > 2.0).sum())
    assert parked > 10
    assert moved <= 0.02 * parked


def test_recorded_vehicles_find_the_way_they_drove(recorded_scenes):
    driven = [
        (scene["route_log"] >= 0)[scene["valid"][:32] & ~scene["parked"][:32]]
        for scene in recorded_scenes
    ]
    assert torch.cat(driven).float().mean() > 0.93
