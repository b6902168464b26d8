"""The VP-SDE: its identities; samplers against Gaussian data in closed form, their
order, and the bias of guidance."""

from functools import partial

import pytest
import torch

from e2rl.prior.sde import DDIM, SAMPLERS, path_kl
from e2rl.traffic.e2.paper import gradient_weight
from tests.prior.gaussian import SCHEDULE, denoiser, flow, moments, run

MEAN, STD, WEIGHT = 1.3, 0.4, 5.0  # data N(1.3, 0.4^2) and V = WEIGHT x^2 / 2
TILTED = (
    0.72222,
    0.29814,
)  # of exp(-V) times the data: precision 1 / 0.16 + 5, mean 1.3 / 0.16 / precision
DDPM = ("ddim", 1.0)
DDIM_0 = ("ddim", 0.0)
SDE_2M = ("dpm_solver_pp", 1.0)
ODE_2M = ("dpm_solver_pp", 0.0)
EULER = ("euler_maruyama", 1.0)


def beta(t):
    return torch.pi * torch.tan(torch.pi * t / 2)


def test_variance_is_preserved_and_beta_is_the_schedule_s():
    t = torch.linspace(
        0.01,
        0.98,
        50,
        dtype=torch.float64,
        requires_grad=True,
    )
    torch.testing.assert_close(
        SCHEDULE.alpha(t) ** 2 + SCHEDULE.sigma(t) ** 2, torch.ones_like(t)
    )
    (slope,) = torch.autograd.grad(SCHEDULE.alpha(t).sum(), t)
    torch.testing.assert_close(
        -beta(t) / 2, slope / SCHEDULE.alpha(t), msg="d log alpha / dt"
    )


def test_the_integral_of_beta_is_exact():
    low = torch.tensor(0.2, dtype=torch.float64)
    high = torch.tensor(0.9, dtype=torch.float64)
    grid = torch.linspace(0.2, 0.9, 20_001, dtype=torch.float64)
    torch.testing.assert_close(
        SCHEDULE.beta_integral(high, low),
        torch.trapezoid(beta(grid), grid),
        rtol=1e-6,
        atol=0,
    )


def test_the_score_of_the_denoised_estimate_is_the_gradient_of_the_log_density():
    t = torch.tensor(0.4, dtype=torch.float64)
    x = torch.linspace(
        -2,
        2,
        9,
        dtype=torch.float64,
        requires_grad=True,
    )
    alpha = SCHEDULE.alpha(t)
    sigma = SCHEDULE.sigma(t)
    density = -0.5 * (x - alpha * MEAN) ** 2 / (alpha**2 * STD**2 + sigma**2)
    (expected,) = torch.autograd.grad(density.sum(), x)
    torch.testing.assert_close(
        SCHEDULE.score(x, denoiser(MEAN, STD)(x, t), t), expected
    )


def test_noise_and_clean_estimate_are_two_views_of_the_same_x():
    t = torch.tensor(0.3)
    x0 = torch.randn(5)
    noise = torch.randn(5)
    torch.testing.assert_close(
        SCHEDULE.noise(SCHEDULE.noised(x0, t, noise), x0, t), noise
    )


def test_an_ancestral_step_is_the_posterior_given_both_ends():
    """q(x_low | x_high, x_0) of the forward SDE, by conditioning a joint Gaussian."""
    high = torch.tensor(0.6, dtype=torch.float64)
    low = torch.tensor(0.3, dtype=torch.float64)
    x0 = 0.4
    ratio = SCHEDULE.alpha(high) / SCHEDULE.alpha(low)
    var_low = SCHEDULE.sigma(low) ** 2
    var_high = SCHEDULE.sigma(high) ** 2
    x = torch.tensor(-1.1, dtype=torch.float64)
    mean = SCHEDULE.alpha(low) * x0 + ratio * var_low / var_high * (
        x - SCHEDULE.alpha(high) * x0
    )
    variance = var_low - (ratio * var_low) ** 2 / var_high
    after, noise = DDIM(SCHEDULE).step(x, x0, high, low, torch.zeros_like(x))
    torch.testing.assert_close(after, mean)
    torch.testing.assert_close(noise, variance)


@pytest.mark.parametrize(
    "data", [(MEAN, STD), TILTED], ids=["data", "tilt, exactly guided"]
)
@pytest.mark.parametrize("sampler", [DDPM, DDIM_0, SDE_2M, ODE_2M, EULER])
def test_many_steps_draw_the_data(sampler, data):
    """Deterministic samplers keep 1% of the mean that the first level's x still holds."""
    mean, std = moments(denoiser(data[0], data[1]), sampler, 1000)
    assert mean == pytest.approx(data[0], abs=0.018)
    assert std == pytest.approx(data[1], abs=0.003)


@pytest.mark.parametrize(
    ("sampler", "mean", "std"),
    [
        (DDPM, 0.7222, 0.2029),
        (DDIM_0, 0.7171, 0.2246),
        (SDE_2M, 0.7222, 0.2386),
        (ODE_2M, 0.7167, 0.2454),
        (EULER, 0.7140, 0.3345),
    ],
)
def test_bias_of_the_samplers_at_eight_steps(sampler, mean, std):
    """The score is exactly the tilt's, so what is left is the sampler's: first-order
    ones lose a quarter to a third of the spread, Euler-Maruyama adds an eighth, the
    second-order ones lose a fifth."""
    assert moments(denoiser(TILTED[0], TILTED[1]), sampler, 8) == pytest.approx(
        (mean, std), abs=1e-4
    )


def test_levels_are_even_in_what_they_are_spaced_by():
    even = SCHEDULE.levels(8).double()
    ratio = SCHEDULE.levels(8, spacing="log_ratio").double()
    torch.testing.assert_close(
        even.diff(), torch.full((8,), -SCHEDULE.start / 8, dtype=torch.float64)
    )
    steps = SCHEDULE.log_ratio(ratio[:-1]).diff()
    torch.testing.assert_close(
        steps,
        steps[:1].expand(7),
        rtol=1e-3,
        atol=0,
    )
    assert ratio[0].item() == pytest.approx(SCHEDULE.start)
    assert ratio[-1] == 0 < ratio[-2] < even[-2]


def test_levels_begin_at_nearly_pure_noise_and_end_at_little():
    """0.98, and 0.24 divided by the number of steps before the last."""
    levels = SCHEDULE.levels(8, spacing="log_ratio")
    assert levels[0].item() == pytest.approx(0.98)
    assert levels[-2].item() == pytest.approx(0.24 / 8)


@pytest.mark.parametrize("std", [0.35, 0.5, 0.7, 1.0, 1.5])
def test_eight_steps_even_in_the_log_ratio_keep_the_spread(std):
    """Within 5% of the data's, over all spreads that knots have; ancestral steps, even
    in t, lose a fifth and more."""
    assert moments(denoiser(0.3, std), SDE_2M, 8, "log_ratio")[1] == pytest.approx(
        std, rel=0.05
    )
    assert moments(denoiser(0.3, std), DDPM, 8)[1] < 0.81 * std


def test_eight_steps_draw_a_mixture():
    """Two modes of unequal weight: their shares, and the spread of both together."""
    means = torch.tensor([-1.0, 1.0])
    weights = torch.tensor([0.3, 0.7])
    std = 0.35

    def estimate(x, t):
        alpha = SCHEDULE.alpha(t)
        sigma = SCHEDULE.sigma(t)
        parts = torch.distributions.Normal(
            alpha * means, (alpha**2 * std**2 + sigma**2).sqrt()
        )
        share = (parts.log_prob(x[:, None]) + weights.log()).softmax(-1)
        clean = torch.stack([denoiser(mean, std)(x, t) for mean in means], -1)
        return (share * clean).sum(-1)

    noise = torch.randn(8, 20_000, generator=torch.Generator().manual_seed(0))
    x = run(estimate, SDE_2M, SCHEDULE.levels(8, spacing="log_ratio"), noise)
    assert (x > 0).float().mean().item() == pytest.approx(0.7, abs=0.03)
    expected = (weights * (means**2 + std**2)).sum() - (weights * means).sum() ** 2
    assert x.std().item() == pytest.approx(expected.sqrt().item(), rel=0.07)


def guided(gradient, scaling):
    """The clean estimate less the weighted gradient of V of it, as SparseControl moves
    it."""
    plain = denoiser(MEAN, STD)

    def estimate(x, t):
        x = x.detach().requires_grad_(True)
        x0 = plain(x, t)
        through = x0 if gradient == "clean" else x
        (away,) = torch.autograd.grad((WEIGHT * x0**2 / 2).sum(), through)
        return (x0 - gradient_weight(SCHEDULE, t, scaling=scaling) * away).detach()

    return estimate


@pytest.mark.parametrize(
    ("gradient", "scaling", "sampler", "mean", "std"),
    [
        ("denoiser", "score", DDPM, 0.5838, 0.2806),
        ("denoiser", "score", SDE_2M, 0.5841, 0.2826),
        ("denoiser", "score", EULER, 0.5838, 0.2831),
        ("denoiser", "score", DDIM_0, 0.4966, 0.2676),
        ("denoiser", "score", ODE_2M, 0.4964, 0.2683),
        ("denoiser", "sigma", DDPM, 0.0578, 0.0739),
        ("clean", "score", DDPM, 0.0882, 0.2495),
        ("clean", "sigma", DDPM, 0.0084, 0.0693),
    ],
)
def test_bias_of_the_guidance_modes(
    gradient,
    scaling,
    sampler,
    mean,
    std,
):
    """Many steps, so that what is left is the mode's: through the denoiser with the
    exact weight, V of the estimate instead of E[exp -V] goes beyond the tilt (0.58 of
    0.72); deterministic samplers add to it; the straight-through gradient and the tamed
    weight all but replace the data by the minimum of V, which is why the control clips
    them."""
    assert moments(guided(gradient, scaling), sampler, 1000) == pytest.approx(
        (mean, std), abs=1e-4
    )


def errors(sampler, counts):
    """Largest distance to the flow, from level 0.9 to 0.1, at each number of steps."""
    x = torch.linspace(-2, 2, 5, dtype=torch.float64)
    out = []
    for count in counts:
        levels = torch.linspace(0.9, 0.1, count + 1, dtype=torch.float64)
        end = run(
            denoiser(MEAN, STD),
            sampler,
            levels,
            torch.cat([x[None], torch.zeros(count - 1, 5)]),
        )
        out.append(
            (
                end
                - flow(
                    x,
                    MEAN,
                    std=STD,
                    high=levels[0],
                    low=levels[-1],
                )
            )
            .abs()
            .max()
            .item()
        )
    return torch.tensor(out)


def test_halving_the_step_quarters_the_error_of_2m_and_halves_that_of_ddim():
    counts = (64, 128, 256)
    second = errors(ODE_2M, counts)
    first = errors(DDIM_0, counts)
    torch.testing.assert_close(
        second[:-1] / second[1:],
        torch.full((2,), 4.0),
        rtol=0.06,
        atol=0,
    )
    torch.testing.assert_close(
        first[:-1] / first[1:],
        torch.full((2,), 2.0),
        rtol=0.06,
        atol=0,
    )
    assert second[0] < first[0] / 30


def test_the_first_step_and_a_constant_estimate_are_ddim_s():
    high, low, x, noise = (torch.tensor(v) for v in (0.6, 0.4, 1.7, -0.3))
    x0 = torch.tensor(0.2)
    before = torch.tensor(0.8)
    expected = SAMPLERS["ddim"](SCHEDULE).step(x, x0, high, low, noise)
    for past in (None, (x0, before)):
        result = SAMPLERS["dpm_solver_pp"](SCHEDULE).step(x, x0, high, low, noise, past)
        torch.testing.assert_close(result, expected)


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_control_shifts_the_mean_only_so_that_path_energy_is_that_of_two_gaussians(
    sampler,
):
    high, low, x = (torch.tensor(v, dtype=torch.float64) for v in (0.6, 0.4, 1.7))
    before = torch.tensor(0.8, dtype=torch.float64)
    step = partial(
        SAMPLERS[sampler](SCHEDULE).step,
        x,
        high=high,
        low=low,
    )
    tensor = partial(torch.tensor, dtype=torch.float64)
    steps = [
        [
            step(
                x0=tensor(x0),
                noise=tensor(noise),
                past=(tensor(past), before),
            )
            for noise in (-1.0, 0.5)
        ]
        for x0, past in ((0.2, 0.1), (0.5, 0.3))
    ]
    shifts = [
        controlled[0] - nominal[0] for nominal, controlled in zip(*steps, strict=True)
    ]
    torch.testing.assert_close(shifts[0], shifts[1])
    scale = (steps[0][1][0] - steps[0][0][0]) / 1.5
    torch.testing.assert_close(
        steps[0][0][1],
        scale**2,
        msg="the variance that is reported is that of the noise",
    )
    normal = torch.distributions.Normal
    exact = torch.distributions.kl_divergence(
        normal(steps[1][0][0], scale), normal(steps[0][0][0], scale)
    )
    torch.testing.assert_close(path_kl(shifts[0][None], steps[0][0][1]), exact)


@pytest.mark.parametrize("sampler", ["ddim", "dpm_solver_pp"])
def test_deterministic_steps_carry_no_density(sampler):
    args = (torch.tensor(v) for v in (1.7, 0.2, 0.6, 0.4, -0.3))
    _, variance = SAMPLERS[sampler](SCHEDULE, churn=0.0).step(
        *args, past=(torch.tensor(0.3), torch.tensor(0.8))
    )
    assert variance == 0
    assert path_kl(torch.ones(3), variance) == 0
