"""What lies just inside and just outside of the thresholds of reading: a constant that
moves by a fifth fails here."""

import numpy as np
import pytest
import torch

from e2rl.run.errors import InputError
from e2rl.scenes.headings import hold_headings, mend_headings, standing_frames
from e2rl.scenes.lane_graph import LaneGraph, against_lanes
from e2rl.scenes.limits import known_limits
from e2rl.scenes.links import adjacent, drivable_exits, plausible_width
from e2rl.scenes.paths import resample
from e2rl.scenes.recording import VEHICLE, Lane, Recording
from e2rl.scenes.resampling import resample_uniform
from e2rl.scenes.smoothing import causal_state, drop_jumps, smooth
from e2rl.scenes.trailers import JOINED, couple

TIME = 0.1 * np.arange(91)
EAST = np.array([1.0, 0.0])


def driving(speed: float, frames: int = 91, y: float = 0.0) -> np.ndarray:
    """States [F, 1, 4] along +x."""
    states = np.zeros((frames, 1, 4))
    states[:, 0, 0] = speed * TIME[:frames]
    states[:, 0, 1] = y
    states[:, 0, 3] = speed
    return states


def always(states: np.ndarray) -> np.ndarray:
    return np.ones(states.shape[:2], bool)


# --- resampling


@pytest.mark.parametrize(("gap", "bridged"), [(0.5, True), (0.6, False)])
def test_a_log_s_gap_is_bridged_up_to_half_a_second(gap, bridged):
    seconds = np.concatenate([TIME[:20], TIME[20:40] + gap - 0.1])
    states = driving(5.0, 40)
    valid = resample_uniform(states, always(states), seconds).valid
    assert valid.all() == bridged


@pytest.mark.parametrize(("offset", "near"), [(0.018, True), (0.022, False)])
def test_a_frame_stands_for_a_grid_time_within_20_ms(offset, near):
    seconds = TIME[:20].copy()
    seconds[10] += offset
    valid = np.zeros((20, 1), bool)
    valid[10] = True
    assert resample_uniform(driving(5.0, 20), valid, seconds).valid[10, 0] == near


@pytest.mark.parametrize(("frames", "bridged"), [(7, True), (8, False)])
def test_a_sparse_track_is_bridged_for_one_and_a_half_of_its_steps(frames, bridged):
    annotated = np.concatenate([np.arange(0, 41, 5), 40 + frames + np.arange(0, 31, 5)])
    states = driving(5.0)
    valid = np.zeros((91, 1), bool)
    valid[annotated] = True
    assert resample_uniform(states, valid, TIME).valid[42, 0] == bridged


@pytest.mark.parametrize(("turn", "halfway"), [(1.9, 0.95), (2.1, 2.1)])
def test_a_heading_turns_by_less_than_two_rad_between_frames(turn, halfway):
    states = driving(5.0, 20)
    states[11:, 0, 2] = turn
    seconds = np.delete(TIME[:20], 10)
    states = np.delete(states, 10, axis=0)
    out = resample_uniform(states, always(states), seconds + 0.0).states
    nearest = [halfway] if turn < 2 else [0.0, turn]
    assert np.isclose(out[10, 0, 2], nearest).any()


@pytest.mark.parametrize(
    ("step", "sound"), [(1.2, True), (1.3, False), (0.0045, False)]
)
def test_a_log_has_a_frame_in_five_ms_to_one_and_a_quarter_seconds(step, sound):
    states = driving(5.0, 20)
    try:
        resample_uniform(states, always(states), step * np.arange(20))
    except InputError:
        assert not sound
    else:
        assert sound


@pytest.mark.parametrize(("pause", "sound"), [(58.0, True), (61.0, False)])
def test_a_log_pauses_for_less_than_a_minute(pause, sound):
    states = driving(5.0, 20)
    seconds = TIME[:20].copy()
    seconds[10:] += pause
    try:
        resample_uniform(states, always(states), seconds)
    except InputError:
        assert not sound
    else:
        assert sound


# --- smoothing


@pytest.mark.parametrize(("jump", "plausible"), [(4.8, True), (5.2, False)])
def test_nobody_moves_more_than_five_metres_in_a_frame(jump, plausible):
    states = driving(0.0, 40)
    states[30:, 0, 0] += jump
    assert drop_jumps(states, always(states)).all() == plausible


def test_speeds_end_at_45_m_s():
    states = driving(49.0, 40)
    assert smooth(states, always(states))[20, 0, 3] == 45.0


@pytest.mark.parametrize(("speed", "smoothed"), [(-0.22, 0.0), (-0.28, -0.28)])
def test_slow_motion_backwards_is_noise(speed, smoothed):
    states = driving(speed)
    assert smooth(states, always(states))[45, 0, 3] == pytest.approx(smoothed)


@pytest.mark.parametrize(("frames", "speed"), [(5, 0.0), (6, -0.9)])
def test_who_backs_for_less_than_half_a_metre_does_not_reverse(frames, speed):
    states = driving(-0.9, frames)
    assert smooth(states, always(states))[2, 0, 3] == pytest.approx(speed)


@pytest.mark.parametrize(("speed", "smoothed"), [(0.09, 0.0), (0.11, 0.11)])
def test_who_creeps_slower_than_10_cm_s_is_at_rest(speed, smoothed):
    states = driving(speed)
    assert smooth(states, always(states))[45, 0, 3] == pytest.approx(smoothed)


@pytest.mark.parametrize(
    ("accel", "limited"), [(-5.5, -5.5), (-8.0, -6.0), (3.5, 3.5), (6.0, 4.0)]
)
def test_a_start_accelerates_by_minus_6_to_4_m_s2(accel, limited):
    states = driving(0.0, 40)
    states[:, 0, 0] = 20 * TIME[:40] + accel * TIME[:40] ** 2 / 2
    assert causal_state(states, always(states), 20)[1][0] == pytest.approx(limited)


@pytest.mark.parametrize(("rate", "limited"), [(0.9, 0.9), (1.5, 1.0)])
def test_a_start_turns_by_one_rad_s_at_most(rate, limited):
    states = driving(5.0, 40)
    states[:, 0, 2] = rate * TIME[:40]
    assert causal_state(states, always(states), 20)[2][0] == pytest.approx(limited)


@pytest.mark.parametrize(("before", "counts"), [(10, True), (11, False)])
def test_a_second_of_history_counts(before, counts):
    states = driving(5.0, 40)
    changed = states.copy()
    changed[20 - before, 0, 1] += 1.0
    start = causal_state(states, always(states), 20)[0]
    assert (causal_state(changed, always(states), 20)[0] != start).any() == counts


# --- headings


@pytest.mark.parametrize(("speed", "stands"), [(0.14, True), (0.16, False)])
def test_who_moves_by_less_than_15_cm_s_stands(speed, stands):
    states = driving(speed)
    assert standing_frames(states[..., :2], always(states)).all() == stands


@pytest.mark.parametrize(("turn", "count"), [(0.09, 0), (0.11, 1)])
def test_a_heading_is_held_where_it_turns_by_a_tenth_of_a_rad(turn, count):
    states = driving(0.0)
    states[40, 0, 2] = turn
    kinds = np.array([VEHICLE])
    assert hold_headings(states, always(states), kinds)[1] == count


@pytest.mark.parametrize(("tracks", "turned"), [(2, 2), (3, 0)])
def test_three_fast_tracks_turned_as_a_whole_are_the_log_s_way(tracks, turned):
    states = np.concatenate([driving(10.0, y=5.0 * k) for k in range(tracks)], 1)
    states[..., 2] = np.pi
    states[..., 3] = -10.0
    kinds = np.full(tracks, VEHICLE)
    counts = mend_headings(states, always(states), kinds)[1]
    assert counts.get("headings turned round", 0) == turned


@pytest.mark.parametrize(("speed", "turned"), [(4.9, 0), (5.2, 1)])
def test_who_backs_faster_than_five_m_s_is_turned_round(speed, turned):
    states = driving(speed)
    states[..., 2] = np.pi
    states[..., 3] = -speed
    counts = mend_headings(states, always(states), np.array([VEHICLE]))[1]
    assert counts.get("headings turned round", 0) == turned


# --- trailers


def pulled(
    gap: float,
    *,
    speed: float = 15.0,
    lateral: float = 0.0,
    frames: int = 91,
    play: float = 0.0,
) -> bool:
    """Whether a box of 10 m behind one of 6 m is joined to it; play: m of every fifth frame."""
    tractor = driving(speed) + [30.0, 3.5, 0.0, 0.0]
    trailer = tractor - [8.0 + gap, lateral, 0.0, 0.0]
    trailer[::5, 0, 0] += play
    states = np.concatenate([driving(12.0), tractor, trailer], 1)
    valid = always(states)
    valid[frames:, 2] = False
    recording = Recording(
        scene_id="pulled",
        location="",
        dataset="",
        states=states,
        valid=valid,
        size=np.array([(4.5, 1.9), (6.0, 2.5), (10.0, 2.5)]),
        agent_type=np.zeros(3, int),
        ego=0,
        lanes={"0": Lane(np.array([[0.0, 0.0], [200.0, 0.0]]))},
    )
    return couple(recording).repairs == {JOINED: 1}


@pytest.mark.parametrize(
    ("inside", "outside"),
    [
        ({"gap": 2.4}, {"gap": 2.6}),
        ({"gap": -0.45}, {"gap": -0.55}),
        ({"gap": 0.4, "lateral": 0.45}, {"gap": 0.4, "lateral": 0.55}),
        ({"gap": 0.9, "speed": 4.0}, {"gap": 1.1, "speed": 4.0}),
        ({"gap": 0.4, "frames": 31}, {"gap": 0.4, "frames": 29}),
        ({"gap": 0.4, "play": 0.18}, {"gap": 0.4, "play": 0.22}),
        ({"gap": 0.2, "speed": 1.1}, {"gap": 0.2, "speed": 0.95}),
    ],
)
def test_a_trailer_is_close_in_line_steady_and_drives(inside, outside):
    assert pulled(**inside)
    assert not pulled(**outside)


# --- limits


def placeholder(
    limit: float,
    fastest: float,
    *,
    other: float = 0.0,
    radius: float = 15.0,
    road: float = 9.0,
) -> bool:
    """Whether a limit [m/s] of a bend is none; other: that of a straight road."""
    angle = np.linspace(0.0, np.pi / 2, 200)
    bend = radius * np.stack([np.cos(angle), np.sin(angle)], 1)
    lanes = {
        "bend": Lane(bend, speed_limit=limit),
        "road": Lane(np.array([[0.0, 0.0], [road, 0.0]]), speed_limit=other),
    }
    states = driving(fastest)
    recording = Recording(
        scene_id="limits",
        location="",
        dataset="",
        states=states,
        valid=always(states),
        size=np.array([(4.5, 1.9)]),
        agent_type=np.zeros(1, int),
        ego=0,
        lanes=lanes,
    )
    return known_limits(recording)[0]["bend"].speed_limit == 0.0


def alike(**changes: float) -> dict[str, float]:
    return {"limit": 25.0, "fastest": 5.0, **changes}


@pytest.mark.parametrize(
    ("none", "limit"),
    [
        (alike(limit=46.0, fastest=60.0), alike(limit=44.0, fastest=60.0)),
        (alike(limit=22.5), alike(limit=21.5)),
        (alike(other=25.45), alike(other=25.55)),
        (alike(radius=40.0, fastest=14.7), alike(radius=40.0, fastest=15.3)),
        (alike(radius=900.0, limit=36.5), alike(radius=900.0, limit=35.5)),
        (alike(radius=60.0), alike(radius=67.0)),
        (alike(radius=20.5, fastest=20.0), alike(radius=22.0, fastest=20.0)),
        (
            alike(radius=40.0, other=25.0, road=220.0),
            alike(radius=40.0, other=25.0, road=290.0),
        ),
        (
            alike(fastest=20.0, other=25.0, road=400.0),
            alike(fastest=20.0, other=25.0, road=510.0),
        ),
    ],
)
def test_a_limit_is_none_beyond_any_road_or_alone_on_bends(none, limit):
    assert placeholder(**none)
    assert not placeholder(**limit)


# --- links


def follows(
    gap: float = 0.0,
    *,
    turn: float = 0.0,
    height: float = 0.0,
    recorded: bool = False,
) -> bool:
    """Whether a lane follows one that ends at (50, 0)."""
    begin = np.array([50.0 + gap, 0.0])
    unit = np.array([np.cos(turn), np.sin(turn)])
    lanes = {
        "a": Lane(
            np.array([[0.0, 0.0], [50.0, 0.0]]),
            3.6,
            heights=np.zeros(2),
            exits=["b"] if recorded else [],
        ),
        "b": Lane(
            np.stack([begin, begin + 50 * unit]), 3.6, heights=np.full(2, height)
        ),
    }
    return drivable_exits(lanes)[0]["a"] == ["b"]


@pytest.mark.parametrize(
    ("inside", "outside"),
    [
        ({"gap": 1.4}, {"gap": 1.6}),
        ({"turn": 0.57}, {"turn": 0.63}),
        ({"height": 1.9}, {"height": 2.1}),
        ({"gap": 4.8, "recorded": True}, {"gap": 5.2, "recorded": True}),
        ({"turn": 0.95, "recorded": True}, {"turn": 1.05, "recorded": True}),
    ],
)
def test_a_lane_follows_where_it_begins_near_in_line_and_level(inside, outside):
    assert follows(**inside)
    assert not follows(**outside)


@pytest.mark.parametrize(
    ("width", "plausible"), [(2.4, 3.7), (2.6, 2.6), (5.9, 5.9), (6.1, 3.7)]
)
def test_a_lane_is_two_and_a_half_to_six_metres_wide(width, plausible):
    assert plausible_width(width) == plausible


@pytest.mark.parametrize(
    ("distance", "beside"), [(0.4, True), (5.5, True), (5.7, False), (-0.6, False)]
)
def test_neighbours_lie_less_than_two_metres_beside_each_other(distance, beside):
    lanes = {
        "a": Lane(np.array([[0.0, 0.0], [50.0, 0.0]]), 3.6, left=["b"]),
        "b": Lane(np.array([[0.0, distance], [50.0, distance]]), 3.6),
    }
    lines = {name: resample(lane.points, 1.0) for name, lane in lanes.items()}
    assert adjacent(lanes, lines)[0]["a"].left == (["b"] if beside else [])


# --- lane graph


def straight(y: float, turn: float = 0.0) -> Lane:
    unit = np.array([np.cos(turn), np.sin(turn)])
    return Lane(np.stack([[0.0, y] - 300 * unit, [0.0, y] + 300 * unit]), 3.6)


@pytest.mark.parametrize(
    ("y", "turn", "near"),
    [(4.9, 0.0, True), (5.1, 0.0, False), (0.0, 0.78, True), (0.0, 0.82, False)],
)
def test_a_vehicle_s_lane_is_within_five_metres_and_0_8_rad(y, turn, near):
    lanes = LaneGraph({"a": straight(y, turn)}).near_lanes(np.zeros(2), 0.0)
    assert bool(lanes) == near


def test_a_vehicle_starts_on_six_lanes_at_most():
    graph = LaneGraph({str(k): straight(0.5 * k) for k in range(9)})
    starts = graph.near_lanes(np.zeros(2), 0.0)
    assert [name for name, _ in starts] == ["0", "1", "2", "3", "4", "5"]


def test_a_radian_is_worth_two_and_a_half_metres():
    graph = LaneGraph({"turned": straight(0.0, 0.4), "beside": straight(0.9)})
    assert graph.near_lanes(np.zeros(2), 0.0)[0][0] == "beside"
    graph = LaneGraph({"turned": straight(0.0, 0.4), "beside": straight(1.1)})
    assert graph.near_lanes(np.zeros(2), 0.0)[0][0] == "turned"


@pytest.mark.parametrize(("gap", "routes"), [(1.1, 1), (1.3, 2)])
def test_routes_closer_than_1_2_m_are_one(gap, routes):
    graph = LaneGraph({"a": straight(0.0), "b": straight(gap)})
    assert len(graph.candidates(np.array([0.0, 0.0, 0.0, 8.0]), 6, 150)) == routes


@pytest.mark.parametrize(
    ("speed", "fork", "ways"),
    [
        (0.0, 38.0, 2),
        (0.0, 42.0, 1),
        (11.0, 78.0, 2),
        (11.0, 82.0, 1),
    ],
)
def test_forks_count_as_far_as_they_are_reached(speed, fork, ways):
    """In 5 s, from 25 m on: 40 m or more, rounded up to the next 20 m of the lane."""
    ends = {
        "on": np.array([[fork, 0.0], [fork + 400, 0.0]]),
        "left": np.array([[fork, 0.0], [fork + 300, 150.0]]),
    }
    lanes = {name: Lane(points, 3.6) for name, points in ends.items()}
    lanes["in"] = Lane(np.array([[0.0, 0.0], [fork, 0.0]]), 3.6, exits=["on", "left"])
    pose = np.array([0.0, 0.0, 0.0, speed])
    assert len(LaneGraph(lanes).candidates(pose, 6, 150)) == ways


def tree(name: str, begin: np.ndarray, angle: float, forks: int) -> dict[str, Lane]:
    """A lane of 30 m that forks again and again."""
    end = begin + 30 * np.array([np.cos(angle), np.sin(angle)])
    exits = [f"{name}l", f"{name}r"] if forks else []
    lanes = {name: Lane(np.stack([begin, end]), 3.6, exits=exits)}
    for other, turn in zip(exits, (0.3, -0.3), strict=False):
        lanes |= tree(other, end, angle + turn, forks - 1)
    return lanes


def test_branches_are_four_at_most():
    graph = LaneGraph(tree("a", np.zeros(2), 0.0, forks=3))
    assert len(graph.branches("a", 0.0, 100.0)) == 4


def test_a_route_leads_300_m_ahead():
    points = 50.0 * np.arange(11)[:, None] * EAST
    lanes = {
        str(k): Lane(points[k : k + 2], 3.6, exits=[str(k + 1)]) for k in range(10)
    }
    (branch,) = LaneGraph(lanes).branches("0", 0.0, 100.0)
    assert len(branch) == 6


@pytest.mark.parametrize(("lateral", "against"), [(2.4, True), (2.6, False)])
def test_a_vehicle_is_on_a_lane_within_two_and_a_half_metres(lateral, against):
    points = torch.stack([torch.arange(20.0), torch.zeros(20)], -1)[None]
    xy = torch.tensor([[[5.0, lateral]]])
    heading = torch.full((1, 1, 1), torch.pi)
    lane = torch.zeros(1, 20, dtype=torch.long)
    assert against_lanes(points, lane, xy, heading).item() == against
