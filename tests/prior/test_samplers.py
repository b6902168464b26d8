"""Samplers against Gaussian data: what they draw, their order, and the bias of guidance, without sampling error."""

import dataclasses

import pytest
import torch

from e2rl.prior.sde import SamplerSettings
from e2rl.prior.sde import SAMPLERS, path_kl, reverse_step
from e2rl.run.errors import InputError
from e2rl.traffic.e2.control import gradient_weight
from tests.prior.gaussian import SCHEDULE, denoiser, flow, moments, run

MEAN, STD, WEIGHT = 1.3, 0.4, 5.0  # data N(1.3, 0.4^2) and V = WEIGHT x^2 / 2
TILTED = 0.72222, 0.29814  # of exp(-V) times the data: precision 1 / 0.16 + 5, mean 1.3 / 0.16 / precision
DDPM, DDIM, SDE_2M, ODE_2M, EULER = (
    ("ddim", 1.0),
    ("ddim", 0.0),
    ("dpm_solver_pp", 1.0),
    ("dpm_solver_pp", 0.0),
    ("euler_maruyama", 1.0),
)


def test_the_tilted_gaussian_is_the_reference_s():
    precision = 1 / STD**2 + WEIGHT
    assert (MEAN / STD**2 / precision, precision**-0.5) == pytest.approx(TILTED, abs=1e-5)


@pytest.mark.parametrize("data", [(MEAN, STD), TILTED], ids=["data", "tilt, exactly guided"])
@pytest.mark.parametrize("sampler", [DDPM, DDIM, SDE_2M, ODE_2M, EULER])
def test_many_steps_draw_the_data(sampler, data):
    """Deterministic samplers keep 1% of the mean that the first level's x still holds."""
    mean, std = moments(denoiser(*data), *sampler, 1000)
    assert mean == pytest.approx(data[0], abs=0.018) and std == pytest.approx(data[1], abs=0.003)


@pytest.mark.parametrize(
    ("sampler", "mean", "std"),
    [
        (DDPM, 0.7222, 0.2029),
        (DDIM, 0.7171, 0.2246),
        (SDE_2M, 0.7222, 0.2386),
        (ODE_2M, 0.7167, 0.2454),
        (EULER, 0.7140, 0.3345),
    ],
)
def test_bias_of_the_samplers_at_eight_steps(sampler, mean, std):
    """The score is exactly the tilt's, so what is left is the sampler's: first-order ones lose a quarter to a third of
    the spread, Euler-Maruyama adds an eighth, the second-order ones lose a fifth."""
    assert moments(denoiser(*TILTED), *sampler, 8) == pytest.approx((mean, std), abs=1e-4)


def guided(gradient, scaling):
    """The clean estimate less the weighted gradient of V of it, as SparseControl moves it."""
    plain = denoiser(MEAN, STD)

    def estimate(x, t):
        x = x.detach().requires_grad_(True)
        x0 = plain(x, t)
        through = x0 if gradient == "clean" else x
        (away,) = torch.autograd.grad((WEIGHT * x0**2 / 2).sum(), through)
        return (x0 - gradient_weight(SCHEDULE, t, scaling) * away).detach()

    return estimate


@pytest.mark.parametrize(
    ("gradient", "scaling", "sampler", "mean", "std"),
    [
        ("denoiser", "score", DDPM, 0.5838, 0.2806),
        ("denoiser", "score", SDE_2M, 0.5841, 0.2826),
        ("denoiser", "score", EULER, 0.5838, 0.2831),
        ("denoiser", "score", DDIM, 0.4966, 0.2676),
        ("denoiser", "score", ODE_2M, 0.4964, 0.2683),
        ("denoiser", "sigma", DDPM, 0.0578, 0.0739),
        ("clean", "score", DDPM, 0.0882, 0.2495),
        ("clean", "sigma", DDPM, 0.0084, 0.0693),
    ],
)
def test_bias_of_the_guidance_modes(gradient, scaling, sampler, mean, std):
    """Many steps, so that what is left is the mode's: through the denoiser with the exact weight, V of the estimate
    instead of E[exp -V] goes beyond the tilt (0.58 of 0.72); deterministic samplers add to it; the straight-through
    gradient and the tamed weight all but replace the data by the minimum of V, which is why the control clips them."""
    assert moments(guided(gradient, scaling), *sampler, 1000) == pytest.approx((mean, std), abs=1e-4)


def errors(sampler, counts):
    """Largest distance to the flow, from level 0.9 to 0.1, at each number of steps."""
    x = torch.linspace(-2, 2, 5, dtype=torch.float64)
    out = []
    for count in counts:
        levels = torch.linspace(0.9, 0.1, count + 1, dtype=torch.float64)
        end = run(denoiser(MEAN, STD), *sampler, levels, torch.cat([x[None], torch.zeros(count - 1, 5)]))
        out.append((end - flow(x, MEAN, STD, levels[0], levels[-1])).abs().max().item())
    return torch.tensor(out)


def test_halving_the_step_quarters_the_error_of_2m_and_halves_that_of_ddim():
    counts = (64, 128, 256)
    second, first = errors(ODE_2M, counts), errors(DDIM, counts)
    torch.testing.assert_close(second[:-1] / second[1:], torch.full((2,), 4.0), rtol=0.06, atol=0)
    torch.testing.assert_close(first[:-1] / first[1:], torch.full((2,), 2.0), rtol=0.06, atol=0)
    assert second[0] < first[0] / 30


def test_the_first_step_and_a_constant_estimate_are_ddim_s():
    high, low, x, noise = (torch.tensor(v) for v in (0.6, 0.4, 1.7, -0.3))
    x0, before = torch.tensor(0.2), torch.tensor(0.8)
    expected = reverse_step("ddim", SCHEDULE, x, x0, high, low, noise, 1.0, None)
    for past in (None, (x0, before)):
        found = reverse_step("dpm_solver_pp", SCHEDULE, x, x0, high, low, noise, 1.0, past)
        torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_control_shifts_the_mean_only_so_that_path_energy_is_that_of_two_gaussians(sampler):
    high, low, x = (torch.tensor(v, dtype=torch.float64) for v in (0.6, 0.4, 1.7))
    before = torch.tensor(0.8, dtype=torch.float64)
    steps = [
        [
            reverse_step(
                sampler,
                SCHEDULE,
                x,
                torch.tensor(x0),
                high,
                low,
                torch.tensor(noise),
                1.0,
                (torch.tensor(past), before),
            )
            for noise in (-1.0, 0.5)
        ]
        for x0, past in ((0.2, 0.1), (0.5, 0.3))
    ]
    shifts = [controlled[0] - nominal[0] for nominal, controlled in zip(*steps, strict=True)]
    torch.testing.assert_close(shifts[0], shifts[1])
    scale = (steps[0][1][0] - steps[0][0][0]) / 1.5
    torch.testing.assert_close(steps[0][0][1], scale**2, msg="the variance that is reported is that of the noise")
    normal = torch.distributions.Normal
    exact = torch.distributions.kl_divergence(normal(steps[1][0][0], scale), normal(steps[0][0][0], scale))
    torch.testing.assert_close(path_kl(shifts[0][None], steps[0][0][1]), exact)


@pytest.mark.parametrize("sampler", ["ddim", "dpm_solver_pp"])
def test_deterministic_steps_carry_no_density(sampler):
    args = (torch.tensor(v) for v in (1.7, 0.2, 0.6, 0.4, -0.3))
    _, variance = reverse_step(sampler, SCHEDULE, *args, 0.0, (torch.tensor(0.3), torch.tensor(0.8)))
    assert variance == 0 and path_kl(torch.ones(3), variance) == 0


@pytest.mark.parametrize("wrong", [{"sampler": "heun"}, {"steps": 0}, {"churn": 2.0}])
def test_settings_are_checked(wrong):
    with pytest.raises(InputError, match=next(iter(wrong))):
        dataclasses.replace(SamplerSettings(), **wrong)
