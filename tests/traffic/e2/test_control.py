"""Sparse control: who may be moved and who may not, what moving does to V, anchoring
and its noise."""

import pytest
import torch

from e2rl.prior.lane_relative import ACCEL_SCALE, HORIZON, KNOTS, SIZE
from e2rl.run.errors import InputError
from e2rl.traffic.e2 import control as control_module
from e2rl.traffic.e2.anchoring import Anchor
from e2rl.traffic.e2.control import ControlSettings, SparseControl, clip_rows
from e2rl.traffic.potentials import (
    SAMPLED_STEPS,
    PotentialContext,
    PotentialSettings,
    adversarial_potential,
    feasibility_potential,
)
from tests.prior.small import small_prior
from tests.traffic.e2.traffic_scenes import ROWS, scenes

MEMBER = 1  # the coalition: the vehicle ahead of the ego


class Case:
    """One replan of `count` equal scenes, ready to be sampled under control."""

    def __init__(self, count=4, prior=None):
        self.prior = prior or small_prior()
        self.scene = scenes(1).scenes[torch.zeros(count, dtype=torch.long)]
        route = self.scene["route_log"].clamp(min=0)
        routed, state = self.prior.start(self.scene, route)
        plan = self.scene["logged"][:, 1:2, 0].repeat(1, HORIZON, 1)
        plan[..., 0] += torch.arange(HORIZON)  # 10 m/s
        step = torch.zeros(count, dtype=torch.long)
        self.coalition = torch.zeros(count, ROWS, dtype=torch.bool)
        self.coalition[:, MEMBER] = True
        self.context = self.prior.encode(
            routed, state, self.scene["start"], self.scene["valid"], step, plan
        )
        target = torch.where(self.coalition, 0, -1)
        now = self.scene["start"][:, :ROWS], state.a, self.scene["valid"][:, :ROWS]
        self.where = PotentialContext(
            self.scene, *now, routed.points, routed.has_lane, plan, target
        )
        feasible = self.coalition.clone()
        none = self.coalition & False
        knots = torch.full((count, ROWS, KNOTS), -2.0)
        self.anchor = Anchor(
            route,
            knots,
            feasible=feasible,
            cost=torch.zeros(count, ROWS),
            off_lane=none,
            off_lane_path=routed.points,
        )
        self.generator = torch.Generator().manual_seed(0)
        self.noise = torch.randn(
            self.prior.sampler.steps, count, ROWS, SIZE, generator=self.generator
        )

    def control(self, eta=1.0, strength=0.0, **settings):
        eta = (
            torch.full((len(self.scene),), eta)
            if isinstance(eta, float)
            else torch.tensor(eta)
        )
        extra = torch.randn(
            len(self.scene), ROWS, SIZE, generator=torch.Generator().manual_seed(7)
        )
        chosen = (
            ControlSettings(
                **({"adversarial_clip": 0.5, "feasibility": 4.0} | settings)
            ),
            PotentialSettings(),
        )
        given = self.where, self.coalition, eta, self.anchor
        return SparseControl(self.prior, *chosen, *given, strength, extra)

    def shift(self, level=0.5, k=2, seed=0, **options):
        """(x0 after - x0 before control, x after - x before anchoring) at one noise
        level."""
        x = torch.randn(
            len(self.scene), ROWS, SIZE, generator=torch.Generator().manual_seed(seed)
        )
        level = torch.tensor(level)
        control = self.control(**options)
        after, nominal, x0 = control(
            x,
            level,
            k,
            self.context,
            lambda y: self.prior.denoise(y, level, self.context),
        )
        return x0 - nominal, after - x


OTHERS = [i for i in range(ROWS) if i != MEMBER]


def crowded():
    """Vehicle 2 laps over vehicle 1's lane, so that V_feas moves both."""
    case = Case()
    case.scene["start"][:, 2, 1] = 2.2
    case.context.state.d[:, 2] = -1.3
    return case


@pytest.mark.parametrize("level", [0.5, 1.0])
def test_feasibility_acts_once_the_clean_estimate_has_taken_shape(level, monkeypatch):
    monkeypatch.setattr(control_module, "FEASIBILITY_LEVEL", level)
    case = crowded()
    levels = case.prior.schedule.levels(case.prior.sampler.steps)
    for k in range(1, case.prior.sampler.steps + 1):
        at = float(levels[case.prior.sampler.steps - k])
        shift, _ = case.shift(level=at, k=k, adversarial_clip=0.0)
        assert bool((shift != 0).any()) == (at <= level and k > 1), (
            "the last step, without noise, is the prior's"
        )


@pytest.mark.parametrize("gradient", ["denoiser", "clean"])
@pytest.mark.parametrize(
    ("scaling", "clips"), [("sigma", (0.02, 0.03)), ("score", (1e6, 1e6))]
)
def test_the_shift_is_that_of_the_gradients_scaled_clipped_and_masked(
    gradient, scaling, clips
):
    """x0 - eta M clip(w grad V_adv) - clip(lambda w grad V_feas), w = sigma or sigma^2
    / alpha."""
    case = crowded()
    level = torch.tensor(0.4)
    eta = torch.tensor([0.0, 0.5, 1.0, 2.0])
    x = torch.randn(
        4, ROWS, SIZE, generator=torch.Generator().manual_seed(3)
    ).requires_grad_(True)
    x0 = case.prior.denoise(x, level, case.context)
    states = case.prior.decode(x0, case.context, steps=SAMPLED_STEPS).states()
    narrow = PotentialSettings().narrow
    wide = PotentialSettings().wide
    temperature = narrow * (wide / narrow) ** 0.4
    adversarial = adversarial_potential(
        states, case.where, settings=PotentialSettings(), temperature=temperature
    ).sum()
    feasible = feasibility_potential(
        states, case.where, settings=PotentialSettings()
    ).sum()
    (by_clean,) = torch.autograd.grad(feasible, x0, retain_graph=True)
    (by_adversary,) = torch.autograd.grad(
        adversarial, x if gradient == "denoiser" else x0
    )
    alpha = case.prior.schedule.alpha(level)
    sigma = case.prior.schedule.sigma(level)
    weight = sigma if scaling == "sigma" else sigma**2 / alpha

    def clipped(rows, limit):
        norm = rows.norm(dim=-1, keepdim=True)
        return torch.where(norm > limit, rows * limit / norm, rows)

    expected = (
        eta[:, None, None]
        * clipped(weight * by_adversary, clips[0])
        * case.coalition[..., None]
    )
    expected = (
        expected
        + clipped(3.0 * weight * by_clean, clips[1]) * case.context.active[..., None]
    )
    expected[0] = 0.0
    options = {
        "adversarial_clip": clips[0],
        "feasibility": 3.0,
        "feasibility_clip": clips[1],
    }
    made = case.control(eta=eta.tolist(), gradient=gradient, scaling=scaling, **options)
    after, nominal, controlled = made(
        x, level, 2, case.context, lambda y: case.prior.denoise(y, level, case.context)
    )
    torch.testing.assert_close(nominal, x0.detach())
    torch.testing.assert_close(nominal - controlled, expected, rtol=2e-3, atol=1e-5)
    assert (
        torch.equal(after, x) and (expected[1:, [MEMBER, 2]] != 0).any(-1).any(0).all()
    )


def test_without_intensity_nothing_moves_in_a_mixed_batch():
    case = Case()
    for options in (
        {"strength": 8.0},
        {"strength": 0.5, "anchoring": "literal", "k": case.control().anchor_step},
    ):
        shift, jump = case.shift(eta=[0.0, 1.0, 0.0, 2.0], **options)
        assert (shift[[0, 2]] == 0).all() and (jump[[0, 2]] == 0).all()
        assert (shift[[1, 3]] != 0).any() and bool(
            (jump[[1, 3], MEMBER] != 0).any()
        ) == ("k" in options)


def test_clipping_keeps_directions_and_short_rows():
    rows = torch.tensor([[[3.0, 4.0], [0.3, 0.4], [0.0, 0.0]]])
    torch.testing.assert_close(
        clip_rows(rows, 1.0), torch.tensor([[[0.6, 0.8], [0.3, 0.4], [0.0, 0.0]]])
    )
    assert (clip_rows(rows, 0.0) == 0).all(), (
        "a clip of 0 is no shift, also where there is no gradient"
    )


def anchored(case, strength, **settings):
    """x at the anchor's level before and after it, for x = alpha x0 + sigma e with the
    denoiser's own x0."""
    control = case.control(strength=strength, **settings)
    level = case.prior.schedule.levels(case.prior.sampler.steps)[
        case.prior.sampler.steps - control.anchor_step
    ]
    alpha = case.prior.schedule.alpha(level)
    sigma = case.prior.schedule.sigma(level)
    x = alpha * 0.3 + sigma * torch.randn(
        len(case.scene), ROWS, SIZE, generator=case.generator
    )
    x[:, 0] = case.context.ego_x
    clean = torch.full_like(x, 0.3)
    after, *_ = control(
        x, level, control.anchor_step, case.context, lambda y: clean + 0 * y
    )
    return control, level, x, after


def test_the_printed_blend_halves_the_noise_and_its_energy_is_booked():
    case = Case(count=600)
    control, level, x, after = anchored(
        case, 0.5, anchoring="literal", gradient="clean"
    )
    assert torch.equal(after[:, OTHERS], x[:, OTHERS])
    alpha = case.prior.schedule.alpha(level)
    sigma = case.prior.schedule.sigma(level)
    mean = alpha * (0.5 * 0.3 - 0.5 * 2.0 / ACCEL_SCALE)
    knots = after[:, MEMBER, :KNOTS]
    assert knots.mean().item() == pytest.approx(mean.item(), abs=0.04)
    assert knots.var().item() == pytest.approx(0.5 * sigma.item() ** 2, rel=0.06)
    torch.testing.assert_close(
        control.jump, ((after - x) ** 2).sum(-1) / (2 * sigma**2)
    )
    assert (control.jump[:, MEMBER] > 0).all() and (control.jump[:, OTHERS] == 0).all()


def test_the_printed_blend_happens_once_at_the_level_nearest_to_the_set_one_and_can_be_off():
    case = Case()
    levels = case.prior.sampler.levels(case.prior.schedule)
    for wanted in (0.1, 0.5, 0.9):
        control = case.control(anchor_level=wanted)
        at = levels[case.prior.sampler.steps - control.anchor_step]
        assert (at - wanted).abs() == (levels[:-1] - wanted).abs().min()
    step = case.control().anchor_step
    literal = {"strength": 0.5, "anchoring": "literal"}
    moved = [
        bool((case.shift(k=k, **literal)[1] != 0).any())
        for k in range(1, case.prior.sampler.steps + 1)
    ]
    assert moved == [k == step for k in range(1, case.prior.sampler.steps + 1)]
    assert (case.shift(k=step, strength=0.5, anchoring="off")[1] == 0).all()
    case.anchor.feasible[:] = False
    assert (case.shift(k=step, **literal)[1] == 0).all(), (
        "members that cannot meet their target are not anchored"
    )


def test_raw_proposals_are_driven_as_they_are_and_have_no_budget():
    case = Case()
    options = {
        "anchoring": "raw",
        "strength": 8.0,
        "adversarial_clip": 0.0,
        "feasibility": 0.0,
    }
    assert (case.shift(k=3, **options)[1] == 0).all(), "nothing is pulled on the way"
    x = case.noise[0]
    level = torch.tensor(0.1)
    given = level, 1, case.context, lambda y: case.prior.denoise(y, level, case.context)
    _, x0, driven = case.control(**options)(x, *given)
    assert torch.equal(driven[:, OTHERS], x0[:, OTHERS])
    torch.testing.assert_close(
        driven[:, MEMBER, :KNOTS] * ACCEL_SCALE, case.anchor.knots[:, MEMBER]
    )
    with pytest.raises(InputError, match="transport_budget"):
        ControlSettings(anchoring="raw", transport_budget=10.0)


def test_an_anchor_pulls_the_coalition_at_every_step_but_the_last_and_to_the_prior_as_eta_goes_to_0():
    case = Case()
    options = {"strength": 8.0, "adversarial_clip": 0.0, "feasibility": 0.0}
    for k in range(1, case.prior.sampler.steps + 1):
        shift, _ = case.shift(k=k, **options)
        assert (shift[:, OTHERS] == 0).all() and (
            shift[:, MEMBER, KNOTS:].abs() < 1e-5
        ).all()
        assert bool((shift[:, MEMBER] != 0).any()) == (k > 1)
    sizes = [
        case.shift(eta=eta, **options)[0].norm().item()
        for eta in (1e-3, 1e-2, 1e-1, 1.0)
    ]
    assert sizes == sorted(sizes) and sizes[0] < 0.02 * sizes[-1]
    case.anchor.feasible[:] = False
    assert (case.shift(**options)[0] == 0).all(), (
        "members that cannot meet their target are not anchored"
    )
