"""Evasions found are real: DrivingEnv drives them without contact; where there is no
way out none is found."""

import pytest
import torch
from tensordict import TensorDict

from e2rl.metrics import evasion
from e2rl.metrics.evasion import (
    Knots,
    add_avoidable,
    executed,
    find_evasions,
    lateral_targets,
    profiles,
    spliced,
)
from e2rl.metrics.evasion_scene import EvasionScene
from e2rl.metrics.manoeuvre import knot_count
from e2rl.scenes.boxes import separation
from e2rl.sim.env import DrivingEnv
from e2rl.sim.rollouts import Rollouts
from e2rl.sim.settings import SimSettings
from tests.synthetic import make_scenes

SIZES = {"max_vehicles": 8, "max_agents": 10, "num_routes": 2, "num_points": 150}
BOXED = [
    (0, 0, 0.0),
    (-5, 0, 0.0),
    (5, 0, 0.0),
    (-5, 1, 0.0),
    (0, 1, 0.0),
    (5, 1, 0.0),
    (-30, 0, 12.0),
]
WALL = [(0, 0, 10.0), (40, 0, 0.0), (40, 1, 0.0)]  # both lanes are closed 40 m ahead
CUT = [
    (0, 0, 10.0),
    (12, 0, 0.0),
    (-40, 1, 0.0),
]  # 7.5 m of gap: nobody stops in it at 8 m/s^2 (6.3 m + clearance)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(evasion, "SAMPLES", 64)
    monkeypatch.setattr(evasion, "ROUNDS", 4)


def search(vehicles, moment=None, count=1, sim=None, width=2.0, **options):
    scene_set = make_scenes(
        count, vehicles=vehicles, num_vrus=0, steps=60, **(SIZES | options)
    )
    scene = scene_set.scenes
    scene["size"][:, 1:, 1] = width
    result = find_evasions(
        scene,
        scene["logged"],
        valid=scene["logged_valid"],
        sim=sim or SimSettings(),
        moment=moment,
    )
    return result, scene_set


def replay(scene_set, actions):
    """(contact with anyone, off the road) [B] in DrivingEnv of actions [B, T, 2], and
    the final states [B, 4]."""
    count = len(scene_set)
    env = DrivingEnv(
        scene_set, SimSettings(end_on_contact=False, end_off_road=False), count
    )
    td = env.reset(TensorDict({"scene_index": torch.arange(count)[:, None]}, [count]))
    touched = torch.zeros(count, dtype=torch.bool)
    for action in actions.unbind(1):
        td["action"] = action
        after = env.step(td)["next"]
        metrics = after["metrics"]
        touched = (
            touched
            | (metrics["contact"] | metrics["contact_vru"] | metrics["off_road"])[:, 0]
        )
        td = after.exclude("reward")
    return touched, env.world().states[:, 0]


def test_what_is_found_is_driven_without_contact():
    for vehicles in (WALL, CUT, [(0, 0, 10.0), (-12, 0, 14.0), (15, 0, 6.0)]):
        result, scene_set = search(vehicles, count=3)
        assert result.found.all()
        touched, last = replay(scene_set, result.actions)
        assert not touched.any()
        torch.testing.assert_close(last, result.states[:, -1], atol=1e-3, rtol=0)


def test_the_boxed_in_have_no_way_out_and_nothing_is_claimed():
    scene_set = make_scenes(1, vehicles=BOXED, num_vrus=0, steps=60, **SIZES)
    scene = scene_set.scenes
    scene["logged"][:, :, 1, 0] += torch.linspace(0, 6, 61)  # the one behind pushes
    result = find_evasions(
        scene, scene["logged"], valid=scene["logged_valid"], sim=SimSettings()
    )
    assert not result.found.any()


def test_a_wall_is_a_matter_of_braking_distance():
    far, _ = search(
        WALL, moment=torch.tensor([20]), width=3.4
    )  # 20 m on: 15.5 m of gap are left
    assert far.found.all()
    weak, _ = search(
        WALL, moment=torch.tensor([20]), width=3.4, sim=SimSettings(max_braking=2.0)
    )
    assert not weak.found.any(), (
        "2 m/s^2 stop it after 25 m, and there is no way around"
    )


def test_the_strategy_finds_what_the_grid_does_not(monkeypatch):
    slalom = [
        (0, 0, 10.0),
        (25, 0, 0.0),
        (50, 1, 0.0),
        (-8, 0, 10.0),
        (-14, 1, 10.0),
    ]  # pursued, two lane changes
    fine, scene_set = search(slalom)
    monkeypatch.setattr(evasion, "ROUNDS", 0)
    coarse, _ = search(slalom)
    assert not coarse.found.any()
    assert fine.found.all()
    assert not replay(scene_set, fine.actions)[0].any()


def test_a_rollout_s_result_does_not_depend_on_the_batch():
    together, scene_set = search(CUT, count=3)
    scene = scene_set.scenes[2:]
    alone = find_evasions(
        scene, scene["logged"], valid=scene["logged_valid"], sim=SimSettings()
    )
    torch.testing.assert_close(together.states[2], alone.states[0], atol=1e-4, rtol=0)


SLOW_AHEAD = [(0, 0, 12.0), (40, 0, 3.0), (-40, 1, 5.0)]


def collided():
    """(scenes, rollouts) of two recordings in which the ego runs into a slow vehicle."""
    scene_set = make_scenes(
        2, vehicles=SLOW_AHEAD, num_vrus=0, steps=60, max_vehicles=8, max_agents=10
    )
    scene = scene_set.scenes
    further = {
        "adversaries": scene["valid"] & False,
        "seed": torch.arange(2),
        "eta": torch.zeros(2).double(),
    }
    return scene, Rollouts.in_scenes(
        scene_set,
        torch.arange(2),
        states=scene["logged"],
        valid=scene["logged_valid"],
        **further,
    )


def test_a_collision_has_an_evasion_that_touches_nobody_and_a_clean_rollout_has_none():
    scene, rollouts = collided()
    rows = [{"cfr": 1, "contact_step": 40.0}, {"cfr": 0, "contact_step": float("nan")}]
    add_avoidable(rows, rollouts, scene=scene, sim=SimSettings())
    evasions = rollouts.evasion
    assert rows[0]["avoidable"] == 1
    assert "avoidable" not in rows[1]
    assert evasions.shape == (2, 61, 4)
    assert evasions[1].isnan().all()
    torch.testing.assert_close(evasions[0, 0], scene["logged"][0, 0, 0])
    size = scene["size"][0]
    gap = separation(
        evasions[0][:, None],
        size[:1],
        second=scene["logged"][0, :, 1:],
        second_size=size[1:],
    )
    assert (gap[scene["logged_valid"][0, :, 1:]] > 0).all()
    driven = separation(
        scene["logged"][0, :, :1],
        size[:1],
        second=scene["logged"][0, :, 1:2],
        second_size=size[1:2],
    )
    assert (driven < 0).any(), "the ego as driven has the collision"


def test_an_evasion_from_a_moment_on_follows_what_was_driven_until_then():
    driven = torch.zeros(3, 10, 4)
    after = torch.arange(1, 11.0)[None, :, None].expand(3, -1, 4)
    result = spliced(driven, after, moment=torch.tensor([0, 4, 10]))[..., 0]
    assert result[0].tolist() == list(range(1, 11))
    assert result[1].tolist() == [0] * 4 + [1, 2, 3, 4, 5, 6]
    assert result[2].tolist() == [0] * 10


def test_the_late_search_begins_a_second_before_the_contact_and_is_enough(monkeypatch):
    scene, rollouts = collided()
    moments = []

    def late_only(scene, states, valid, sim, moment):
        moments.append(moment.tolist())
        track = torch.full((len(states), 60, 4), 7.0)
        return evasion.Evasions(
            found=(moment > 0).any().expand(len(states)),
            actions=track[..., :2],
            states=track,
            peak=torch.full((len(states),), 3.0),
            batch_size=[len(states)],
        )

    monkeypatch.setattr(evasion, "find_evasions", late_only)
    rows = [{"cfr": 1, "contact_step": 40.0}, {"cfr": 1, "contact_step": 4.0}]
    add_avoidable(rows, rollouts, scene=scene, sim=SimSettings())
    assert moments == [[0, 0], [30, 0]]
    for row in rows:
        assert row["avoidable"] == 1
        assert row["avoidable_1s"] == 1
        assert row["evasion_accel"] == 3.0
    assert torch.equal(rollouts.evasion[0, :31], scene["logged"][0, :31, 0])
    assert (rollouts.evasion[0, 31:] == 7).all()


def violation(monkeypatch, width=2.0, shift=0.0):
    """m by which an ego fails that keeps its lane past a standing vehicle in the next
    one, `width` m wide, and later drives `shift` m beside it."""
    scene = make_scenes(
        1, vehicles=[(0, 0, 10.0), (20, 1, 0.0)], num_vrus=0, steps=60, **SIZES
    ).scenes
    scene["size"][:, 1, 1] = width
    states = scene["logged"][:, None, 1:, 0].clone()
    states[:, :, 40:, 1] += shift
    monkeypatch.setattr(evasion, "execute", lambda *_, **__: (states[..., :2], states))
    knots = torch.zeros(1, 1, knot_count(60))
    trial = executed(
        EvasionScene.after(
            torch.tensor([0]),
            scene,
            states=scene["logged"],
            valid=scene["logged_valid"],
        ),
        Knots(
            route=torch.zeros(1, 1, dtype=torch.int64),
            accel=knots,
            shift=knots,
            batch_size=[1, 1],
        ),
        SimSettings(),
    )
    return trial.violation.item()


@pytest.mark.parametrize(("gap", "clean"), [(0.045, False), (0.055, True)])
def test_an_evasion_leaves_five_centimetres_to_everybody(gap, clean, monkeypatch):
    """Beside a vehicle in the next lane, 3.5 m to the left; the ego is 2 m wide."""
    width = 2 * (3.5 - 1.0 - gap)
    assert (violation(monkeypatch, width=width) == 0) is clean


@pytest.mark.parametrize(("shift", "clean"), [(-2.2, True), (-2.3, False)])
def test_an_evasion_stays_half_a_metre_within_the_border(shift, clean, monkeypatch):
    """The lane is 3.5 m wide, and the border 1 m beyond it: 2.75 m to the right."""
    assert (violation(monkeypatch, shift=shift) == 0) is clean


@pytest.mark.parametrize(
    ("routes", "expected"),
    [
        (1, [(0, 1.5), (0, -1.5), (0, 3.5), (0, -3.5), (0, 2.5), (0, -2.5)]),
        (2, [(0, 1.5), (0, -1.5), (1, 0), (0, 3.5), (0, -3.5), (0, 2.5), (0, -2.5)]),
        (9, [(0, 1.5), (0, -1.5), (1, 0), (2, 0), (3, 0), (4, 0), (5, 0)]),
    ],
)
def test_a_profile_is_tried_on_up_to_eight_lateral_targets(routes, expected):
    """(Route, m beside it): the mission, half a lane beside it, the other routes, more
    of a lane beside the mission."""
    valid = torch.arange(9)[None] < routes
    route, shift = lateral_targets(valid, torch.tensor([0]))
    targets = list(zip(route[0].tolist(), shift[0].tolist(), strict=True))
    assert len(targets) == 8
    assert targets[: 1 + len(expected)] == [(0, 0.0), *expected]


def test_brakings_begin_every_second_and_are_held():
    """By 2, 4, 6 and 8 m/s^2, from now on or 1 to 4 s later."""
    knots = profiles(torch.zeros(1, 60))[0]
    time = 0.5 * torch.arange(knots.shape[1])
    for level in (2.0, 4.0, 6.0, 8.0):
        for begin in range(5):
            held = -level * (time >= begin)
            assert (knots == held).all(1).any(), (level, begin)


def test_pulses_last_one_or_two_seconds():
    """Braking by 3 or 6 m/s^2, or 2 s of accelerating by 2 or 4 m/s^2."""
    knots = profiles(torch.zeros(1, 60))[0]
    time = 0.5 * torch.arange(knots.shape[1])
    pulses = [(3.0, 1), (3.0, 2), (6.0, 1), (6.0, 2), (-2.0, 2), (-4.0, 2)]
    for level, duration in pulses:
        for begin in range(5):
            pulse = -level * ((time >= begin) & (time < begin + duration))
            assert (knots == pulse).all(1).any(), (level, duration, begin)
