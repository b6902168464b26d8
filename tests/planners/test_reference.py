"""The reference follower: executed actions are read back, it keeps its lane, its
distance and red lights."""

import math

import pytest
import torch

from e2rl.planners.actor import ActorEgo
from e2rl.planners.reference import (
    AGENTS,
    LIGHTS,
    follow,
    pursuit_curvature,
    speed_cap_acceleration,
    stop_lines,
)
from e2rl.planners.trunk import Largest, Trunk
from e2rl.scenes.recording import LIGHT_GREEN, LIGHT_RED
from e2rl.sim.env import DrivingEnv
from e2rl.sim.observation import LOOK_AHEAD, NEAREST, OBSERVATION_SIZE, PER_AGENT
from e2rl.sim.settings import SimSettings
from tests.planners.planners import all_driven
from tests.synthetic import make_scenes

EMPTY, CAR_AHEAD, RED_LIGHT, CAR_BESIDE, ALONE, OFFSET = range(6)


@pytest.fixture(scope="module")
def reference():
    """The untrained actor drives as its reference does: 80 steps on a road of one
    lane's limit, a standing car 45 m ahead, a red light at 50 m, a car in the other
    lane, nobody, and an offset at the start."""
    scenes = make_scenes(
        6,
        vehicles=[(0.0, 0, 10.0), (45.0, 0, 0.0), (45.0, 1, 0.0)],
        num_vrus=0,
        red_light_x=50.0,
        road=(-60.0, 600.0),
    )
    light = scenes.scenes["light_state"]
    light[:] = LIGHT_GREEN
    light[RED_LIGHT] = LIGHT_RED
    scenes.scenes["route_limit"][EMPTY] = 12.0
    for name in ("valid", "logged_valid"):
        present = scenes.scenes[name]
        present[..., 1:3] = False
        present[CAR_AHEAD, ..., 1] = True
        present[CAR_BESIDE, ..., 2] = True
    start = scenes.scenes["start"]
    start[..., 0] -= torch.arange(6.0)[:, None]  # all begin at one place
    start[OFFSET, 0, 1] = 1.0
    start[OFFSET, 0, 2] = 0.1
    return all_driven(ActorEgo(hidden=(8,)), scenes, end_on_contact=False)


def test_an_empty_road_is_driven_at_the_limit(reference):
    data, states = reference
    assert 11.0 < states[EMPTY, 3] < 12.0
    assert data["action"][EMPTY, :, 1].abs().max() < 1e-3


def test_a_standing_car_is_halted_at(reference):
    data, states = reference
    assert not data["next", "metrics", "contact"].any()
    assert states[CAR_AHEAD, 3] < 1.0
    assert states[CAR_AHEAD, 0] > 30.0


def test_a_red_light_is_halted_at(reference):
    _, states = reference
    front = states[RED_LIGHT, 0] + 2.25
    assert 40.0 < front < 50.0


def test_a_car_in_the_other_lane_is_no_leader(reference):
    actions = reference[0]["action"]
    assert torch.allclose(actions[ALONE], actions[CAR_BESIDE])


def test_an_offset_is_steered_back(reference):
    assert reference[1][OFFSET, 1].abs() < 0.1


def test_leading_dims_do_not_matter():
    env = DrivingEnv(
        make_scenes(
            3,
            num_vehicles=12,
            red_light_x=60.0,
        ),
        SimSettings(),
        3,
    )
    observation = env.rollout(10)["observation"]
    one_by_one = torch.stack([follow(row) for row in observation.flatten(0, 1)])
    assert torch.allclose(follow(observation).flatten(0, 1), one_by_one, atol=1e-5)


def test_the_order_of_the_agents_changes_nothing_and_each_of_them_counts():
    torch.manual_seed(0)
    trunk = Trunk(
        (32, 16),
        8,
        out=2,
        last_gain=1.0,
    )
    observed = torch.randn(5, OBSERVATION_SIZE)
    agents = observed[:, AGENTS].unflatten(1, (NEAREST, PER_AGENT))
    shuffled = observed.clone()
    out = trunk(observed)
    shuffled[:, AGENTS] = agents[:, torch.randperm(NEAREST)].flatten(1)
    assert out.shape == (5, 2)
    assert torch.allclose(trunk(shuffled), out, atol=1e-6)
    for slot in range(NEAREST):
        moved = observed.clone()
        moved[
            :, AGENTS.start + slot * PER_AGENT : AGENTS.start + (slot + 1) * PER_AGENT
        ] += 3.0
        assert (trunk(moved) - out).abs().amax() > 1e-3


def test_the_rest_of_the_scene_counts_and_a_last_layer_of_zeros_says_nothing():
    torch.manual_seed(0)
    observed = torch.randn(OBSERVATION_SIZE, requires_grad=True)
    (gradient,) = torch.autograd.grad(
        Trunk(
            (32,),
            8,
            out=1,
            last_gain=1.0,
        )(observed).sum(),
        observed,
    )
    assert (gradient[: AGENTS.start] != 0).all()
    assert (gradient[AGENTS.stop :] != 0).all()
    assert torch.equal(
        Trunk(
            (32, 16),
            8,
            out=2,
            last_gain=0.0,
        )(observed),
        torch.zeros(2),
    )


def test_the_gradient_of_the_largest_is_shared_among_equals():
    values = torch.randint(3, (4, 5, 6), dtype=torch.float32).requires_grad_()
    weight = torch.randn(4, 6)
    (ours,), (other,) = (
        torch.autograd.grad((f(values) * weight).sum(), values)
        for f in (Largest.apply, lambda x: x.amax(1))
    )
    torch.testing.assert_close(ours, other)


@pytest.mark.parametrize(("speed", "reach"), [(1.0, 6.0), (10.0, 15.0), (30.0, 30.0)])
def test_it_pursues_the_path_a_second_and_a_half_ahead(speed, reach):
    """6 to 30 m; to a point d m away and 1 m beside, the curvature is 2 / d^2."""
    path = torch.tensor([[x, 1.0] for x in LOOK_AHEAD])[None]
    curvature = pursuit_curvature(path, torch.tensor([speed])).item()
    assert curvature == pytest.approx(2 / (reach**2 + 1), rel=1e-4)


def test_curves_are_driven_with_2_5_metres_a_square_second_reached_in_half_a_second():
    """5 m/s in a curve of 10 m."""
    route = torch.zeros(1, len(LOOK_AHEAD), 5)
    route[..., 3] = 10 * 0.1
    route[..., 4] = 10.0
    accel = speed_cap_acceleration(route, torch.tensor([10.0])).item()
    assert accel == pytest.approx((5.0 - 10.0) / 0.5, rel=1e-4)


@pytest.mark.parametrize(
    ("colour", "speed", "binds"),
    [(0, 13.9, True), (0, 14.4, False), (1, 9.9, True), (1, 10.1, False)],
)
def test_red_binds_up_to_5_and_yellow_up_to_2_5_metres_a_square_second(
    colour, speed, binds
):
    """At 20 m from the line."""
    observation = torch.zeros(1, OBSERVATION_SIZE)
    observation[0, LIGHTS.start + colour] = 1.0
    observation[0, LIGHTS.start + 3] = math.exp(-20 / 30)
    distance = stop_lines(observation, torch.tensor([speed]))[0, 0].item()
    assert distance == (pytest.approx(20.0, rel=1e-4) if binds else math.inf)
