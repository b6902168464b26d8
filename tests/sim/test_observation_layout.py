"""The names of the observation's numbers are those of what stands there, and the page
about them says the same."""

import math

import pytest
import torch

from e2rl.planners import reference
from e2rl.sim.env import DrivingEnv
from e2rl.sim.observation import ELAPSED, OBSERVATION_SIZE, observation_layout
from e2rl.sim.settings import SimSettings
from tests.synthetic import LANE_WIDTH, make_scenes


@pytest.fixture(scope="module")
def seen():
    """{name: quantity in its unit} at the second step of a known scene: the ego at 10
    m/s accelerates by 1 m/s^2 behind a car 20 m ahead of it at 8 m/s; one stands beside
    the road; a red light is at x = 70 m."""
    scenes = make_scenes(
        1,
        vehicles=[(0.0, 0, 10.0), (20.0, 0, 8.0), (-12.0, 1, 9.0)],
        num_vrus=1,
        red_light_x=70.0,
    )
    env = DrivingEnv(scenes, SimSettings(), 1)
    td = env.reset().set("action", torch.tensor([[1.0, 0.0]]))
    observation = env.step(td)["next", "observation"][0].tolist()
    entries = observation_layout()
    return {
        entry.name: entry.scale * value
        for entry, value in zip(entries, observation, strict=True)
    }


def test_every_number_has_a_name_of_its_own():
    names = [entry.name for entry in observation_layout()]
    assert len(set(names)) == len(names) == OBSERVATION_SIZE
    assert names[ELAPSED] == "ego.elapsed"
    for block, first in (
        (reference.ROUTE, "route.0.x"),
        (reference.LIGHTS, "light.0.red"),
        (reference.AGENTS, None),
    ):
        assert names[block.start] == (first or "agent.0.present")


def test_the_ego_and_its_mission(seen):
    near = {"abs": 1e-4}
    assert seen["ego.speed"] == pytest.approx(10.1, **near)
    assert seen["ego.acceleration"] == pytest.approx(1, **near)
    assert seen["ego.yaw_rate"] == seen["ego.offset"] == 0
    assert seen["ego.heading_cos"] == pytest.approx(1)
    assert seen["ego.limit"] == pytest.approx(15)
    assert seen["ego.elapsed"] == pytest.approx(1 / 80)
    assert [seen["ego.length"], seen["ego.width"]] == pytest.approx([4.5, 2.0], abs=0.3)
    assert [seen[f"route.{k}.x"] for k in range(3)] == pytest.approx(
        [2, 4, 7], abs=1e-3
    )
    assert [
        seen[f"route.3.{name}"] for name in ("y", "heading_sin", "curvature", "limit")
    ] == pytest.approx([0, 0, 0, 15])
    assert (seen["light.0.red"], seen["light.0.green"]) == (1, 0)
    assert 0 < seen["light.0.nearness"] < 0.2
    assert seen["border.+0.+2.5"] == pytest.approx(2.5 - LANE_WIDTH * 1.5, abs=0.2), (
        "m beyond the border"
    )


def test_the_nearest_agents(seen):
    assert [seen[f"agent.{k}.present"] for k in range(4)] == [1, 1, 1, 0], (
        "two cars and a pedestrian"
    )
    assert sum(seen[f"agent.{k}.vehicle"] for k in range(3)) == 2
    ahead = next(
        k for k in range(12) if seen[f"agent.{k}.x"] > 15 and seen[f"agent.{k}.vehicle"]
    )
    agent = {
        name.split(".")[2]: value
        for name, value in seen.items()
        if name.startswith(f"agent.{ahead}.")
    }
    assert agent["x"] == pytest.approx(20 + 0.8 - 1.005, abs=0.02)
    assert agent["y"] == pytest.approx(0, abs=1e-4)
    assert agent["velocity_x"] == pytest.approx(8 - 10.1, abs=1e-3)
    assert agent["speed"] == pytest.approx(8, abs=1e-3)
    assert agent["heading_cos"] == pytest.approx(1)
    assert agent["half_length"] == pytest.approx(2.25, abs=0.15)
    assert agent["gap"] == pytest.approx(agent["x"] - 2 * agent["half_length"], abs=0.3)
    assert seen["agent.11.present"] == 0


def test_the_closest_approach_at_constant_velocities(seen):
    """Of the car ahead, which the ego catches up with: the time that the gap lasts, and
    no distance then."""
    ahead = next(
        k for k in range(12) if seen[f"agent.{k}.x"] > 15 and seen[f"agent.{k}.vehicle"]
    )
    agent = {
        name.split(".")[2]: value
        for name, value in seen.items()
        if name.startswith(f"agent.{ahead}.")
    }
    time = agent["x"] / (10.1 - 8)
    assert agent["approach_time"] == pytest.approx(
        math.exp(-min(time, 8) / 2), abs=2e-3
    )
    miss = max(agent["x"] - 8 * (10.1 - 8), 0)
    assert agent["approach_distance"] == pytest.approx(math.exp(-miss / 5), abs=2e-2)


def test_manoeuvres(seen):
    """To brake hard keeps the distance, to accelerate on the lane does not."""
    assert seen["manoeuvre.+3.5.+0.gap"] < seen["manoeuvre.-7.+0.gap"]
    assert seen["manoeuvre.-7.+0.contact"] == pytest.approx(3.7), "none within 3.2 s"


def test_the_mission_is_seen_up_to_75_metres_ahead(seen):
    ahead = [2, 4, 7, 10, 14, 19, 25, 32, 40, 50, 62, 75]
    places = [seen[f"route.{k}.x"] for k in range(12)]
    assert places == pytest.approx(ahead, abs=1e-2)


def test_the_border_is_probed_five_times_five_times():
    probes = [e.name for e in observation_layout() if e.name.startswith("border")]
    ahead = ("-3", "+0", "+5", "+11", "+20")
    aside = ("-5", "-2.5", "+0", "+2.5", "+5")
    assert probes == [f"border.{x}.{y}" for x in ahead for y in aside]


def test_numbers_are_in_units_that_policies_were_trained_with():
    """A scale that changes makes every trained network blind."""
    scale = {entry.name: entry.scale for entry in observation_layout()}
    expected = {
        "ego.speed": 15.0,
        "ego.acceleration": 4.0,
        "ego.offset": 3.0,
        "route.0.x": 40.0,
        "route.0.y": 10.0,
        "agent.0.gap": 10.0,
        "agent.0.turn_rate": 0.5,
        "agent.0.half_length": 2.5,
        "manoeuvre.+1.+0.gap": 3.0,
        "manoeuvre.+1.+0.contact": 3.7,
    }
    assert {name: scale[name] for name in expected} == expected


def test_twelve_agents_are_seen_and_fifteen_manoeuvres():
    names = [entry.name for entry in observation_layout()]
    assert sum(name.endswith(".present") for name in names) == 12
    manoeuvres = [name for name in names if name.startswith("manoeuvre")]
    accelerations = ("-7", "-3.5", "-1", "+1", "+3.5")
    offsets = ("-2.5", "+0", "+2.5")
    assert manoeuvres[:15] == [
        f"manoeuvre.{accel}.{offset}.gap"
        for accel in accelerations
        for offset in offsets
    ]


@pytest.mark.parametrize(("nearer", "counts"), [(5, True), (6, False)])
def test_manoeuvres_are_held_against_the_six_nearest(nearer, counts):
    """A car 20 m ahead, with so many pedestrians nearer than that, far aside."""
    gaps = []
    for ahead in (20.0, 200.0):
        scenes = make_scenes(
            1,
            vehicles=[(0.0, 0, 10.0), (ahead, 0, 0.0)],
            num_vrus=nearer,
        )
        scenes.scenes["start"][0, 32 : 32 + nearer, :2] = torch.tensor([-9.0, -9.0])
        names = [entry.name for entry in observation_layout()]
        observation = DrivingEnv(scenes, SimSettings(), 1).reset()["observation"][0]
        gaps.append(observation[names.index("manoeuvre.+3.5.+0.gap")].item())
    assert (gaps[0] < gaps[1]) == counts
