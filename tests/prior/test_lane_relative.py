"""Decoding and fitting along routes: continuity, closed forms, no reversing, and the
round trip."""

import pytest
import torch

from e2rl.prior.lane_relative import (
    HORIZON,
    KNOTS,
    SIZE,
    LaneState,
    decode,
    fit,
    lateral_horizon,
    locate,
    polynomial,
    speeds,
    split,
)
from tests.prior.small import arc, random_state

COUNT = 64
TIME = 0.1 * torch.arange(1, HORIZON + 1)
OFFSET_SCALE = 0.5


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(0)


def routes(count=COUNT):
    curvature = torch.linspace(-0.02, 0.02, count).tolist()
    return torch.stack(
        [
            arc(
                0.0,
                0.0,
                heading=0.3,
                curvature=c,
            )
            for c in curvature
        ]
    )


def straight(
    v,
    a=0.0,
    d=0.0,
    heading=0.0,
    count=1,
):
    """Vehicles at 20 m of a route along +x."""
    full = lambda value: torch.full((count,), float(value))  # noqa: E731
    return LaneState(
        full(20),
        full(d),
        d1=full(heading).tan(),
        d2=full(0),
        v=full(v),
        a=full(a),
        x=full(0),
        y=full(d),
        heading=full(heading),
        kappa=full(0),
    )


def test_plans_begin_where_and_as_the_vehicle_is(generator):
    points = routes()
    state = random_state(points, generator)
    x = torch.randn(COUNT, SIZE, generator=generator)
    plan = decode(x, state, points=points)
    step = 0.1 * (state.v + plan.v[:, 0]) / 2
    expected = torch.stack(
        [state.x + step * state.heading.cos(), state.y + step * state.heading.sin()], -1
    )
    gap = torch.stack([plan.x[:, 0], plan.y[:, 0]], -1) - expected
    assert gap.norm(dim=-1).max() < 0.12, (
        "vertices are chords: a few cm on the tightest bend"
    )
    turn = (
        torch.remainder(plan.heading[:, 0] - state.heading + torch.pi, 2 * torch.pi)
        - torch.pi
    )
    assert turn.abs().max() < 0.08
    assert (plan.v[:, 0] - state.v).abs().max() < 0.1 * 4 + 1e-4
    torch.testing.assert_close(
        plan.a[:, 0],
        0.9 * state.a + 0.1 * x[:, 0],
        rtol=0,
        atol=1e-2,
        msg="trapezoid",
    )


def test_the_offset_passes_its_half_way_mark_and_ends_flat_at_its_target(generator):
    state = straight(
        8.0,
        d=1.5,
        heading=0.05,
    )
    x = torch.zeros(1, SIZE)
    x[:, KNOTS:] = torch.tensor([0.8, -2.0])
    plan = decode(
        x,
        state,
        points=arc(
            0,
            0,
            heading=0,
            curvature=0,
        )[None],
    )
    reach = lateral_horizon(state.v).item()
    end = -2.0 * OFFSET_SCALE
    way = plan.s - state.s
    assert reach == pytest.approx(32.0)
    half = split(x, state)[1].item()
    assert plan.d[0, (way[0] - reach / 2).abs().argmin()].item() == pytest.approx(
        half, abs=0.05
    )
    after = way[0] >= reach
    assert after.any()
    torch.testing.assert_close(
        plan.d[0, after],
        torch.full((int(after.sum()),), end),
        rtol=0,
        atol=1e-4,
    )
    torch.testing.assert_close(
        plan.heading[0, after],
        torch.zeros(int(after.sum())),
        rtol=0,
        atol=1e-4,
    )


@pytest.mark.parametrize("accel", [-1.0, 0.0, 1.5])
def test_constant_acceleration_is_the_closed_form(accel):
    state = straight(12.0, a=accel)
    x = torch.cat([torch.full((1, KNOTS), accel), torch.zeros(1, 2)], 1)
    plan = decode(
        x,
        state,
        points=arc(
            0,
            0,
            heading=0,
            curvature=0,
        )[None],
    )
    torch.testing.assert_close(plan.v[0], 12 + accel * TIME)
    torch.testing.assert_close(
        plan.x[0],
        12 * TIME + accel * TIME**2 / 2,
        rtol=1e-4,
        atol=1e-3,
    )


def test_nobody_reverses(generator):
    points = routes()
    state = random_state(points, generator, speed=(0.0, 5.0))
    plan = decode(
        -4 * torch.rand(COUNT, SIZE, generator=generator), state, points=points
    )
    assert (plan.v >= 0).all()
    assert (plan.s.diff(dim=-1) >= -1e-5).all()
    assert (plan.v[:, -1] == 0).all()


def test_gradients_are_finite_everywhere(generator):
    points = routes()
    state = random_state(points, generator, speed=(0.0, 8.0))
    x = (3 * torch.randn(COUNT, SIZE, generator=generator)).requires_grad_(True)
    plan = decode(x, state, points=points)
    (gradient,) = torch.autograd.grad(plan.states().square().sum(), x)
    assert gradient.isfinite().all()
    assert (gradient[:, :KNOTS] != 0).any(1).all(), "a held speed still passes some"


def test_a_standing_vehicle_does_not_move_sideways():
    state = straight(
        0.0,
        d=1.0,
        heading=0.2,
    )
    x = torch.cat([-torch.ones(1, KNOTS), torch.tensor([[3.0, -4.0]])], 1)
    plan = decode(
        x,
        state,
        points=arc(
            0,
            0,
            heading=0,
            curvature=0,
        )[None],
    )
    for name in ("x", "y", "heading"):
        torch.testing.assert_close(
            getattr(plan, name),
            getattr(state, name)[:, None].expand(1, HORIZON),
            rtol=0,
            atol=1e-4,
        )


def test_fitting_a_decoded_plan_gives_it_back(generator):
    """Accelerations that change slowly: what changes faster is taken for noise
    (ROUGHNESS)."""
    points = routes()
    state = random_state(points, generator, speed=(10.0, 15.0))
    knots = state.a[:, None] + (
        0.05 * torch.randn(COUNT, KNOTS, generator=generator)
    ).cumsum(1)
    x = torch.cat([knots.clamp(-1.5, 3), torch.randn(COUNT, 2, generator=generator)], 1)
    plan = decode(x, state, points=points)
    result, error = fit(plan, torch.ones_like(plan.s), state=state)
    assert error.max() < 0.1
    torch.testing.assert_close(
        result[:, :KNOTS],
        x[:, :KNOTS],
        rtol=0,
        atol=0.15,
    )
    # The ridge pulls lateral knots towards 0; the offsets they stand for are met within
    # centimetres.
    torch.testing.assert_close(
        decode(result, state, points=points).d,
        plan.d,
        rtol=0,
        atol=0.08,
    )


def test_unknown_steps_do_not_influence_a_fit(generator):
    points = routes()
    state = random_state(points, generator)
    plan = decode(torch.randn(COUNT, SIZE, generator=generator), state, points=points)
    certain = torch.ones_like(plan.s)
    certain[:, 20:] = 0
    other = plan.map(lambda value: torch.where(certain > 0, value, -77.0))
    for first, two in zip(
        fit(plan, certain, state=state), fit(other, certain, state=state), strict=True
    ):
        torch.testing.assert_close(first, two)


def test_travelled_distance_is_the_integral_of_speed(generator):
    state = straight(
        3.0,
        a=-1.0,
        count=COUNT,
    )
    v, way = speeds(state, torch.randn(COUNT, KNOTS, generator=generator))
    before = torch.cat([state.v[:, None], v[:, :-1]], 1)
    torch.testing.assert_close(
        way.diff(
            dim=-1,
            prepend=torch.zeros(COUNT, 1),
        ),
        (v + before) / 2 * 0.1,
        rtol=0,
        atol=1e-5,
    )


def test_the_polynomial_and_its_gradients():
    """Value and derivatives are those of the power sum; the gradients in closed form
    are the numerical ones."""
    draw = torch.Generator().manual_seed(2)
    c = torch.randn(
        3,
        2,
        7,
        generator=draw,
        dtype=torch.float64,
        requires_grad=True,
    )
    u = torch.rand(
        3,
        2,
        5,
        generator=draw,
        dtype=torch.float64,
        requires_grad=True,
    )
    power = torch.arange(7)
    at = u[..., None]
    value, first, second = polynomial(c, u)
    assert torch.allclose(value, (c[..., None, :] * at**power).sum(-1))
    assert torch.allclose(
        first, (c[..., None, 1:] * power[1:] * at ** power[:-1]).sum(-1)
    )
    assert torch.allclose(
        second,
        (c[..., None, 2:] * (power * (power - 1))[2:] * at ** power[:-2]).sum(-1),
    )
    assert torch.autograd.gradcheck(polynomial, (c, u))


def test_a_plan_is_five_seconds_long_with_a_knot_every_half_second():
    assert (HORIZON, KNOTS, SIZE) == (50, 10, 12)


def test_lateral_knots_are_half_metres_at_the_end_and_a_bend_half_way():
    state = straight(8.0, d=1.0)
    x = torch.zeros(1, SIZE)
    x[0, KNOTS:] = torch.tensor([2.0, -3.0])
    _, half, end = split(x, state)
    assert end.item() == pytest.approx(0.5 * -3.0)
    assert half.item() == pytest.approx((1.0 - 1.5) / 2 + 0.15 * 2.0)


@pytest.mark.parametrize(
    ("speed", "reach"), [(1.0, 10.0), (8.0, 32.0), (19.0, 76.0), (30.0, 80.0)]
)
def test_an_offset_settles_within_four_seconds_and_ten_to_eighty_metres(speed, reach):
    assert lateral_horizon(torch.tensor(speed)).item() == pytest.approx(reach)


def test_deep_inside_a_bend_a_metre_of_route_is_three_tenths_of_the_line():
    """At 19 m inside of a circle of 20 m it would be a twentieth."""
    turn = 0.2
    state = locate(
        torch.tensor([[[0.0, 19.0, turn, 5.0]]]),
        torch.zeros(1, 1),
        yaw_rate=torch.zeros(1, 1),
        points=arc(
            0.0,
            0.0,
            heading=0.0,
            curvature=0.05,
        )[None, None],
        hint=torch.full((1, 1), 20.0),
    )
    at_nearest = state.d1 / torch.tan(wrap_of(state, turn))
    assert at_nearest.item() == pytest.approx(0.3, rel=1e-3)


def wrap_of(state, heading):
    """Angle of a vehicle to a circle of 0.05 / m that it looks along at 20 m."""
    return heading - 0.05 * (state.s - 20.0)


def test_a_twentieth_of_the_gradient_passes_where_the_speed_is_held_at_0():
    """The last knot's share of the last speed is half of 0.5 s."""
    knots = torch.full((1, KNOTS), -4.0, requires_grad=True)
    v, _ = speeds(straight(1.0), knots)
    v[0, -1].backward()
    assert v[0, -1] == 0
    assert knots.grad[0, -1].item() == pytest.approx(0.05 * 0.25, rel=1e-4)


def ridge_fit(track, known, state):
    """Acceleration knots by least squares on stacked rows, second differences weighted
    by 0.3, knots by 0.001."""
    columns = [speeds(state, unit[None]) for unit in torch.eye(KNOTS)]
    base_v, base_s = speeds(state, torch.zeros(1, KNOTS))
    rows_v = torch.cat([v - base_v for v, _ in columns]).T * known.T
    rows_s = torch.cat([s - base_s for _, s in columns]).T * known.T / 2
    bend = torch.eye(KNOTS + 1).diff(
        n=2,
        dim=0,
    )
    rows = [rows_v, rows_s, 0.3**0.5 * bend[:, 1:], 1e-3**0.5 * torch.eye(KNOTS)]
    right = [
        (known * (track.v - base_v))[0],
        (known * (track.s - state.s[:, None] - base_s))[0] / 2,
        -(0.3**0.5) * bend[:, 0] * state.a,
        torch.zeros(KNOTS),
    ]
    system = torch.cat(rows).double()
    return torch.linalg.lstsq(system, torch.cat(right).double()[:, None])[0][:, 0]


@pytest.mark.parametrize("steps", [0, 12, 50])
def test_fitted_accelerations_are_those_of_the_ridge(steps):
    """Of a motion that changes fast, known for so many steps."""
    state = straight(12.0, a=1.0)
    x = torch.zeros(1, SIZE)
    x[0, :KNOTS:2] = 2.0
    track = decode(
        x,
        state,
        arc(
            0,
            0,
            heading=0,
            curvature=0,
        )[None],
    )
    certain = (torch.arange(HORIZON) < steps).float()[None]
    knots = fit(track, certain, state)[0][0, :KNOTS]
    expected = ridge_fit(track, certain, state)
    torch.testing.assert_close(
        knots.double(),
        expected,
        rtol=0,
        atol=2e-3,
    )


def test_fitted_lateral_knots_are_those_of_the_ridge():
    """Weighted by 0.05 and 0.02, of a jump of 2 m that five steps know."""
    state = straight(8.0)
    route = arc(
        0,
        0,
        heading=0,
        curvature=0,
    )[None]
    track = decode(torch.zeros(1, SIZE), state, route)
    track.d = torch.full_like(track.d, 2.0)
    certain = torch.zeros(1, HORIZON)
    certain[:, 20:25] = 1.0
    units = []
    for number in (KNOTS, KNOTS + 1):
        x = torch.zeros(1, SIZE)
        x[0, number] = 1.0
        units.append(decode(x, state, route).d[0, 20:25])
    rows = torch.stack(units, -1).double()
    gram = rows.T @ rows + torch.diag(torch.tensor([0.05, 0.02])).double()
    expected = torch.linalg.solve(gram, (2.0 * rows).sum(0))
    lateral = fit(track, certain, state)[0][0, KNOTS:]
    torch.testing.assert_close(
        lateral.double(),
        expected,
        rtol=1e-3,
        atol=1e-3,
    )


@pytest.mark.parametrize(("accel", "limit"), [(-15.0, -8.0), (12.0, 5.0)])
def test_fitted_accelerations_are_what_a_car_can_do(accel, limit):
    state = straight(60.0 if accel < 0 else 5.0)
    track = straight(0.0).map(lambda value: value[:, None].expand(1, HORIZON))
    track.v = state.v[:, None] + accel * TIME
    track.s = state.s[:, None] + state.v[:, None] * TIME + accel * TIME**2 / 2
    knots = fit(track, torch.ones(1, HORIZON), state)[0][0, :KNOTS]
    assert knots.abs().max().item() == pytest.approx(abs(limit))
