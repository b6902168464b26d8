"""The guidance that the paper prints: eq. 14 blends once, eq. 16 is masked."""

import pytest
import torch

from e2rl.prior.lane_relative import ACCEL_SCALE, KNOTS
from e2rl.prior.sde import NoiseSchedule
from e2rl.run.errors import InputError
from e2rl.traffic.e2 import paper
from e2rl.traffic.e2.control import SparseControl
from e2rl.traffic.e2.paper import (
    GuidanceSettings,
    LiteralAnchor,
    MaskedGuidance,
    clip_rows,
    gradient_weight,
)
from e2rl.traffic.potentials import (
    SAMPLED_STEPS,
    PotentialSettings,
    adversarial_potential,
    feasibility_potential,
)
from tests.traffic.e2.replan_case import ACCEL, MEMBER, OTHERS, Case
from tests.traffic.e2.traffic_scenes import replanned, scenes, synthesizer

OFF = {"adversarial_clip": 0.0, "feasibility": 0.0}


def guidance(case, eta=1.0, weight=0.0, **settings):
    """Eqs. 14 and 16 for a Case; weight: alpha of eq. 14."""
    eta = case.eta(eta)
    anchor = LiteralAnchor(
        knots=case.knots,
        vehicles=case.coalition & (eta > 0)[:, None],
        weight=weight,
        noise=case.noise(seed=7),
    )
    return MaskedGuidance(
        prior=case.prior,
        settings=GuidanceSettings(**settings),
        potentials=PotentialSettings(),
        conditions=case.conditions,
        coalition=case.coalition,
        eta=eta,
        anchor=anchor if weight > 0 else None,
    )


def shifts(case, level=0.5, k=2, eta=1.0, **options):
    """x after less before eq. 14, and x0 after less before eq. 16."""
    level = torch.tensor(level)
    x = case.noise()
    control = SparseControl(case.eta(eta) > 0, [], guidance(case, eta, **options))
    blended, before, after = control(case.denoising(x, level, k))
    return blended - x, after - before


def crowded():
    """Vehicle 2 laps over vehicle 1's lane, so that V_feas moves both."""
    case = Case()
    case.scene["start"][:, 2, 1] = 2.2
    case.context.state.d[:, 2] = -1.3
    return case


@pytest.mark.parametrize("least", [0.5, 1.0])
def test_feasibility_acts_once_the_clean_estimate_has_taken_shape(least, monkeypatch):
    monkeypatch.setattr(paper, "FEASIBILITY_LEVEL", least)
    case = crowded()
    steps = case.prior.sampler.steps
    levels = case.prior.schedule.levels(steps)
    for k in range(1, steps + 1):
        level = float(levels[steps - k])
        _, shift = shifts(case, level=level, k=k, adversarial_clip=0.0)
        assert bool((shift != 0).any()) == (level <= least and k > 1)


def clipped(rows, limit):
    if limit is None:
        return rows
    norm = rows.norm(dim=-1, keepdim=True)
    return torch.where(norm > limit, rows * limit / norm, rows)


@pytest.mark.parametrize("gradient", ["denoiser", "clean"])
@pytest.mark.parametrize(
    ("scaling", "clips"), [("sigma", (0.02, 0.03)), ("score", (None, None))]
)
def test_eq_16_shifts_by_the_scaled_clipped_and_masked_gradients(
    gradient, scaling, clips
):
    """x0 - eta M clip(w grad V_adv) - clip(lambda w grad V_feas), w = sigma or
    sigma^2 / alpha."""
    case = crowded()
    level = torch.tensor(0.4)
    eta = torch.tensor([0.0, 0.5, 1.0, 2.0])
    x = case.noise(seed=3).requires_grad_(True)
    x0 = case.denoising(x, level, 2).clean(x)
    states = case.prior.decode(x0, case.context, steps=SAMPLED_STEPS).states()
    settings = PotentialSettings()
    temperature = settings.narrow * (settings.wide / settings.narrow) ** 0.4
    adversarial = adversarial_potential(
        states, case.conditions, settings=settings, temperature=temperature
    )
    feasible = feasibility_potential(states, case.conditions, settings=settings)
    (by_clean,) = torch.autograd.grad(feasible.sum(), x0, retain_graph=True)
    variable = x if gradient == "denoiser" else x0
    (by_adversary,) = torch.autograd.grad(adversarial.sum(), variable)
    sigma = case.prior.schedule.sigma(level)
    alpha = case.prior.schedule.alpha(level)
    weight = sigma if scaling == "sigma" else sigma**2 / alpha
    expected = eta[:, None, None] * clipped(weight * by_adversary, clips[0])
    expected = expected * case.coalition[..., None]
    feasibility = clipped(3.0 * weight * by_clean, clips[1])
    expected = expected + feasibility * case.context.active[..., None]
    expected[0] = 0.0
    control = SparseControl(
        eta > 0,
        [],
        guidance(
            case,
            eta,
            gradient=gradient,
            scaling=scaling,
            adversarial_clip=clips[0],
            feasibility=3.0,
            feasibility_clip=clips[1],
        ),
    )
    _, before, after = control(case.denoising(x, level, 2))
    torch.testing.assert_close(before, x0.detach())
    torch.testing.assert_close(before - after, expected, rtol=2e-3, atol=1e-5)
    assert (expected[1:, [MEMBER, 2]] != 0).any(-1).any(0).all()


def test_scenes_without_intensity_are_the_prior_s_in_a_mixed_batch():
    case = Case()
    step = guidance(case).anchor_step
    blend, shift = shifts(case, eta=[0.0, 1.0, 0.0, 2.0], k=step, weight=0.5)
    assert (shift[[0, 2]] == 0).all()
    assert (blend[[0, 2]] == 0).all()
    assert (shift[[1, 3]] != 0).any()
    assert (blend[[1, 3], MEMBER] != 0).any()


def test_clipping_keeps_directions_and_short_rows():
    rows = torch.tensor([[[3.0, 4.0], [0.3, 0.4], [0.0, 0.0]]])
    short = torch.tensor([[[0.6, 0.8], [0.3, 0.4], [0.0, 0.0]]])
    torch.testing.assert_close(clip_rows(rows, 1.0), short)
    assert torch.equal(clip_rows(rows, None), rows)


def test_a_clip_of_0_is_no_shift_also_where_there_is_no_gradient():
    rows = torch.tensor([[[3.0, 4.0], [0.0, 0.0]]])
    assert (clip_rows(rows, 0.0) == 0).all()


def test_eq_14_halves_the_noise_and_its_energy_is_booked(monkeypatch):
    """x = alpha x0 + sigma e with a clean estimate of 0.3, blended with weight 0.5."""
    case = Case(count=600)
    control = guidance(case, weight=0.5, **OFF)
    schedule = case.prior.schedule
    steps = case.prior.sampler.steps
    level = schedule.levels(steps)[steps - control.anchor_step]
    alpha = schedule.alpha(level)
    sigma = schedule.sigma(level)
    x = alpha * 0.3 + sigma * case.noise(seed=1)
    monkeypatch.setattr(case.prior, "denoise", lambda y, *_: torch.full_like(y, 0.3))
    after, _, _ = control(case.denoising(x, level, control.anchor_step))
    assert torch.equal(after[:, OTHERS], x[:, OTHERS])
    knots = after[:, MEMBER, :KNOTS]
    mean = alpha * (0.5 * 0.3 + 0.5 * ACCEL / ACCEL_SCALE)
    assert knots.mean().item() == pytest.approx(mean.item(), abs=0.04)
    assert knots.var().item() == pytest.approx(0.5 * sigma.item() ** 2, rel=0.06)
    energy = ((after - x) ** 2).sum(-1) / (2 * sigma**2)
    torch.testing.assert_close(control.jump, energy)
    assert (control.jump[:, MEMBER] > 0).all()
    assert (control.jump[:, OTHERS] == 0).all()


@pytest.mark.parametrize("wanted", [0.1, 0.5, 0.9])
def test_eq_14_happens_at_the_level_nearest_to_the_one_that_is_set(wanted):
    case = Case()
    levels = case.prior.sampler.levels(case.prior.schedule)
    step = guidance(case, anchor_level=wanted).anchor_step
    level = levels[case.prior.sampler.steps - step]
    assert (level - wanted).abs() == (levels[:-1] - wanted).abs().min()


def test_eq_14_happens_once():
    case = Case()
    steps = range(1, case.prior.sampler.steps + 1)
    step = guidance(case).anchor_step
    blends = [bool((shifts(case, k=k, weight=0.5)[0] != 0).any()) for k in steps]
    assert blends == [k == step for k in steps]


def test_without_feasibility_guidance_only_adversaries_leave_the_prior():
    guided = synthesizer(guidance={"feasibility": 0.0, "adversarial_clip": 0.5})
    _, plan = replanned(guided, scenes(3).scenes, eta=2.0)
    nats = plan.path_kl[:, 1:]  # row 0 holds the price of choices
    adversary = plan.adversary[:, 1:]
    assert (nats[~adversary] == 0).all()
    assert (nats[adversary] > 0).all()


def test_eq_14_without_guidance_is_refused():
    with pytest.raises(InputError, match="e2_paper"):
        synthesizer(control={"anchoring": "literal"})


def test_at_full_noise_a_gradient_counts_as_if_a_twentieth_of_the_signal_were_left():
    schedule = NoiseSchedule()
    level = torch.tensor(1.0)
    assert schedule.alpha(level) < 0.05
    weight = gradient_weight(schedule, level, "score")
    assert weight.item() == pytest.approx(20 * schedule.sigma(level).item() ** 2)
