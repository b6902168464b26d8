"""Guidance: the posterior mean moves as far as it is said to, masked rows not at all,
and the loss falls."""

from functools import partial

import pytest
import torch

import e2rl
from e2rl.traffic.baselines.guidance import CleanGuidance, MeanGuidance
from e2rl.traffic.baselines.view import folded, motion_of, pick, tiled
from tests.traffic.baselines.attacks import baseline, first_replan
from tests.traffic.e2.traffic_scenes import scenes


def control_inputs():
    """A baseline's first replan, a noisy x at the third of four levels, and the
    denoiser there."""
    on = baseline("ctg_adv")
    (now, context), view = first_replan(on, scenes(2).scenes)
    level, low = on.prior.sampler.levels(on.prior.schedule)[1:3]
    return on, now.state, view, context, now.noise[0, :, :, 0], level, low


def test_the_mean_of_a_step_moves_by_adam_s_step_within_the_limit():
    on, state, view, context, x, level, low = control_inputs()
    guided = context.active.clone()
    limit = torch.tensor([0.05, 10.0])
    guided[1, 1] = False
    control = MeanGuidance(
        on.prior,
        partial(on.loss, state=state, view=view),
        guided=guided,
        limit=limit,
        samples=1,
        step_size=0.3,
        iterations=1,
    )
    _, nominal, x0 = control(
        x, level, 3, context, lambda value: on.prior.denoise(value, level, context)
    )

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
    on, state, view, context, x, level, _ = control_inputs()
    control = MeanGuidance(
        on.prior,
        partial(on.loss, state=state, view=view),
        guided=context.active,
        limit=torch.ones(2),
        samples=1,
        step_size=0.3,
        iterations=1,
    )
    _, nominal, x0 = control(
        x, level, 1, context, lambda value: on.prior.denoise(value, level, context)
    )
    assert torch.equal(nominal, x0)


def test_clean_guidance_is_clipped_and_leaves_masked_rows_alone():
    on, state, view, context, x, level, _ = control_inputs()
    guided = context.active.clone()
    guided[:, 1] = False
    control = CleanGuidance(
        on.prior,
        partial(on.loss, state=state, view=view),
        guided=guided,
        samples=1,
        step_size=1e6,
        clip=0.25,
    )
    _, nominal, x0 = control(
        x, level, 3, context, lambda value: on.prior.denoise(value, level, context)
    )
    shift = (x0 - nominal).abs()
    assert (shift[~guided] == 0).all() and shift.max().item() == pytest.approx(
        0.25, rel=1e-4
    )


def test_samples_go_along_the_batch_and_back():
    on = baseline("ctg_adv", samples=3)
    (now, context), _ = first_replan(on, scenes(2).scenes)
    many = on.prior.sample(tiled(context, 3), folded(now.noise)).x0.unflatten(0, (3, 2))
    for number in range(3):
        one = on.prior.sample(context, now.noise[..., number, :].contiguous()).x0
        torch.testing.assert_close(many[number], one, rtol=1e-4, atol=1e-4)
    by_scene = torch.tensor([2, 0])
    by_vehicle = torch.arange(8).expand(2, -1) % 3
    assert torch.equal(pick(many, by_scene)[0], many[2, 0]) and torch.equal(
        pick(many, by_scene)[1], many[0, 1]
    )
    assert torch.equal(pick(many, by_vehicle)[1, 4], many[1, 1, 4])
    assert torch.equal(now.state.lane.v, context.state.v)


@pytest.fixture(scope="module")
def bundled():
    return e2rl.load_scenes("bundled", num_scenes=6).scenes, e2rl.load_prior()


@pytest.mark.parametrize(
    "name", ["ctg", "ctg_adv", "safe_sim_opt", "ccdiff", "diffscene"]
)
def test_guidance_lowers_the_loss_of_bundled_scenes(name, bundled):
    scene, prior = bundled
    on = e2rl.make_traffic(name, prior, samples=1)
    (now, context), view = first_replan(on, scene)
    state, x0 = on.attack(now, context)
    nominal = prior.sample(context, now.noise[..., 0, :].contiguous()).x0
    given = {"adversary": state.adversary} if name == "diffscene" else {}
    loss = partial(on.loss, state=state, view=view, **given)
    values = [
        loss(motion_of(prior, value, context=context, count=1))
        for value in (x0, nominal)
    ]
    guided = state.adversary if on.adversarial else context.active
    after, before = (torch.where(guided, value[0], 0.0).sum() for value in values)
    assert after < before
    if on.adversarial:
        assert bool(guided.any()) and not torch.equal(x0[guided], nominal[guided])
