"""Free-space plans: circles at constant curvature, the round trip, standing still."""

import pytest
import torch

from e2rl.prior.free_space import curvature_scale, decode, fit
from e2rl.prior.lane_relative import HORIZON, KNOTS, SIZE, LaneState

COUNT = 32


def start(v, kappa, heading):
    zero = torch.zeros_like(v)
    return LaneState(
        zero + 20,
        zero,
        d1=zero,
        d2=zero,
        v=v,
        a=zero,
        x=zero + 3,
        y=zero - 2,
        heading=heading,
        kappa=kappa,
    )


def random_start(seed=0):
    generator = torch.Generator().manual_seed(seed)
    draw = lambda low, high: low + (high - low) * torch.rand(COUNT, generator=generator)  # noqa: E731
    return start(draw(4, 12), draw(-0.03, 0.03), heading=draw(-3, 3)), generator


def test_constant_curvature_is_a_circle():
    state, _ = random_start()
    state.kappa = torch.where(state.kappa.abs() < 0.005, 0.005, state.kappa)
    x = torch.zeros(COUNT, SIZE)
    x[:, KNOTS:] = (state.kappa / curvature_scale(state.v))[:, None]
    plan = decode(x, state)
    centre_x = state.x - state.heading.sin() / state.kappa
    centre_y = state.y + state.heading.cos() / state.kappa
    radius = torch.hypot(plan.x - centre_x[:, None], plan.y - centre_y[:, None])
    torch.testing.assert_close(
        radius,
        (1 / state.kappa.abs())[:, None].expand_as(radius),
        rtol=1e-3,
        atol=5e-3,
    )
    way = state.v[:, None] * 0.1 * torch.arange(1, HORIZON + 1)
    torch.testing.assert_close(
        plan.heading,
        state.heading[:, None] + state.kappa[:, None] * way,
        rtol=0,
        atol=1e-3,
    )
    torch.testing.assert_close(
        plan.kappa,
        state.kappa[:, None].expand_as(plan.kappa),
        rtol=0,
        atol=1e-5,
    )


def test_fitting_a_decoded_plan_gives_it_back():
    state, generator = random_start()
    x = torch.cat(
        [
            0.3 * torch.randn(COUNT, KNOTS, generator=generator),
            torch.randn(COUNT, 2, generator=generator),
        ],
        1,
    )
    plan = decode(x, state)
    wrapped = torch.remainder(plan.heading + torch.pi, 2 * torch.pi) - torch.pi
    result = fit(
        wrapped,
        torch.ones_like(plan.heading),
        state=state,
        knots=x[:, :KNOTS],
    )
    again = decode(torch.cat([x[:, :KNOTS], result], 1), state)
    gap = torch.hypot(again.x - plan.x, again.y - plan.y)
    assert gap.max() < 0.1
    torch.testing.assert_close(
        result,
        x[:, KNOTS:],
        rtol=0,
        atol=0.15,
    )


def test_heading_is_the_direction_of_motion():
    state, generator = random_start()
    plan = decode(0.5 * torch.randn(COUNT, SIZE, generator=generator), state)
    dx = plan.x.diff(dim=-1)
    dy = plan.y.diff(dim=-1)
    middle = (plan.heading[:, 1:] + plan.heading[:, :-1]) / 2
    moving = torch.hypot(dx, dy) > 0.05
    assert (torch.cos(torch.atan2(dy, dx) - middle)[moving] > 0.9999).all()


def test_a_standing_vehicle_stays_and_gradients_are_finite():
    zero = torch.zeros(4)
    state = start(zero, zero, heading=zero + 0.5)
    x = torch.cat([-torch.ones(4, KNOTS), torch.ones(4, 2)], 1).requires_grad_(True)
    plan = decode(x, state)
    torch.testing.assert_close(plan.x, state.x[:, None].expand(4, HORIZON))
    torch.testing.assert_close(plan.heading, state.heading[:, None].expand(4, HORIZON))
    (gradient,) = torch.autograd.grad(plan.states().sum(), x)
    assert gradient.isfinite().all()


@pytest.mark.parametrize(("speed", "curvature"), [(8.0, 0.1 / 8), (1.0, 0.1 / 3)])
def test_a_unit_is_a_tenth_of_a_radian_a_second(speed, curvature):
    scale = curvature_scale(torch.tensor(speed)).item()
    assert scale == pytest.approx(curvature)


def test_fitted_knots_are_no_larger_than_six_units():
    state = start(torch.full((1,), 8.0), torch.zeros(1), heading=torch.zeros(1))
    spin = 0.05 * torch.arange(1, HORIZON + 1)[None]
    lateral = fit(
        spin,
        torch.ones(1, HORIZON),
        state=state,
        knots=torch.zeros(1, KNOTS),
    )
    assert lateral.abs().max().item() == pytest.approx(6.0)


def test_fitted_knots_are_those_of_the_ridge():
    """Weighted by 0.001, of a turn that the first steps know, in which knots matter
    little."""
    state = start(torch.full((1,), 8.0), torch.zeros(1), heading=torch.zeros(1))
    certain = (torch.arange(HORIZON) < 6).float()[None]
    units = []
    for number in (KNOTS, KNOTS + 1):
        x = torch.zeros(1, SIZE)
        x[0, number] = 1.0
        units.append(decode(x, state).heading[0, :6])
    rows = torch.stack(units, -1).double()
    gram = rows.T @ rows + 1e-3 * torch.eye(2).double()
    expected = torch.linalg.solve(gram, (0.02 * rows).sum(0))
    heading = torch.full((1, HORIZON), 0.02)
    lateral = fit(
        heading,
        certain,
        state=state,
        knots=torch.zeros(1, KNOTS),
    )
    torch.testing.assert_close(
        lateral[0].double(),
        expected,
        rtol=1e-2,
        atol=1e-4,
    )
