"""PDM-Closed: it follows, stops, keeps the limit, comes over, brakes; its score is that
of its terms."""

import math

import pytest
import torch

from e2rl.planners import pdm_closed
from e2rl.planners.chunks import take
from e2rl.planners.pdm_closed import FRACTIONS, OFFSETS, PDMClosedEgo, others_of
from e2rl.planners.pdm_score import (
    SCORED_STEPS,
    Drives,
    Others,
    at_fault,
    comfortable,
    in_several_lanes,
    runs_into,
    score,
)
from e2rl.scenes.boxes import separation
from e2rl.scenes.recording import DT, LIGHT_GREEN
from e2rl.sim import dynamics
from tests.planners.planners import all_driven, world_of, worlds
from tests.synthetic import make_scenes

EGO = PDMClosedEgo()
SIZE = torch.tensor([[4.8, 2.0]])  # m, of the ego
PROGRESS = 5  # nuPlan's weights
TIME_TO_COLLISION = 5
COMFORT = 2
COUNT = len(FRACTIONS) * len(OFFSETS)


def scored_others(world):
    return others_of(world, EGO.agents, SCORED_STEPS + 1)


def touched(data):
    """Whether the ego of a rollout touches anybody."""
    return bool(data["next", "metrics", "contact"].any())


def test_it_follows_a_slower_leader_without_contact_and_keeps_the_speed_limit():
    """A leader at 6 m/s in a scene, nobody and limits of 8 and 15 m/s in others."""
    scenes = make_scenes(
        3,
        vehicles=[(0, 0, 14.0), (30, 0, 6.0)],
        num_vrus=0,
    )
    for name in ("valid", "logged_valid"):
        scenes.scenes[name][1:, ..., 1] = False
    scenes.scenes["start"][1:, 0, 3] = scenes.scenes["logged"][1:, :, 0, 3] = 5.0
    scenes.scenes["route_limit"][1] = 8.0
    data, (follower, slow, fast) = all_driven(EGO, scenes)
    assert not touched(data)
    assert 5.0 < float(follower[3]) < 8.0
    fastest = data["next", "agents", "states"][:, :, 0, 3].amax(1)
    assert fastest[1] < 8.1
    assert fastest[2] < 15.1
    assert slow[3] > 0.9 * 8.0
    assert fast[3] > 0.9 * 14.0


def test_it_stops_behind_whom_stands_and_at_a_red_light():
    scenes = make_scenes(
        2,
        vehicles=[(0, 0, 10.0), (60, 0, 0.0)],
        num_vrus=0,
        red_light_x=50.0,
    )
    scenes.scenes["light_state"][0] = LIGHT_GREEN
    for name in ("valid", "logged_valid"):
        scenes.scenes[name][1, ..., 1] = False
    data, (behind, at_line) = all_driven(EGO, scenes)
    assert not touched(data)
    assert float(behind[3]) < 1.5
    assert float(behind[0]) > 45
    assert float(at_line[3]) < 1.5
    assert 35 < float(at_line[0]) < 50


@pytest.mark.parametrize(
    ("speed", "braking"),
    [(4.9, EGO.emergency_braking), (5.1, EGO.braking), (14.0, EGO.braking)],
)
def test_a_slow_ego_brakes_as_hard_as_it_can_before_a_collision_that_is_near_a_fast_one_as_idm_may(
    speed, braking
):
    _, world = world_of(
        vehicles=[(0, 0, speed), (speed, 0, 0.0)],
        num_vrus=0,
    )
    loss = EGO.plan(world)[0, :5, 3].diff() / DT
    torch.testing.assert_close(
        loss,
        torch.full_like(loss, -braking),
        atol=0.05,
        rtol=0,
    )


def test_it_comes_over_where_somebody_who_stands_beside_blocks_the_mission():
    """A parked car reaches 0.2 m into the ego's way, from the left or the right; a
    metre to the other side the ego passes it."""
    scenes = make_scenes(
        2,
        vehicles=[(0.0, 0, 10.0), (40.0, 0, 0.0)],
        num_vrus=0,
    )
    beside = torch.tensor([1.0, -1.0])
    for name in ("start", "logged"):
        scenes.scenes[name][:, ..., 1, 1] = (
            1.8 * beside if name == "start" else 1.8 * beside[:, None]
        )
    _, world = worlds(scenes)
    assert (EGO.plan(world)[:, -1, 1] * beside < -0.7).all()
    data, states = all_driven(EGO, scenes)
    assert not touched(data)
    assert (states[:, 0] > 60).all()


def test_proposals_lead_to_their_offsets_and_are_slower_by_their_fraction():
    _, world = world_of(
        vehicles=[(0, 0, 10.0)],
        num_vrus=0,
        limit=10.0,
    )
    states = EGO.proposals(world)
    assert states.shape[:2] == (1, COUNT)
    end = states[0, :, -1].view(len(OFFSETS), len(FRACTIONS), 4)
    torch.testing.assert_close(
        end[:, -1, 1],
        end[0, -1, 1] + torch.tensor(OFFSETS),
        atol=0.2,
        rtol=0,
    )
    assert (end[..., 3].diff(dim=1) > 0).all()
    assert (end[..., 0].diff(dim=1) > 0).all()


# The ego's speed; the other's place beside a moving ego, and its motion; whether the ego
# is at fault in one lane, in several.
FAULTS = {
    "the front meets a slower one": (10.0, (4.6, 0.0, 0.0, 5.0), True, True),
    "the front meets one that comes": (10.0, (4.6, 0.0, math.pi, 5.0), True, True),
    "one that comes from behind": (10.0, (-4.6, 0.0, 0.0, 15.0), False, False),
    "one beside": (10.0, (0.0, 1.9, 0.0, 9.0), False, True),
    "one that stands beside": (10.0, (0.0, 1.9, 0.0, 0.05), True, True),
    "one that creeps beside": (10.0, (0.0, 1.9, 0.0, 0.06), False, True),
    "a standing ego": (0.05, (4.6, 0.0, math.pi, 5.0), False, False),
}


@pytest.mark.parametrize("name", FAULTS)
def test_whose_fault_a_collision_is(name):
    """nuPlan's rule at the step of the first touch."""
    speed, place, alone, between = FAULTS[name]
    ego = torch.tensor([0.0, 0.0, 0.0, speed])[None, None, None]
    for loose, expected in ((False, alone), (True, between)):
        fault = at_fault(
            Drives(ego, SIZE, loose=torch.full((1, 1, 1), loose)),
            others_at(place),
            touch=torch.ones(1, 1, 1, 1, dtype=torch.bool),
        )
        assert bool(fault.any()) == expected


def test_whom_it_touched_without_fault_it_may_touch_again():
    """Beside first, by its front then; the first touch alone is judged."""
    states = torch.tensor([0.0, 0.0, 0.0, 10.0]).expand(1, 1, 2, 4)
    beside = others_at((0.0, 1.9, 0.0, 9.0))
    ahead = others_at((4.6, 0.0, 0.0, 9.0))
    both = beside._replace(states=torch.cat([beside.states, ahead.states], 2))
    touch = torch.ones(1, 1, 1, 2, dtype=torch.bool)
    loose = torch.zeros(1, 1, 2, dtype=torch.bool)
    ego = Drives(states, SIZE, loose=loose)
    assert not at_fault(ego, both, touch=touch).any()
    swapped = both._replace(states=both.states.flip(2))
    assert at_fault(ego, swapped, touch=touch).any()


def others_at(place):
    """One vehicle of 4.8 x 2 m."""
    states = torch.tensor(place)[None, None, None]
    position = torch.ones(1, 1, dtype=torch.bool)
    return Others(
        states=states,
        size=torch.tensor([[[4.8, 2.0]]]),
        present=position,
        objects=~position,
    )


def test_an_object_that_it_hits_halves_the_score():
    """A vehicle that it hits leaves nothing; both make it brake alike."""
    _, world = world_of(
        vehicles=[(0, 0, 10.0), (20, 0, 0.0)],
        num_vrus=0,
    )
    ahead = scored_others(world)
    go = dynamics.rollout(world.states[:, 0], torch.zeros(1, 50, 2))[:, None]
    vehicle, time = score(world, go, others=ahead)
    thing, same = score(world, go, others=ahead._replace(objects=ahead.present))
    assert vehicle.item() == 0
    assert time.item() == same.item() < 2.0
    assert thing.item() == pytest.approx(
        0.5 * (PROGRESS + COMFORT) / (PROGRESS + TIME_TO_COLLISION + COMFORT)
    )


@pytest.mark.parametrize(("degrees", "expected"), [(29, 0), (31, 1)])
def test_the_time_to_collision_looks_30_degrees_to_each_side_in_one_lane(
    degrees, expected
):
    """At 8 m from the rear axle, across the ego's way in 0.3 s; in several lanes it
    counts up to 150 degrees."""
    axle = -1.461 / 5.176 * 4.8
    angle = math.radians(degrees)
    x = axle + 8 * math.cos(angle)
    y = 8 * math.sin(angle)
    heading = math.atan2(-y, 2.0 - x)
    other = others_at((x, y, heading, math.hypot(y, 2.0 - x) / 0.3))
    states = torch.tensor([0.0, 0.0, 0.0, 0.01])[None, None, None]
    touch = torch.zeros(1, 1, 1, 1, 4, dtype=torch.bool)
    touch[..., 0] = True
    for loose, clear in ((False, expected), (True, 0)):
        ego = Drives(states, SIZE, loose=torch.full((1, 1, 1), loose))
        assert runs_into(ego, other, touch=touch).item() == (not clear)


@pytest.mark.parametrize(("degrees", "expected"), [(149, True), (151, False)])
def test_in_several_lanes_the_time_to_collision_looks_150_degrees_to_each_side(
    degrees, expected
):
    angle = math.radians(degrees)
    axle = -1.461 / 5.176 * 4.8
    place = (axle + 8 * math.cos(angle), 8 * math.sin(angle), 0.0, 5.0)
    ego = Drives(
        torch.tensor([0.0, 0.0, 0.0, 10.0])[None, None, None],
        SIZE,
        loose=torch.ones(1, 1, 1, dtype=torch.bool),
    )
    touch = torch.zeros(1, 1, 1, 1, 4, dtype=torch.bool)
    touch[..., 0] = True
    assert runs_into(ego, others_at(place), touch=touch).item() == expected


@pytest.mark.parametrize(("offset", "expected"), [(0.7, False), (0.8, True)])
def test_who_reaches_beyond_a_lane_of_3_5_metres_is_in_several(offset, expected):
    _, world = world_of(
        vehicles=[(0, 0, 10.0)],
        num_vrus=0,
    )
    world.scene["size"][0, 0, 1] = 2.0
    states = world.states[:, :1, None].clone()
    states[..., 1] = offset
    assert in_several_lanes(world, states).item() == expected


@pytest.mark.parametrize(("seconds", "brakes"), [(1.9, True), (2.1, False)])
def test_it_brakes_for_a_collision_within_two_seconds(monkeypatch, seconds, brakes):
    _, world = world_of(
        vehicles=[(0, 0, 4.0)],
        num_vrus=0,
    )
    result = (torch.zeros(1, COUNT), torch.full((1, COUNT), seconds))
    monkeypatch.setattr(pdm_closed, "score", lambda *_: result)
    accel = (EGO.plan(world)[0, 0, 3] - 4.0) / DT
    assert (accel.item() < -7.9) == brakes


def test_the_free_road_term_of_its_idm_has_the_exponent_10():
    """1.5 m/s^2 at most; the whole limit of 15 m/s is the fifth proposal's."""
    _, world = world_of(
        vehicles=[(0, 0, 12.0)],
        num_vrus=0,
        limit=15.0,
    )
    accel = (EGO.proposals(world)[0, 4, 0, 3] - 12.0) / DT
    assert accel.item() == pytest.approx(1.5 * (1 - 0.8**10), abs=0.01)


@pytest.mark.parametrize(
    ("accel", "yaw_rate", "expected"),
    [
        (2.35, 0.0, True),
        (2.45, 0.0, False),
        (0.0, 0.93, True),
        (0.0, 0.97, False),
    ],
)
def test_comfort_ends_at_nuplan_s_bounds(accel, yaw_rate, expected):
    _, world = world_of(
        vehicles=[(0, 0, 5.0)],
        num_vrus=0,
    )
    world.accel[:, 0] = accel
    actions = torch.tensor([accel, yaw_rate]).expand(SCORED_STEPS, 2)
    states = dynamics.rollout(world.states[0, 0], actions)[None, None]
    states = torch.cat([world.states[:, None, :1], states], 2)
    assert comfortable(world, states).item() == expected


def test_comfort_has_the_published_windows_and_bounds():
    """Smooth braking at 4 m/s^2 is within −4.05; a step of 1.3 m/s^2 between two halves
    of 2 s is no jerk of 4.13."""
    _, world = world_of(
        vehicles=[(0, 0, 30.0)],
        num_vrus=0,
    )
    world.accel[:, 0] = -4.0

    def smooth(accelerations):
        actions = torch.stack(
            [torch.tensor(accelerations), torch.zeros(SCORED_STEPS)], -1
        )
        states = dynamics.rollout(world.states[0, 0], actions)[None, None]
        return comfortable(
            world, torch.cat([world.states[:, None, :1], states], 2)
        ).item()

    assert smooth([-4.0] * 40)
    assert not smooth([-4.1] * 40)
    assert smooth([-3.5] * 20 + [-2.2] * 20)


def test_the_limit_of_the_present_lane_holds_for_the_whole_plan():
    """It does not brake before a lower limit that begins 20 m ahead, as the published
    one does not."""
    scenes = make_scenes(
        1,
        vehicles=[(0, 0, 10.0)],
        num_vrus=0,
        limit=10.0,
    )
    slower = scenes.scenes["route_limit"].clone()
    slower[..., slower.shape[-1] // 2 :] = 2.0
    _, world = worlds(scenes)
    before = EGO.proposals(world)
    scenes.scenes["route_limit"] = slower
    _, world = worlds(scenes)
    assert float(world.states[0, 0, 3]) == 10.0
    assert torch.equal(EGO.proposals(world)[..., :10, 3], before[..., :10, 3])


def test_the_score_is_the_weighted_mean_of_its_terms():
    """Alone on the road: the fastest has all; the slower lose progress in proportion; a
    hard brake loses comfort."""
    _, world = world_of(
        vehicles=[(0, 0, 10.0)],
        num_vrus=0,
    )
    start = world.states[:, :1]
    none = scored_others(world)
    actions = torch.tensor([[0.0, 0.0], [-1.0, 0.0], [-6.0, 0.0]])[:, None].expand(
        3, 50, 2
    )
    states = dynamics.rollout(start[0].expand(3, 4), actions)[None]
    distance = states[0, :, SCORED_STEPS - 1, 0] - start[0, 0, 0]
    result = score(world, states, others=none)[0][0]
    whole = PROGRESS + TIME_TO_COLLISION + COMFORT
    expected = (
        PROGRESS * distance / distance[0]
        + TIME_TO_COLLISION
        + COMFORT * torch.tensor([1.0, 1.0, 0.0])
    )
    torch.testing.assert_close(
        result,
        expected / whole,
        atol=1e-4,
        rtol=0,
    )
    scored = torch.cat([start.expand(3, -1, -1)[None], states[:, :, :SCORED_STEPS]], 2)
    assert comfortable(world, scored)[0].tolist() == [True, True, False]


def test_what_hits_somebody_or_leaves_the_road_scores_nothing():
    _, world = world_of(
        vehicles=[(0, 0, 10.0), (20, 0, 0.0)],
        num_vrus=0,
    )
    ahead = scored_others(world)
    go = dynamics.rollout(world.states[:, 0], torch.zeros(1, 50, 2))[:, None]
    result, collides = score(world, go, others=ahead)
    size = world.scene["size"][0, 0]
    first = (
        int(
            (
                separation(
                    go[0, 0],
                    size,
                    second=world.states[0, 1],
                    second_size=world.scene["size"][0, 1],
                )
                < 0
            ).nonzero()[0, 0]
        )
        + 1
    )
    assert result.item() == 0
    assert collides.item() == pytest.approx(DT * first)
    turn = dynamics.rollout(
        world.states[:, 0], torch.tensor([0.0, -0.6]).expand(1, 50, 2)
    )[:, None]
    free = ahead._replace(present=ahead.present & False)
    assert score(world, turn, others=free)[0].item() == 0


def test_who_is_ahead_within_a_second_at_constant_velocity_costs_the_time_to_collision():
    """Braking late, the ego halts 0.8 m behind whom stands, whom it would hit within
    0.9 s if it let go the brake."""
    _, world = world_of(
        vehicles=[(0, 0, 10.0), (20.0, 0, 0.0)],
        num_vrus=0,
    )
    ahead = scored_others(world)
    actions = torch.tensor([[-3.4, 0.0], [-8.0, 0.0]])[:, None].expand(2, 50, 2)
    states = dynamics.rollout(world.states[0, :1].expand(2, 4), actions)[None]
    result, collides = score(world, states, others=ahead)
    late, early = states[0, :, SCORED_STEPS - 1, 0]
    expected = torch.stack(
        [late / late * PROGRESS + COMFORT, early / late * PROGRESS + TIME_TO_COLLISION]
    )
    assert collides.isinf().all()
    torch.testing.assert_close(
        result[0],
        expected / (PROGRESS + TIME_TO_COLLISION + COMFORT),
        atol=1e-4,
        rtol=0,
    )


def test_where_every_proposal_is_excluded_it_drives_the_slowest():
    """The road ends ahead: no proposal is better than another, and no collision makes
    it brake."""
    scenes = make_scenes(
        1,
        vehicles=[(0, 0, 10.0)],
        num_vrus=0,
    )
    scenes.scenes["field"][:, 86:] = 10.0  # from x = 6 m on
    _, world = worlds(scenes)
    states = EGO.proposals(world)
    assert (score(world, states, others=scored_others(world))[0] == 0).all()
    torch.testing.assert_close(EGO.plan(world)[0], states[0, 0])


def test_a_scene_is_planned_alike_alone_and_in_a_batch():
    scenes = make_scenes(
        3, vehicles=[(0, 0, 10.0), (22, 0, 9.0), (10, 1, 10.0), (45, 1, 8.0)]
    )
    _, world = worlds(scenes)
    whole = EGO.plan(world)
    for k in range(3):
        alone = EGO.plan(take(world, torch.tensor([k])))[0]
        torch.testing.assert_close(
            alone,
            whole[k],
            atol=1e-3,
            rtol=0,
        )
