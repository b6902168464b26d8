"""STRIVE: a deterministic decoder, an objective that falls, an attacker that is never
behind, a test for a solution."""

from dataclasses import replace

import torch

from e2rl.prior.sde import SamplerSettings
from e2rl.sim.world import World
from e2rl.traffic.baselines.strive import blend, softmin
from e2rl.traffic.lookahead import Lookahead
from tests.prior.small import small_prior
from tests.traffic.baselines.attacks import baseline, first_replan
from tests.traffic.e2.traffic_scenes import EGO, begin, scenes


def test_latents_are_decoded_as_by_ddim_without_noise():
    on = baseline("strive")
    on.steps = 4
    (current, context), _ = first_replan(on, scenes(2).scenes)
    prior = small_prior(
        0,
        sampler=SamplerSettings(
            sampler="ddim",
            spacing="level",
            steps=4,
            churn=0.0,
        ),
    )
    expected = prior.sample(context, current.noise[..., 0, :]).x0
    torch.testing.assert_close(
        on.decode(current.noise[0, ..., 0, :], context), expected
    )


def test_the_objective_falls_over_the_iterations():
    on = baseline(
        "strive",
        iterations=12,
        knowledge="predicted",
    )
    (current, context), view = first_replan(on, scenes(3).scenes)
    first = current.noise[0, :, :, 0]
    values = []

    def loss(latent):
        motion = on.motion(on.decode(latent, context), context)
        values.append(
            on.loss(
                motion,
                latent,
                first=first,
                view=view,
            )
        )
        return values[-1]

    on.optimised(first, loss)
    assert (values[-1] < values[0]).all()
    assert values[-1].sum() < 0.9 * values[0].sum()


def test_the_planner_is_driven_anew_at_every_iteration_and_not_without_its_plan():
    scene = scenes(2).scenes
    requests = []
    world = World.at_start(scene)
    look = Lookahead(EGO, world)
    react = lambda rows, planned: requests.append(planned) or look(rows, planned)  # noqa: E731
    on = baseline("strive", iterations=3)
    assert on.queries_ego
    assert not baseline("strive", knowledge="predicted").queries_ego
    on.replan(begin(on, scene, eta=2.0), world, EGO.plan(world), react)
    assert len(requests) == 4
    assert not torch.equal(requests[0], requests[3])


def test_nobody_behind_the_ego_is_the_attacker():
    on = baseline("strive")
    _, view = first_replan(on, scenes(1).scenes)
    states = view.states[None, :, :, None].repeat(1, 1, 1, 10, 1)
    weight = softmin(states, view)[0].sum(-1)
    assert weight[3] == 0
    assert weight.argmax() == 2  # 20 m behind; 10 m ahead in the next lane
    assert abs(weight.sum().item() - 1) < 1e-4
    alone = softmin(states, replace(view, active=view.active & False))
    assert (alone == 0).all()
    torch.testing.assert_close(
        blend((1.0, 0.1), torch.tensor([0.0, 0.5, 1.0])), torch.tensor([1.0, 0.55, 0.1])
    )


def test_an_ego_that_is_boxed_in_has_no_solution():
    on = baseline("strive", iterations=10)
    (current, context), view = first_replan(on, scenes(1).scenes)
    first = current.noise[0, ..., 0, :]
    far = view.states[None, :, :, None].repeat(1, 1, 1, 10, 1)
    far[..., 1] += 100.0 * (torch.arange(far.shape[2]) > 0)[:, None]
    walled = far.clone()
    walled[:, :, 1, :, :2] = torch.tensor(
        [8.0, 0.0]
    )  # stands a box's length ahead, at 10 m/s
    result = []
    for states in (far, walled):
        motion = on.motion(torch.zeros_like(first), context)
        motion.x, motion.y, motion.heading, motion.v = states.unbind(-1)
        solved = on.solvable(
            first,
            motion,
            view=view,
            context=context,
        )
        result.append(solved.tolist())
    assert result == [[True], [False]]


def test_nobody_is_attacked_before_2_seconds():
    """Moments are half a second apart, the fourth 2 s ahead."""
    on = baseline("strive")
    _, view = first_replan(on, scenes(1).scenes)
    weight = softmin(view.states[None, :, :, None].repeat(1, 1, 1, 10, 1), view)
    assert (weight[..., :3] == 0).all()
    assert (weight[0, 2, 3:] > 0).all()


def test_the_objective_weighs_latents_by_who_attacks():
    """The energy of a latent by 1 for bystanders and 0.005 for the attacker, half of
    it; the distance to the first latent by 0.5 and 0.05; leaving the road by 20."""
    on = baseline("strive")
    _, view = first_replan(on, scenes(1).scenes)
    view = replace(view, strength=torch.zeros(1))
    motion = view.lane.map(lambda field: field[None, ..., None].repeat(1, 1, 1, 10))
    fraction = softmin(view.with_ego(motion), view).sum(-1)[view.active]
    latent = torch.zeros(*view.active.shape, 12)
    first = latent.clone()
    latent[..., 0] = 2.0
    first[..., 0] = -1.0
    energy = (1.0 - 0.995 * fraction) * 0.5 * 4.0
    moved = (0.5 - 0.45 * fraction) * 9.0
    value = on.loss(
        motion,
        latent,
        first=first,
        view=view,
    )
    calm = on.loss(
        motion,
        0 * latent,
        first=0 * latent,
        view=view,
    )
    torch.testing.assert_close(value - calm, (energy + moved).sum()[None])
    away = replace(motion, y=motion.y + 500.0)
    cost = (20 * 5.0 / view.size.norm(dim=-1))[view.active].sum()
    far = on.loss(
        away,
        0 * latent,
        first=0 * latent,
        view=view,
    )
    torch.testing.assert_close(far, cost[None])
