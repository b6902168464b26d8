"""Stratified samples: one in each stratum of a vehicle, and any one of them as random
as an independent one."""

import pytest
import torch

from e2rl.prior.lane_relative import KNOTS, SIZE
from e2rl.prior.sde import NoiseSchedule, SamplerSettings
from e2rl.prior.stratified_sampling import (
    impulse_response,
    main_direction,
    stratified_noise,
    stratified_uniform,
)

SCHEDULE = NoiseSchedule()
COUNT = 4
SCENES = 30_000


def draws(*shape: int, normal: bool = False) -> torch.Tensor:
    generator = torch.Generator().manual_seed(sum(shape))
    return (torch.randn if normal else torch.rand)(shape, generator=generator)


def test_every_stratum_holds_one_sample_and_each_sample_is_uniform():
    uniform = stratified_uniform(draws(COUNT, SCENES), draws(SCENES))
    assert (
        ((uniform * COUNT).floor().sort(0).values) == torch.arange(COUNT)[:, None]
    ).all()
    quantiles = torch.linspace(0.05, 0.95, 10)
    for sample in uniform:
        torch.testing.assert_close(
            sample.quantile(quantiles), quantiles, rtol=0, atol=0.015
        )


def test_any_one_sample_is_standard_normal_and_vehicles_are_independent():
    settings = SamplerSettings(steps=3)
    direction = main_direction(SCHEDULE, settings)
    noise = stratified_noise(
        draws(COUNT, 3, SCENES, 2, SIZE, normal=True),
        direction,
        order=draws(COUNT, SCENES, 2),
        position=draws(SCENES, 2),
    )
    for sample in noise[:2]:
        rows = sample.permute(1, 2, 0, 3).flatten(
            1
        )  # [SCENES, vehicles x steps x SIZE]
        assert rows.mean(0).abs().max() < 0.03
        torch.testing.assert_close(
            torch.cov(rows.T), torch.eye(rows.shape[1]), rtol=0, atol=0.05
        )
        along = torch.einsum("kbvx,kx->bv", sample, direction)
        assert along.pow(4).mean().item() == pytest.approx(3.0, abs=0.15), (
            "of a normal, not of a mixture"
        )


def test_samples_differ_along_the_direction_and_keep_the_rest():
    direction = main_direction(SCHEDULE, SamplerSettings(steps=3))
    before = draws(COUNT, 3, 50, 2, SIZE, normal=True)
    after = stratified_noise(
        before, direction, order=draws(COUNT, 50, 2), position=draws(50, 2)
    )
    along = torch.einsum("skbvx,kx->sbv", after, direction).sort(0).values
    edges = torch.special.ndtri(torch.arange(1, COUNT) / COUNT)[:, None, None]
    assert (along[:-1] <= edges + 1e-4).all() and (along[1:] >= edges - 1e-4).all()
    change = (after - before).permute(0, 2, 3, 1, 4).flatten(3)
    flat = direction.flatten()
    torch.testing.assert_close(
        change, (change @ flat)[..., None] * flat, rtol=0, atol=1e-5
    )


@pytest.mark.parametrize(
    "options", [{}, {"sampler": "dpm_solver_pp"}, {"sampler": "euler_maruyama"}]
)
def test_impulses_are_those_of_the_reverse_process(options):
    many = impulse_response(SCHEDULE, SamplerSettings(steps=300, **options))
    assert many.square().sum().item() == pytest.approx(1.0, abs=0.05), (
        "the variance of x0 comes out"
    )
    alone = impulse_response(SCHEDULE, SamplerSettings(steps=16, churn=0.0))
    assert alone[1:].abs().max() == 0 and alone[0] > 0.8


def test_the_main_direction_is_early_acceleration():
    direction = main_direction(SCHEDULE, SamplerSettings())
    assert direction.norm().item() == pytest.approx(1.0, abs=1e-5)
    knots = direction.sum(0)
    assert (knots[:KNOTS].diff() < 0).all() and (knots[KNOTS:] == 0).all()
