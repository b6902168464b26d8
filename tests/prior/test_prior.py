"""The prior as a whole: nominal reverse SDE, path KL, the ego's row, bounds, ends of
routes."""

from dataclasses import replace

import pytest
import torch

from e2rl.prior.bounds import BoundSettings, Duty
from e2rl.prior.lane_relative import HORIZON, KNOTS, SIZE
from e2rl.prior.prior import Prior
from e2rl.prior.routes import sample_route
from e2rl.prior.sde import SamplerSettings
from e2rl.sim.world import World
from tests.prior.small import VEHICLES, arc, curved_scenes, small_prior

FREE = BoundSettings(
    meeting=False,
    curve=False,
)
MEAN = 0.4
STD = 0.6


def context_of(prior, scene):
    vehicles = scene["route_log"].shape[1]
    routed, state = prior.start(scene, scene["route_log"].clamp(min=0))
    ego_plan = scene["logged"][:, 1 : HORIZON + 1, 0]
    assert state.s.shape[1] == vehicles
    return prior.encode(routed, state, World.at_start(scene), ego_plan=ego_plan)


def noise_for(prior, scene, seed=0):
    shape = (prior.sampler.steps, *scene["route_log"].shape, SIZE)
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def gaussian_prior(**sampler):
    """A prior whose denoiser is that of independent N(MEAN, STD^2) data."""
    prior = Prior(sampler=SamplerSettings(temperature=1.0, **sampler))

    def denoise(x, level, context):
        alpha = prior.schedule.alpha(level)
        sigma = prior.schedule.sigma(level)
        return MEAN + STD**2 * alpha / (alpha**2 * STD**2 + sigma**2) * (
            x - alpha * MEAN
        )

    prior.denoise = denoise
    return prior


@pytest.mark.parametrize(
    "sampler",
    [
        {"steps": 4},
        {"steps": 5, "churn": 0.7},
        {"steps": 5, "sampler": "dpm_solver_pp"},
        {"steps": 4, "sampler": "euler_maruyama"},
    ],
    ids=str,
)
@pytest.mark.parametrize("temperature", [1.0, 0.8])
def test_path_kl_is_that_of_the_two_laws_of_the_path(sampler, temperature):
    """With a linear denoiser the path (x_K .. x_1) is Gaussian: its law is read off
    unit noises, one per scene."""
    prior = gaussian_prior(**sampler)
    prior.sampler = SamplerSettings(
        **{**vars(prior.sampler), "temperature": temperature}
    )
    steps = prior.sampler.steps
    push = 0.3
    noise = torch.zeros(steps, steps + 1, 1, SIZE)
    for k in range(steps):
        noise[k, k + 1] = 1.0  # scene 0 has no noise: the mean

    def paths(shift):
        observed = []

        def control(step):
            observed.append(step.x[:, 0, 0])
            x0 = step.clean(step.x)
            return step.x, x0, x0 + shift

        kl = prior.sample(None, noise, control).kl
        return torch.stack(observed, -1).double(), kl

    (free, none), (pushed, kl) = paths(0.0), paths(push)
    mix = (free[1:] - free[:1]).T
    moved = pushed[0] - free[0]
    expected = 0.5 * moved @ torch.linalg.solve(mix @ mix.T, moved) * SIZE
    assert (none == 0).all()
    torch.testing.assert_close(
        kl[:, 0].double(),
        expected.expand(steps + 1),
        rtol=1e-3,
        atol=0,
    )


def test_the_log_ratio_is_that_of_the_two_densities_of_the_path():
    """Both laws of the path are products of Gaussian steps, whose densities torch
    knows."""
    prior = gaussian_prior(
        steps=4,
        sampler="ddim",
    )
    noise = torch.randn(
        4, 6, 1, SIZE, generator=torch.Generator().manual_seed(2)
    ).double()
    levels = prior.sampler.levels(prior.schedule)
    step = prior.sampler.on(prior.schedule).step
    total = torch.zeros(6, 1).double()
    before = []

    def control(denoising):
        x = denoising.x
        if before:
            means = [
                step(*before[-1][:1], x0, *before[-1][2:], x * 0)[0]
                for x0 in before[-1][1]
            ]
            std = step(*before[-1][:1], before[-1][1][0], *before[-1][2:], x * 0)[
                1
            ].sqrt()
            of_prior, of_control = (
                torch.distributions.Normal(mean, std).log_prob(x).sum(-1)
                for mean in means
            )
            total.add_(of_control - of_prior)
        x0 = denoising.clean(x)
        low = levels[len(before) + 1]
        before.append((x, (x0, x0 + 0.2 * x), denoising.level, low))
        return x, x0, x0 + 0.2 * x

    sample = prior.sample(None, noise, control)
    torch.testing.assert_close(
        sample.log_ratio,
        total,
        rtol=1e-4,
        atol=1e-4,
    )


def test_a_budget_is_spent_by_the_first_steps_and_later_ones_are_the_prior_s():
    prior = gaussian_prior(steps=6)
    noise = torch.randn(6, 2, 1, SIZE, generator=torch.Generator().manual_seed(0))
    observed = []

    def control(step):
        observed.append(step.x)
        x0 = step.clean(step.x)
        return step.x, x0, x0 + 0.5

    free = prior.sample(None, noise, control).kl[:, 0]
    budget = torch.stack([0.4 * free[0], 2 * free[1]])
    observed.clear()
    sample = prior.sample(None, noise, control, budget)
    torch.testing.assert_close(
        sample.kl[:, 0],
        torch.stack([budget[0], free[1]]),
        rtol=1e-4,
        atol=0,
    )
    last = prior.sampler.levels(prior.schedule)[5]
    x = observed[-1][:1]  # the last step is the prior's own where the budget is spent
    torch.testing.assert_close(sample.x0[:1], prior.denoise(x, last, None))
    assert (
        sample.x0[1] - prior.denoise(observed[-1][1:], last, None)[0]
    ).abs().min() > 0.4


def test_the_ego_s_row_is_its_plan_in_every_estimate():
    scene = curved_scenes(2)
    prior = small_prior()
    context = context_of(prior, scene)
    noise = noise_for(prior, scene)
    x0 = prior.denoise(noise[0], torch.tensor(0.7), context)
    assert torch.equal(x0[:, 0], context.ego_x)
    assert torch.equal(prior.sample(context, noise).x0[:, 0], context.ego_x)
    other = noise.clone()
    other[:, :, 0] = 9.0
    assert torch.equal(
        prior.sample(context, other).x0, prior.sample(context, noise).x0
    ), "noise of its row is unused"


@pytest.mark.parametrize("on_lane", [False, True])
def test_the_ego_s_plan_becomes_the_x_that_decodes_to_it(on_lane):
    scene = curved_scenes()
    scene["route_valid"][:, 0] &= on_lane
    prior = small_prior(bounds=FREE)
    context = context_of(prior, scene)
    plan = scene["logged"][:, 1 : HORIZON + 1, 0]
    x = torch.zeros(*scene["route_log"].shape, SIZE)
    x[:, 0] = context.ego_x
    decoded = prior.decode(x, context).states()[:, 0]
    assert (decoded - plan)[..., :2].norm(dim=-1).max() < 0.3


def test_bounds_change_what_is_executed_of_infeasible_plans_and_only_of_them():
    scene = curved_scenes()
    scene["start"][:, 5] = torch.tensor(
        [-7.0, 0.0, 0.0, 14.0]
    )  # runs into the ego from behind
    scene["route_points"][:, 5] = arc(
        -7.0,
        0.0,
        heading=0.0,
        curvature=0.0,
    )
    x0 = torch.zeros(*scene["route_log"].shape, SIZE)
    tight, loose = (
        small_prior(bounds=bounds) for bounds in (BoundSettings(curve=False), FREE)
    )
    free = loose.plan(x0, context_of(loose, scene)).motion.v
    shy = tight.plan(x0, context_of(tight, scene)).motion.v
    context = context_of(tight, scene)
    nobody = torch.zeros(scene["route_log"].shape, dtype=torch.bool)
    exempt = nobody.clone()
    exempt[:, 5] = True
    context.obstacles.duty = Duty(
        exempt, nobody, patience=torch.zeros_like(free[..., 0])
    )
    bold = tight.plan(x0, context).motion.v
    assert (shy[0, 5, 2:] < free[0, 5, 2:]).all()
    others = torch.arange(shy.shape[1]) != 5
    assert torch.equal(shy[:, others], free[:, others])
    assert torch.equal(bold[:, others], free[:, others])
    assert torch.equal(bold[0, 5], free[0, 5]), "an adversary may meet the ego"


def test_parked_absent_and_waiting_vehicles_stay_and_the_ego_is_not_moved():
    scene = curved_scenes()
    prior = small_prior()
    scene["parked"][:, 1] = True
    scene["start"][:, 4, 3] = 0.1
    context = context_of(prior, scene)
    plan = prior.plan(-torch.ones(*scene["route_log"].shape, SIZE), context)
    states = plan.states()
    still = [1, 4, *range(len(VEHICLES), scene["route_log"].shape[1])]
    start = scene["start"][:, : scene["route_log"].shape[1]]
    torch.testing.assert_close(
        states[:, still, :, :3], start[:, still, None, :3].expand(-1, -1, HORIZON, -1)
    )
    assert (states[:, still, :, 3] == 0).all()
    assert context.active[0].tolist() == [
        False,
        False,
        True,
        True,
        True,
        True,
        False,
        False,
    ]


def test_vehicles_end_where_an_open_route_ends():
    scene = curved_scenes()
    prior = small_prior(bounds=FREE)
    scene["route_length"][:, 2] = 30.0  # 10 m ahead, at 7 m/s
    scene["route_length"][:, 3], scene["route_open"][:, 3] = 30.0, False
    plan = prior.plan(
        torch.zeros(*scene["route_log"].shape, SIZE), context_of(prior, scene)
    )
    last = int(plan.on_map[0, 2].sum())
    assert 10 <= last <= 18
    assert plan.on_map[0, 2, :last].all()
    assert plan.on_map[0, 3].all()
    assert (plan.motion.s[0, 2, :last] < 30).all()
    assert plan.motion.s[0, 2, last] >= 30


def test_samples_do_not_depend_on_the_batch_nor_on_absent_vehicles():
    scene = curved_scenes(3)
    prior = small_prior()
    for copy in range(3):
        scene["start"][copy, 1, 3] += copy
    noise = noise_for(prior, scene)
    whole = prior.sample(context_of(prior, scene), noise).x0
    alone = prior.sample(context_of(prior, scene[1:2]), noise[:, 1:2]).x0
    torch.testing.assert_close(
        whole[1:2],
        alone,
        rtol=0,
        atol=2e-4,
    )
    wild = noise.clone()
    wild[:, :, len(VEHICLES) :] = 5.0
    here = scene["valid"][0, : scene["route_log"].shape[1]]
    torch.testing.assert_close(
        prior.sample(context_of(prior, scene), wild).x0[:, here], whole[:, here]
    )


def test_temperature_scales_every_noise():
    scene = curved_scenes()
    hot = small_prior(sampler=SamplerSettings(temperature=1.0))
    cold = small_prior(sampler=SamplerSettings(temperature=0.5))
    noise = noise_for(hot, scene)
    context = context_of(hot, scene)
    torch.testing.assert_close(
        cold.sample(context, 2 * noise).x0, hot.sample(context, noise).x0
    )


def test_the_same_weights_carry_lane_and_free_space_plans_apart():
    scene = curved_scenes()
    scene["route_valid"][:, 3] = False
    prior = small_prior(bounds=FREE)
    context = context_of(prior, scene)
    x0 = torch.ones(*scene["route_log"].shape, SIZE)
    mixed = prior.decode(x0, context)
    scene["route_valid"][:] = False
    alone = prior.decode(x0, context_of(prior, scene))
    torch.testing.assert_close(mixed.states()[:, 3], alone.states()[:, 3])
    assert (mixed.states()[:, 1] != alone.states()[:, 1]).any()
    assert (alone.kappa[:, 1, -1].abs() > 0.01).all(), "curvature knots bend the path"


def test_routes_are_drawn_in_proportion_and_never_where_there_is_none():
    logits = torch.tensor([1.0, -torch.inf, 0.0, -torch.inf]).expand(20_000, 4)
    uniform = torch.rand(len(logits), generator=torch.Generator().manual_seed(0))
    uniform[0], uniform[1] = 0.0, 1.0
    chosen = sample_route(logits, 0.5, uniform=uniform)
    share = torch.bincount(chosen, minlength=4) / len(chosen)
    torch.testing.assert_close(
        share,
        torch.softmax(logits[0] / 0.5, -1),
        rtol=0,
        atol=0.01,
    )
    assert (sample_route(logits, 0.0, uniform=uniform) == 0).all()


def test_the_ego_follows_its_mission_whatever_is_drawn():
    scene = curved_scenes()
    prior = small_prior()
    scene["route_valid"][:, :, 1] = scene["route_valid"][:, :, 0]
    scene["route_log"][:, 0] = 1
    chosen = prior.choose_routes(scene, torch.zeros(scene["route_valid"].shape[:2]))
    assert chosen[0, 0] == 1
    assert (chosen[0, 1:] == 0).all()


@pytest.mark.parametrize("moved", [False, True])
def test_what_is_known_of_the_moment_changes_no_context(moved):
    """A context of the same moment gives leaders, but not of a vehicle that is
    elsewhere on its route by now."""
    scene = curved_scenes()
    prior = small_prior()
    before = context_of(prior, scene)
    state = replace(before.state, s=before.state.s + 7.0 * moved)
    world = World.at_start(scene)
    certain = prior.encode(before.routed, state, world, known=before)
    anew = prior.encode(before.routed, state, world)
    assert torch.equal(certain.encoding.nodes, anew.encoding.nodes)
    assert all(
        torch.equal(first, other)
        for first, other in zip(certain.followed, anew.followed, strict=True)
    )
    assert (certain.followed is before.followed) == (not moved)


def test_without_a_plan_the_ego_is_sampled_like_everybody_else():
    prior = small_prior()
    scene = curved_scenes(2)
    certain = context_of(prior, scene)
    unknown = prior.encode(certain.routed, certain.state, World.at_start(scene))
    first, two = (
        prior.sample(unknown, noise_for(prior, scene, seed=seed)).x0[:, 0]
        for seed in (0, 1)
    )
    assert (first - two).abs().amin() > 0


def test_the_network_sees_the_ego_s_plan_nearly_noise_free(monkeypatch):
    scene = curved_scenes()
    prior = small_prior()
    context = context_of(prior, scene)
    observed = []
    monkeypatch.setattr(
        prior.denoiser,
        "forward",
        lambda x, level, encoding: observed.append(level) or x,
    )
    prior.denoise(noise_for(prior, scene)[0], torch.tensor(0.7), context)
    assert observed[0][0].tolist() == pytest.approx(
        [0.01] + [0.7] * (observed[0].shape[1] - 1)
    )


@pytest.mark.parametrize(
    ("speed", "accel", "held"),
    [
        (0.48, -0.05, True),  # 1.8 m in 5 s
        (0.52, -0.06, False),  # 1.9 m, but it moves
        (0.4, -0.01, True),  # 1.9 m
        (0.4, 0.01, False),  # 2.1 m
    ],
)
def test_who_stands_is_held_until_its_plan_leads_two_metres_on(speed, accel, held):
    scene = curved_scenes()
    scene["start"][:, 4, 3] = speed
    scene["start_accel"][:, 4] = accel
    prior = small_prior(bounds=FREE)
    x0 = torch.zeros(*scene["route_log"].shape, SIZE)
    x0[:, 4, :KNOTS] = accel
    plan = prior.plan(x0, context_of(prior, scene))
    assert (plan.motion.v[0, 4, 0].item() == 0) == held


@pytest.mark.parametrize(("spent", "controlled"), [(0.9, True), (0.9995, False)])
def test_a_budget_counts_as_spent_a_thousandth_before_its_end(spent, controlled):
    """The step without noise is controlled where some of the budget is left."""
    prior = gaussian_prior(steps=3)
    noise = torch.randn(3, 1, 1, SIZE, generator=torch.Generator().manual_seed(3))

    def control(step):
        x0 = step.clean(step.x)
        return step.x, x0, x0 + 0.5

    used = prior.sample(None, noise, control).kl[:, 0]
    sample = prior.sample(None, noise, control, budget=used / spent)
    free = prior.sample(None, noise, control)
    shift = (sample.x0 - free.x0).abs().max().item()
    assert (shift < 0.05) == controlled
