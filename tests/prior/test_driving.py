"""Plans as they are driven: every step as long as the speed makes it, on the planned
line."""

import math

import pytest
import torch

from e2rl.prior import free_space, lane_relative
from e2rl.prior.driving import as_driven
from e2rl.prior.lane_relative import SIZE
from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import turn_bound, wrap
from tests.prior.small import arc, random_state

COUNT = 64
ON_LANE = torch.ones(COUNT, dtype=torch.bool)


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(0)


def routes(sharpest):
    return torch.stack(
        [
            arc(
                0.0,
                0.0,
                heading=0.3,
                curvature=curvature,
            )
            for curvature in torch.linspace(-sharpest, sharpest, COUNT)
        ]
    )


def steps_of(state, motion):
    """Displacement [V, H, 2], mean speed and mean heading [V, H] of each step."""
    states = torch.cat([state.states()[:, None], motion.states()], 1)
    change = wrap(states[..., 2].diff(dim=1))
    mean = (states[:, 1:, 3] + states[:, :-1, 3]) / 2
    return states[..., :2].diff(dim=1), mean, states[:, :-1, 2] + change / 2, change


def turned(state, angle):
    """The vehicles at `angle` to their routes."""
    heading = state.heading - torch.atan(state.d1) + angle
    return lane_relative.LaneState(
        **(
            vars(state)
            | {"heading": heading, "d1": torch.full_like(state.d1, angle).tan()}
        )
    )


@pytest.mark.parametrize("angle", [0.0, 0.5, -1.0, 1.4])
def test_every_step_is_as_long_as_the_speed_makes_it_and_along_the_heading(
    generator, angle
):
    points = routes(0.05)
    state = turned(random_state(points, generator), angle)
    plan = lane_relative.decode(
        torch.randn(COUNT, SIZE, generator=generator), state, points=points
    )
    step, speed, heading, change = steps_of(
        state, as_driven(plan, state, on_lane=ON_LANE)
    )
    expected = DT * speed[..., None] * torch.stack([heading.cos(), heading.sin()], -1)
    torch.testing.assert_close(
        step,
        expected,
        rtol=0,
        atol=1e-4,
    )
    assert (change.abs() <= turn_bound(speed) + 1e-5).all()


def test_a_plan_along_a_straight_route_is_driven_as_it_is(generator):
    points = routes(0.0)
    state = turned(random_state(points, generator), 0.0)
    x = torch.randn(COUNT, SIZE, generator=generator)
    state.d2[:] = state.d[:] = x[:, lane_relative.KNOTS :] = 0
    plan = lane_relative.decode(x, state, points=points)
    driven = as_driven(plan, state, on_lane=ON_LANE)
    for name in ("s", "d", "v", "a", "heading"):
        torch.testing.assert_close(
            getattr(driven, name),
            getattr(plan, name),
            rtol=0,
            atol=1e-3,
            msg=name,
        )


@pytest.mark.parametrize("side", [-3.0, 3.0])
def test_who_keeps_beside_a_bend_drives_a_circle_of_its_own_at_its_own_speed(side):
    """10 m/s at 3 m beside a circle of 40 m: 43 or 37 m, and as much more or less of
    the route."""
    radius = 40.0
    speed = 10.0
    points = arc(
        0.0,
        0.0,
        heading=0.0,
        curvature=1 / radius,
    )[None]
    states = torch.tensor([[[0.0, side, 0.0, speed]]])
    state = lane_relative.locate(
        states,
        torch.zeros(1, 1),
        yaw_rate=torch.full((1, 1), speed / (radius - side)),
        points=points[None],
    )
    state = state.map(lambda value: value[0])
    state.d2[:] = 0
    x = torch.zeros(1, SIZE)
    x[:, lane_relative.KNOTS + 1] = side / lane_relative.OFFSET_SCALE
    plan = lane_relative.decode(x, state, points=points)
    driven = as_driven(plan, state, on_lane=ON_LANE[:1])
    from_centre = torch.hypot(driven.x, driven.y - radius)
    assert (from_centre - (radius - side)).abs().max() < 0.15
    assert driven.heading[0, 9].item() == pytest.approx(
        10.0 / (radius - side), abs=0.01
    )
    assert driven.s[0, 9].item() - state.s.item() == pytest.approx(
        10.0 * radius / (radius - side), abs=0.15
    )


def test_plans_in_free_space_are_driven_as_they_are(generator):
    state = random_state(routes(0.02), generator)
    plan = free_space.decode(0.3 * torch.randn(COUNT, SIZE, generator=generator), state)
    driven = as_driven(plan, state, on_lane=~ON_LANE)
    gap = torch.hypot(driven.x - plan.x, driven.y - plan.y)
    assert gap.max() < 0.01
    assert wrap(driven.heading - plan.heading).abs().max() < 1e-3


def test_a_jump_of_the_heading_is_driven_as_a_turn_at_the_steering_s_limit():
    state = turned(
        random_state(routes(0.0), torch.Generator().manual_seed(1), speed=(5.0, 5.0)),
        math.pi / 2 - 0.05,
    )
    plan = lane_relative.decode(torch.zeros(COUNT, SIZE), state, points=routes(0.0))
    plan.heading = plan.heading - 0.8
    _, speed, _, change = steps_of(state, as_driven(plan, state, on_lane=ON_LANE))
    assert change[:, 0].abs().max() <= turn_bound(speed[:, 0]).max() + 1e-5


def test_who_reverses_rolls_to_a_halt_and_then_drives_as_planned():
    state = random_state(
        routes(0.0), torch.Generator().manual_seed(2), speed=(-2.0, -2.0)
    )
    driven = as_driven(
        lane_relative.decode(torch.zeros(COUNT, SIZE), state, points=routes(0.0)),
        state,
        on_lane=ON_LANE,
    )
    step, speed, heading, _ = steps_of(state, driven)
    expected = DT * speed[..., None] * torch.stack([heading.cos(), heading.sin()], -1)
    torch.testing.assert_close(
        step,
        expected,
        rtol=0,
        atol=1e-4,
    )
    torch.testing.assert_close(
        driven.v[:, :6], -2.0 + 0.3 * torch.arange(1, 7).expand(COUNT, 6)
    )
    assert (driven.v[:, 6:] >= 0).all()
