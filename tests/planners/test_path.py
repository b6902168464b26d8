"""Paths: pass through the pose, end on the route, stay the same when planned anew; caps
of curves, limits, lights."""

import math

import pytest
import torch

from e2rl.planners.path import STOP_GAP, MissionPath, RoutePath, fading, look_up
from e2rl.sim.dynamics import inverse, wrap
from e2rl.sim.env import DrivingEnv
from e2rl.sim.settings import SimSettings
from e2rl.sim.world import World
from tests.loops import loop_scenes
from tests.planners.planners import world_of, worlds
from tests.synthetic import BACK, make_scenes


def arc_route(radius=40.0, points=60):
    angle = 2.0 * torch.arange(points) / radius
    return radius * torch.stack([angle.sin(), 1 - angle.cos()], -1)


STATE = torch.tensor([[15.0, 4.0, 0.3, 8.0], [20.0, 4.5, 0.9, 3.0]])


def test_passes_through_the_pose_and_ends_on_the_route():
    path = RoutePath(STATE, arc_route().expand(2, -1, -1))
    poses = path.at(torch.tensor([0.0, 70.0]).expand(2, 2))
    assert torch.allclose(poses[:, 0], STATE[:, :3], atol=2e-2)
    assert torch.allclose(poses[:, 0, :2], STATE[:, :2], atol=1e-5)
    centre = torch.tensor([0.0, 40.0])
    assert torch.allclose(
        (poses[:, 1, :2] - centre).norm(dim=-1), torch.tensor(40.0), atol=0.05
    )


def test_planning_anew_on_the_way_keeps_the_path():
    route = arc_route(radius=1e5).expand(2, -1, -1)
    path = RoutePath(STATE, route)
    later = torch.cat([path.at(torch.full((2, 1), 5.0))[:, 0], STATE[:, 3:]], 1)
    anew = RoutePath(later, route).at(torch.full((2, 1), 5.0))
    assert torch.allclose(anew, path.at(torch.full((2, 1), 10.0)), atol=0.02)


def test_drive_is_nearly_unicycle_motion():
    """The planned positions advance as their speeds and headings say, also off the
    centreline and in a curve."""
    path = RoutePath(STATE, arc_route().expand(2, -1, -1))
    plan = path.drive(STATE[:, 3:].expand(2, 51))
    states = torch.cat([STATE[:, None], plan], 1)
    step = (states[:, 1:, :2] - states[:, :-1, :2]).norm(dim=-1)
    assert torch.allclose(step, STATE[:, 3:] * 0.1, rtol=0.05)
    assert (inverse(states)[..., 1].abs() * STATE[:, 3:] < 4.0).all()


def test_caps_halt_at_red_lights_and_obey_limits():
    path = MissionPath(
        world_of(
            num_vehicles=1,
            red_light_x=60.0,
            limit=8.0,
        )[1]
    )
    caps = path.speed_caps(20.0)
    stop = 60.0 - 4.5 / 2 - 1.0
    assert torch.allclose(
        look_up(caps, torch.tensor([[0.0, 20.0]])), torch.tensor(8.0), atol=0.01
    )
    at = torch.tensor([[stop - 6.0, stop - 1.5, stop, stop + 1.0]])
    assert torch.allclose(
        look_up(caps, at), torch.tensor([36.0, 9.0, 0.0, 0.0]).sqrt(), atol=0.02
    )
    assert torch.allclose(
        path.speed_caps(
            20.0,
            limits=False,
            lights=False,
        ),
        torch.tensor(400.0),
        atol=0.1,
    )


def stop(colour, speed, light_x=50.0):
    """Metres from the ego's centre to the stop line that binds."""
    world = world_of(
        num_vehicles=1,
        red_light_x=light_x,
    )[1]
    world.scene["light_state"][:], world.states[:, 0, 3] = colour, speed
    return MissionPath(world).stop_distance(braking=3.0).item() + 4.5 / 2 + STOP_GAP


def test_red_binds_unless_halting_is_hopeless_yellow_where_it_is_comfortable():
    assert (
        stop(
            colour=1,
            speed=10,
        )
        == 50.0
    )
    assert (
        stop(
            colour=2,
            speed=10,
        )
        == 50.0
    )
    assert (
        stop(
            colour=1,
            speed=20,
        )
        == 50.0
    )
    assert stop(
        colour=2,
        speed=20,
    ) == float("inf")
    assert stop(
        colour=1,
        speed=30,
    ) == float("inf")
    assert stop(
        colour=3,
        speed=10,
    ) == float("inf")
    assert stop(
        colour=0,
        speed=10,
    ) == float("inf")
    assert stop(
        colour=1,
        speed=1,
        light_x=-5.0,
    ) == float("inf"), "a line passed binds no longer"


@pytest.mark.parametrize(
    ("d", "turned", "length"), [(1.5, 0.2, 8.0), (-0.7, -0.4, 1.5)]
)
def test_a_deviation_fades_as_a_critically_damped_return(d, turned, length):
    """l^2 d'' + 2 l d' + d = 0 from (d, tan(turned)); the slope is the derivative of
    the offset."""
    ahead = torch.linspace(0, 20, 2001, dtype=torch.float64)
    offset, slope = fading(
        torch.tensor(d).double(),
        torch.tensor(turned).double(),
        length=torch.tensor(length).double(),
        ahead=ahead,
    )
    assert offset[0].item() == pytest.approx(d)
    assert slope[0].item() == pytest.approx(math.tan(turned))
    (first,), (bend,) = (
        torch.gradient(offset, spacing=0.01),
        torch.gradient(slope, spacing=0.01),
    )
    inner = slice(2, -2)
    torch.testing.assert_close(
        first[inner],
        slope[inner],
        atol=1e-4,
        rtol=0,
    )
    balance = length**2 * bend + 2 * length * slope + offset
    torch.testing.assert_close(
        balance[inner],
        torch.zeros_like(balance[inner]),
        atol=2e-2,
        rtol=0,
    )


def test_caps_slow_down_for_curves():
    scenes = make_scenes(1, num_vehicles=1)
    angle = (torch.arange(150) * 2.0 - 80).clamp(0, 31.4) / 20
    x = torch.cat([torch.zeros(1), (2 * angle.cos()).cumsum(0)[:-1]]) - 20
    y = torch.cat([torch.zeros(1), (2 * angle.sin()).cumsum(0)[:-1]])
    scenes.scenes["route_points"][0, 0] = torch.stack([x, y], -1)
    caps = MissionPath(worlds(scenes)[1]).speed_caps(20.0, limits=False)[0]
    assert torch.allclose(caps[32:44].min(), torch.tensor(3.0 * 20), rtol=0.05)
    assert caps[15] < 399
    assert abs(caps[-5] - 400) < 1e-2


def test_the_path_stays_on_its_part_of_a_mission_that_crosses_itself():
    """Also where an environment reports the World in a TensorDict."""
    scenes = loop_scenes(speed=12.0)
    env = DrivingEnv(scenes, SimSettings(replay_ego=True), 1, agents=True)
    frame = env.reset()
    for step in range(1, 81):
        frame = env.step(frame.set("action", torch.zeros(1, 2)))["next"]
        for world in (env.world(), World.of(frame, env.scene)):
            path = MissionPath(world)
            assert path.s.item() == pytest.approx(BACK + 1.2 * step, abs=0.5)
            ahead = path.at(torch.linspace(0, 20, 11)[None])[0]
            assert wrap(ahead[:, 2].diff()).abs().max() < 0.2
