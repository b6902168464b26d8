"""Guidance: the posterior mean moves as far as it is said to, masked rows not at all,
and the loss falls."""

from dataclasses import replace

import pytest
import torch

import e2rl
from e2rl.prior.prior import Denoising
from e2rl.traffic.baselines.guidance import CleanGuidance, MeanGuidance
from e2rl.traffic.baselines.view import folded, motion_of, pick, tiled
from tests.traffic.baselines.attacks import baseline, first_replan
from tests.traffic.e2.traffic_scenes import scenes


def control_inputs():
    """A baseline, the context of its first replan, the sum of its loss as a function of
    x, a noisy x at the third of four levels, that level and the next."""
    on = baseline("ctg_adv")
    (replan, context), view = first_replan(on, scenes(2).scenes)
    level, low = on.prior.sampler.levels(on.prior.schedule)[1:3]

    def objective(x):
        motion = motion_of(
            on.prior,
            x,
            context=context,
            batch=2,
        )
        return on.loss(motion, view).sum()

    return on, context, objective, replan.noise[0, :, :, 0], level, low


def test_the_mean_of_a_step_moves_by_adam_s_step_within_the_limit():
    on, context, objective, x, level, low = control_inputs()
    guided = context.active.clone()
    limit = torch.tensor([0.05, 10.0])
    guided[1, 1] = False
    control = MeanGuidance(
        on.prior,
        objective,
        guided=guided,
        limit=limit,
        step_size=0.3,
        iterations=1,
    )
    _, nominal, x0 = control(Denoising(on.prior, x, level, k=3, context=context))

    def mean(clean):
        return on.prior.sampler.on(on.prior.schedule).step(
            x, clean, level, low, torch.zeros(())
        )

    variance = mean(nominal)[1]
    shift = (mean(x0)[0] - mean(nominal)[0]).abs()
    assert (shift[~guided] == 0).all()
    assert shift[0].max().item() == pytest.approx(
        0.05 * variance.sqrt().item(), rel=1e-2
    )
    largest = min(
        0.3, 10 * variance.sqrt().item()
    )  # Adam's first step is the step size, whatever the gradient
    assert shift[1].max().item() == pytest.approx(largest, rel=1e-2)


def test_the_last_step_of_mean_guidance_is_free():
    on, context, objective, x, level, _ = control_inputs()
    control = MeanGuidance(
        on.prior,
        objective,
        guided=context.active,
        limit=torch.ones(2),
        step_size=0.3,
        iterations=1,
    )
    _, nominal, x0 = control(Denoising(on.prior, x, level, k=1, context=context))
    assert torch.equal(nominal, x0)


def test_clean_guidance_is_clipped_and_leaves_masked_rows_alone():
    on, context, objective, x, level, _ = control_inputs()
    guided = context.active.clone()
    guided[:, 1] = False
    control = CleanGuidance(
        objective,
        guided=guided,
        step_size=1e6,
        clip=0.25,
    )
    _, nominal, x0 = control(Denoising(on.prior, x, level, k=3, context=context))
    shift = (x0 - nominal).abs()
    assert (shift[~guided] == 0).all()
    assert shift.max().item() == pytest.approx(0.25, rel=1e-4)


def test_samples_go_along_the_batch_and_back():
    on = baseline("ctg_adv", samples=3)
    (current, context), _ = first_replan(on, scenes(2).scenes)
    flat = on.prior.sample(tiled(context, 3), folded(current.noise)).x0
    several = flat.unflatten(0, (3, 2))
    for number in range(3):
        single = on.prior.sample(context, current.noise[..., number, :].contiguous()).x0
        torch.testing.assert_close(
            several[number],
            single,
            rtol=1e-4,
            atol=1e-4,
        )
    by_scene = torch.tensor([2, 0])
    by_vehicle = torch.arange(8).expand(2, -1) % 3
    assert torch.equal(pick(flat, by_scene)[0], several[2, 0])
    assert torch.equal(pick(flat, by_scene)[1], several[0, 1])
    assert torch.equal(pick(flat, by_vehicle)[1, 4], several[1, 1, 4])
    assert torch.equal(current.state.lane.v, context.state.v)


@pytest.fixture(scope="module")
def bundled():
    return e2rl.load_scenes("bundled", num_scenes=6).scenes, e2rl.load_prior()


@pytest.mark.parametrize(
    "name", ["ctg", "ctg_adv", "safe_sim_opt", "ccdiff", "diffscene"]
)
def test_guidance_lowers_the_loss_of_bundled_scenes(name, bundled):
    scene, prior = bundled
    on = e2rl.make_traffic(name, prior, samples=1)
    (current, context), view = first_replan(on, scene)
    state, x0 = on.attack(current, context)
    nominal = prior.sample(context, current.noise[..., 0, :].contiguous()).x0
    view = replace(view, adversary=state.adversary)
    guided = state.adversary if on.adversarial else context.active

    def loss(x):
        motion = motion_of(
            prior,
            x,
            context=context,
            batch=len(x),
        )
        return torch.where(guided, on.loss(motion, view)[0], 0.0).sum()

    assert loss(x0) < loss(nominal)
    if on.adversarial:
        assert bool(guided.any())
        assert not torch.equal(x0[guided], nominal[guided])
