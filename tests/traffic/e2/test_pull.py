"""The pull is the exact posterior, and its price is booked."""

import math

import pytest
import torch

import e2rl
from e2rl.prior.lane_relative import ACCEL_SCALE, KNOTS, SIZE
from e2rl.prior.sde import NoiseSchedule
from e2rl.sim.world import World
from e2rl.traffic.e2 import pull
from e2rl.traffic.e2.control import SparseControl
from e2rl.traffic.e2.kernels import displacements
from e2rl.traffic.e2.pull import Pull, covariance, nats, principal_axes, pulled
from e2rl.traffic.motion import smallest
from tests.prior.test_prior import MEAN, STD, gaussian_prior
from tests.traffic.e2.traffic_scenes import EGO, begin

CPU = torch.device("cpu")


def test_the_covariance_is_one_and_the_price_is_its_quadratic_form():
    c = covariance(CPU)
    torch.testing.assert_close(c, c.T)
    assert (torch.linalg.eigvalsh(c) > 0).all()
    table = displacements(CPU)
    torch.testing.assert_close(
        nats(table),
        0.5 * (table * torch.linalg.solve(c, table.T).T).sum(-1),
        rtol=1e-4,
        atol=1e-4,
    )
    assert float(nats(table)[0]) == 0
    assert (nats(table)[1:] > 0).all()
    assert len(table.unique(dim=0)) == len(table), "no kernel stands twice in the table"


@pytest.mark.parametrize("level", [0.1, 0.5, 0.95])
@pytest.mark.parametrize("strength", [0.0, 0.3, 4.0])
def test_the_pull_is_the_posterior_mean_of_a_gaussian_prior(level, strength):
    """x0 ~ N(m, C), x = alpha x0 + sigma e, and a potential strength (x0 - goal)^T C^-1
    (x0 - goal) / 2."""
    schedule = NoiseSchedule()
    t = torch.tensor(level, dtype=torch.float64)
    alpha = schedule.alpha(t)
    sigma = schedule.sigma(t)
    generator = torch.Generator().manual_seed(0)
    m, goal, x = torch.randn(3, SIZE, generator=generator, dtype=torch.float64)
    precision = torch.linalg.inv(covariance(CPU).double())
    noise = alpha**2 / sigma**2 * torch.eye(SIZE, dtype=torch.float64)
    clean = torch.linalg.solve(precision + noise, precision @ m + alpha / sigma**2 * x)
    tilted = torch.linalg.solve(
        (1 + strength) * precision + noise,
        precision @ (m + strength * goal) + alpha / sigma**2 * x,
    )
    result = pulled(
        clean.float(),
        goal.float(),
        strength=torch.tensor(strength),
        level=t.float(),
        schedule=schedule,
    )
    torch.testing.assert_close(result.double(), tilted, rtol=1e-3, atol=1e-3)


def test_what_a_pull_costs_goes_to_the_divergence_of_the_tilted_gaussian(monkeypatch):
    """Prior N(m, s^2 I): the tilt towards a goal m + d is N(m + w d, (1 - w) s^2 I), w
    = strength / (1 + strength)."""
    monkeypatch.setattr(pull, "SPREAD", (STD,) * SIZE)
    monkeypatch.setattr(pull, "CORRELATION", 0.0)
    caches = covariance, principal_axes
    prior = gaussian_prior(steps=200)
    w = 0.5
    d = 1.5
    noise = torch.randn(200, 400, 1, SIZE, generator=torch.Generator().manual_seed(1))

    def control(step):
        x0 = step.clean(step.x)
        return (
            step.x,
            x0,
            pulled(
                x0,
                torch.full((SIZE,), MEAN + d),
                strength=torch.tensor(w / (1 - w)),
                level=step.level,
                schedule=prior.schedule,
            ),
        )

    try:
        for cached in caches:
            cached.cache_clear()
        sample = prior.sample(None, noise, control)
    finally:
        for cached in caches:
            cached.cache_clear()
    certain = SIZE / 2 * ((1 - w) + (w * d / STD) ** 2 - 1 - math.log(1 - w))
    assert sample.kl.mean().item() == pytest.approx(certain, rel=0.06)
    assert sample.x0.mean().item() == pytest.approx(MEAN + w * d, abs=0.03)
    assert sample.x0.var().item() == pytest.approx((1 - w) * STD**2, rel=0.1)


@pytest.mark.slow
def test_importance_weights_of_pulled_paths_average_1():
    """24 scenes, the shipped prior: in each the nearest vehicle that moves is pulled 1
    m/s^2 below its mean."""
    scene = e2rl.load_scenes("bundled", num_scenes=24).scenes
    on = e2rl.make_traffic("e2", e2rl.load_prior())
    state = begin(on, scene, eta=1.0)
    world = World.at_start(scene)
    context = on.encode(state, world, EGO.plan(world))
    mean = on.prior.estimate(context)
    gap = (world.states[:, : mean.shape[1], :2] - world.states[:, :1, :2]).norm(dim=-1)
    moves = context.active & (state.lane.v > 1.0)
    near = smallest(moves, gap, count=1)
    shift = torch.nn.functional.pad(
        torch.full((KNOTS,), -1.0 / ACCEL_SCALE), (0, SIZE - KNOTS)
    )
    pull_down = Pull(mean + shift, near, strength=torch.full((24,), 0.2))
    generator = torch.Generator().manual_seed(0)
    control = SparseControl(state.attacked, [pull_down])
    weights = []
    nats = []
    for _ in range(100):
        noise = torch.randn(on.prior.sampler.steps, *mean.shape, generator=generator)
        sample = on.prior.sample(context, noise, control)
        weights.append((-sample.log_ratio.sum(-1)).exp())
        nats.append(sample.kl.sum(-1))
    assert float(torch.stack(nats).mean()) > 0.2, "the pull does something"
    assert float(torch.stack(weights).mean()) == pytest.approx(1.0, abs=0.05)
