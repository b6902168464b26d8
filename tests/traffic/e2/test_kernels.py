"""Importance kernels: their pull is the exact posterior, their price is booked, and
nothing is drawn for nothing."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import e2rl
from e2rl.prior.lane_relative import ACCEL_SCALE, KNOTS, SIZE
from e2rl.prior.sde import NoiseSchedule
from e2rl.sim.world import World
from e2rl.traffic.e2 import kernels
from e2rl.traffic.e2.control import Pull
from e2rl.traffic.e2.kernels import (
    DRAWN,
    KernelAttack,
    Kernels,
    best_try,
    choice_nats,
    covariance,
    nats,
    propose_kernels,
    pulled,
    shifts,
    tries,
)
from e2rl.traffic.motion import smallest
from tests.prior.test_prior import MEAN, STD, gaussian_prior
from tests.traffic.e2.traffic_scenes import EGO, begin, replanned, scenes, synthesizer

CPU = torch.device("cpu")
TUNE = Path(__file__).parents[4] / "shared" / "data" / "waymo" / "tune.zip"


def test_the_covariance_is_one_and_the_price_is_its_quadratic_form():
    c = covariance(CPU)
    torch.testing.assert_close(c, c.T)
    assert (torch.linalg.eigvalsh(c) > 0).all()
    table = shifts(CPU)
    torch.testing.assert_close(
        nats(table),
        0.5 * (table * torch.linalg.solve(c, table.T).T).sum(-1),
        rtol=1e-4,
        atol=1e-4,
    )
    assert float(nats(table)[0]) == 0 and (nats(table)[1:] > 0).all()
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
    found = pulled(
        clean.float(),
        goal.float(),
        strength=torch.tensor(strength),
        level=t.float(),
        schedule=schedule,
    )
    torch.testing.assert_close(found.double(), tilted, rtol=1e-3, atol=1e-3)


def test_what_a_pull_costs_goes_to_the_divergence_of_the_tilted_gaussian(monkeypatch):
    """Prior N(m, s^2 I): the tilt towards a goal m + d is N(m + w d, (1 - w) s^2 I), w
    = strength / (1 + strength)."""
    monkeypatch.setattr(kernels, "SPREAD", (STD,) * SIZE)
    monkeypatch.setattr(kernels, "CORRELATION", 0.0)
    caches = covariance, kernels._axes
    prior = gaussian_prior(steps=200)
    w = 0.5
    d = 1.5
    noise = torch.randn(200, 400, 1, SIZE, generator=torch.Generator().manual_seed(1))

    def control(x, level, k, context, denoise):
        x0 = denoise(x)
        return (
            x,
            x0,
            pulled(
                x0,
                torch.full((SIZE,), MEAN + d),
                strength=torch.tensor(w / (1 - w)),
                level=level,
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
    known = SIZE / 2 * ((1 - w) + (w * d / STD) ** 2 - 1 - math.log(1 - w))
    assert sample.kl.mean().item() == pytest.approx(known, rel=0.06)
    assert sample.x0.mean().item() == pytest.approx(MEAN + w * d, abs=0.03)
    assert sample.x0.var().item() == pytest.approx((1 - w) * STD**2, rel=0.1)


@pytest.mark.parametrize("recorded", [False, True])
@pytest.mark.slow
def test_importance_weights_of_pulled_paths_average_1(recorded):
    """24 scenes, the shipped prior: in each the nearest vehicle that moves is pulled 1
    m/s^2 below its mean."""
    if recorded and not TUNE.exists():
        pytest.skip(
            "needs waymo/tune.zip in ../shared/data, which is not in the repository"
        )
    options = (
        {"data": "scenarionet", "path": str(TUNE)} if recorded else {"data": "bundled"}
    )
    scene = e2rl.load_scenes(**options, num_scenes=24).scenes
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
    pull = Pull(mean + shift, near, strength=torch.full((24,), 0.2))
    generator = torch.Generator().manual_seed(0)
    nobody = on._anchor(state, world, EGO.plan(world))
    control = on._control(
        state,
        world,
        EGO.plan(world),
        replace(nobody, feasible=nobody.feasible & False),
        pull,
    )
    weights = []
    nats = []
    for _ in range(100):
        noise = torch.randn(on.prior.sampler.steps, *mean.shape, generator=generator)
        sample = on.prior.sample(context, noise, control)
        weights.append((-sample.log_ratio.sum(-1)).exp())
        nats.append(sample.kl.sum(-1))
    assert float(torch.stack(nats).mean()) > 0.2, "the pull does something"
    assert float(torch.stack(weights).mean()) == pytest.approx(1.0, abs=0.05)


def proposed(gain, count=5):
    on = synthesizer()
    scene = scenes(3).scenes
    state = begin(on, scene, eta=2.0)
    world = World.at_start(scene)
    context = on.encode(state, world, EGO.plan(world))
    mean = on.prior.estimate(context)
    plan = on.prior.decode(mean, context).states()
    attack = KernelAttack.of(
        world,
        context.active,
        ego_plan=EGO.plan(world),
        plan=plan,
        since=state.since,
        settled=state.settled,
    )
    gains = torch.full((3,), gain)
    return (
        mean,
        world,
        propose_kernels(
            attack,
            state.lane,
            points=state.routed.points,
            mean=mean,
            gain=gains,
            count=count,
        ),
    )


def test_kernels_are_shifts_of_moving_vehicles_that_gain_more_than_they_cost():
    mean, world, found = proposed(300.0)
    assert (
        found.goal.shape == (3, 5, SIZE)
        and (found.vehicle >= 0).any()
        and (found.vehicle != 0).all()
    )
    parked = world.scene["parked"]
    for b, n in (found.vehicle >= 0).nonzero().tolist():
        vehicle = int(found.vehicle[b, n])
        shift = found.goal[b, n] - mean[b, vehicle]
        assert not parked[b, vehicle] and world.valid[b, vehicle]
        assert (shifts(CPU) - shift).abs().amax(-1).min() < 1e-5
        assert float(nats(shift)) < 300.0
    assert (proposed(0.0)[2].vehicle == -1).all(), (
        "without a gain none is worth its nats"
    )


def test_a_drawn_vehicle_is_an_adversary_that_pays_for_its_shift_and_the_choice():
    on = synthesizer(kernels={"samples": 4}, interception={"reach": 0})
    scene = scenes(4).scenes
    state, plan = replanned(on, scene, eta=3.0)
    assert state.drawn.any()
    assert (plan.adversary == (state.coalition | state.drawn)).all() and (
        plan.target[state.drawn] == 0
    ).all()
    assert (plan.path_kl[state.drawn] > 0).all()
    assert (plan.path_kl[state.drawn.any(1), 0] >= math.log(3 / DRAWN)).all()
    _, one = replanned(
        synthesizer(kernels={"samples": 1}, interception={"reach": 0}), scene, eta=3.0
    )
    assert not torch.equal(one.states, plan.states)


def test_the_prices_of_a_choice_are_those_of_a_law_over_the_samples():
    """A code is one: the weights exp(-price) of a scene's samples sum to 1, and no
    choice has no price."""
    price = choice_nats(torch.tensor([1]), 2, count=5)
    assert price.shape == (7,) and price[0] == 0
    assert float((-price[1:]).exp().sum()) == pytest.approx(1.0)


def test_a_budget_below_the_price_of_a_choice_draws_nobody_and_none_is_the_prior():
    scene = scenes(3).scenes
    for budget, drawn in ((1.0, False), (None, True)):
        on = synthesizer(
            control={"transport_budget": budget}, interception={"reach": 0}
        )
        assert bool(replanned(on, scene, eta=3.0)[0].drawn.any()) == drawn
    _, prior = replanned(synthesizer(), scene, eta=0.0)
    _, none = replanned(synthesizer(control={"transport_budget": 0.0}), scene, eta=3.0)
    assert torch.equal(none.states, prior.states) and not none.adversary.any()


def test_the_best_of_a_scene_s_tries_is_taken_and_the_plain_one_where_there_are_no_others():
    vehicle = torch.tensor([[-1, -1], [2, 1], [-1, -1], [3, -1]])
    found = Kernels(
        torch.arange(8.0).view(4, 2, 1).expand(4, 2, SIZE), vehicle, vehicles=5
    )
    rows = torch.tensor([1, 3])
    scenes, goal, drawn = tries(found, rows)
    assert scenes.tolist() == [0, 1, 2, 3, 1, 1, 3, 3]
    assert drawn.nonzero().tolist() == [[4, 2], [5, 1], [6, 3]]
    assert goal[4:, 0, 0].tolist() == [2.0, 3.0, 6.0, 7.0]
    value = torch.tensor([9.0, 1.0, 0.0, 5.0, 2.0, 3.0, 4.0, 5.0])
    assert best_try(value, rows, batch=4).tolist() == [0, 5, 2, 3]
    assert best_try(value[:4], rows[:0], batch=4).tolist() == [0, 1, 2, 3]
