"""Episodes: noise of its own for each scene, nominal at eta = 0, a coalition that is chosen, kept and accounted for."""

from dataclasses import replace

import pytest
import torch
from e2rl.synthesizer.episode import noise_of, put_rows, take_rows
from e2rl.synthesizer.synthesizer import Synthesizer, SynthesizerSettings

from e2rl.ego.idm import IDMEgo
from e2rl.prior.lane_relative import HORIZON, SIZE, LaneState
from e2rl.prior.prior import SamplerSettings
from e2rl.sim.world import World
from e2rl.synthesizer.control import ControlSettings
from tests.prior.small import curved_scenes, small_prior
from tests.synthesizer.traffic_scenes import ROWS, scenes, synthesizer

EGO = IDMEgo()


def world_of(scene):
    return World(
        scene,
        torch.zeros(len(scene), dtype=torch.long),
        scene["start"],
        scene["valid"],
        scene["start_accel"],
        scene["route_log"].clamp(min=0),
    )


def begin(on, scene, eta, seeds=None):
    count = len(scene)
    seeds = torch.arange(count) if seeds is None else torch.tensor(seeds)
    return on.begin(scene, seeds, torch.full((count,), eta))


def replanned(on, scene, eta, seeds=None, times=1):
    """Episode and plan after `times` replans, each 5 steps of perfect execution after the last."""
    episode, world = begin(on, scene, eta, seeds), world_of(scene)
    for _ in range(times):
        ego_plan = EGO.plan(world)
        episode, plan = on.replan(episode, world, ego_plan)
        episode = replace(episode, state=plan.after(5))
        states = world.states.clone()
        states[:, :ROWS] = plan.states()[:, :, 4]
        states[:, 0] = ego_plan[:, 4]
        world = replace(world, step=world.step + 5, states=states)
    return episode, plan


def test_noise_is_standard_and_depends_on_seed_and_draw_only():
    seed, draw = torch.tensor([3, 4, 3]), torch.tensor([1, 1, 2])
    noise = noise_of(seed, draw, (5000,))
    assert noise.mean(1).abs().max() < 0.06 and (noise.std(1) - 1).abs().max() < 0.04
    assert torch.equal(noise[2:], noise_of(seed[2:], draw[2:], (5000,)))
    assert not torch.equal(noise[0], noise[1]) and not torch.equal(noise[0], noise[2])
    uniform = noise_of(seed, draw, (5000,), uniform=True)
    assert uniform.min() >= 0 and uniform.max() < 1


def test_rows_are_taken_and_put_in_nested_states_without_touching_the_original():
    fields = torch.arange(40.0).reshape(10, 4)
    state = LaneState(*fields)
    rows = torch.tensor([2, 0])
    part = take_rows(state, rows)
    assert part.v.tolist() == [18.0, 16.0]
    back = put_rows(state, rows, part.map(lambda value: value + 100))
    assert back.v.tolist() == [116.0, 17.0, 118.0, 19.0] and state.v.tolist() == [16.0, 17.0, 18.0, 19.0]
    world = take_rows(world_of(scenes(2).scenes), torch.tensor([1]))
    assert len(world.scene) == 1 and world.plan is None


def test_a_scene_is_planned_alike_alone_and_in_a_batch():
    on, scene = synthesizer(), scenes(3).scenes
    for eta in (0.0, 2.0):
        whole_episode, whole = replanned(on, scene, eta, [5, 6, 7])
        alone_episode, alone = replanned(on, scene[1:2], eta, [6])
        torch.testing.assert_close(alone.states(), whole.states()[1:2], rtol=0, atol=5e-3)
        assert torch.equal(alone_episode.routed.route, whole_episode.routed.route[1:2])
        assert torch.equal(alone_episode.coalition, whole_episode.coalition[1:2])


def test_scenes_that_were_planned_differently_often_share_a_batch():
    on, scene = synthesizer(), scenes(2).scenes
    world = world_of(scene)
    fresh = begin(on, scene, 0.0, [5, 6])
    mixed = replace(fresh, replans=torch.tensor([0, 3]))
    _, plan = on.replan(mixed, world, EGO.plan(world))
    for row, count in enumerate((0, 3)):
        one = replace(take_rows(fresh, torch.tensor([row])), replans=torch.tensor([count]))
        there = take_rows(world, torch.tensor([row]))
        _, alone = on.replan(one, there, EGO.plan(there))
        torch.testing.assert_close(alone.states(), plan.states()[row : row + 1], rtol=0, atol=5e-3)


def test_without_intensity_the_plan_is_the_prior_s():
    """Padding, which replan crops, changes the order of sums and nothing else; in equal batches eta = 0 is bit for bit
    the same (test_control)."""
    on, scene = synthesizer(), scenes(2).scenes
    episode, plan = replanned(on, scene, 0.0)
    world = world_of(scene)
    first = begin(on, scene, 0.0)
    placed = replace(first, state=on._placed(first, world, EGO.plan(world)))
    context = on.prior.encode(placed.routed, placed.state, world.states, world.valid, world.step, EGO.plan(world))
    shape = (on.prior.sampler.steps, ROWS, SIZE)
    noise = noise_of(placed.seed, torch.ones(2, dtype=torch.long), shape).transpose(0, 1)
    nominal = on.prior.plan(on.prior.sample(context, noise).x0, context)
    here = scene["valid"][:, :ROWS]
    torch.testing.assert_close(plan.states()[here], nominal.states()[here], rtol=1e-4, atol=1e-4)
    assert torch.equal(plan.on_map[here], nominal.on_map[here])
    assert not episode.coalition.any() and (episode.kl == 0).all() and (episode.jump == 0).all()


def test_a_coalition_acts_on_the_ego_directly_or_through_members():
    on, scene = synthesizer(), scenes(4).scenes
    episode, _ = replanned(on, scene, 2.0)
    assert episode.coalition.any(1).all() and not episode.coalition[:, 0].any()
    assert torch.equal(episode.coalition, episode.target >= 0) and torch.equal(episode.adversaries, episode.coalition)
    members = episode.coalition.clone()
    members[:, 0] = True
    target = episode.target.clamp(min=0)
    assert members.gather(1, target).all(), "no chain leads over somebody who is not controlled"
    assert (episode.kl[episode.coalition] > 0).all()


def test_a_chain_over_a_pruned_member_is_pruned(monkeypatch):
    """Vehicle 4 acts on 2, which acts on 1, which has no proposal."""
    from e2rl.synthesizer import synthesizer as module

    on, scene = synthesizer(), scenes(1).scenes
    target = torch.tensor([[-1, 0, 1, 0, 2, -1]])  # the rows in use
    acts = target >= 0
    build, propose = module.build_skeleton, module.propose

    def chained(*arguments):
        return replace(build(*arguments), coalition=acts, target=target, depth=torch.tensor([[0, 1, 2, 1, 3, 0]]))

    def without_one(scene, world, skeleton, *arguments, **options):
        feasible = skeleton.coalition.clone()
        feasible[:, 1] = False
        return replace(propose(scene, world, skeleton, *arguments, **options), feasible=feasible)

    monkeypatch.setattr(module, "build_skeleton", chained)
    monkeypatch.setattr(module, "propose", without_one)
    episode, _ = replanned(on, scene, 1.0)
    assert episode.coalition.nonzero()[:, 1].tolist() == [3] and episode.target[0].max() == 0


def test_within_the_support_others_keep_their_nominal_energy():
    on = synthesizer(control=ControlSettings(feasibility=0.0))
    episode, _ = replanned(on, scenes(3).scenes, 2.0, times=2)
    assert (episode.kl[~episode.adversaries] == 0).all() and (episode.kl[episode.adversaries] > 0).all()


def test_the_support_of_the_start_is_kept_where_it_is_not_reselected():
    on, scene = synthesizer(reselect=0), scenes(3).scenes
    first, _ = replanned(on, scene, 2.0)
    later, _ = replanned(on, scene, 2.0, times=4)
    assert torch.equal(first.coalition, later.coalition) and torch.equal(later.adversaries, later.coalition)
    assert later.replans.tolist() == [4, 4, 4]


def test_of_several_samples_the_cheapest_is_kept_for_each_scene():
    scene = scenes(4).scenes
    one, many = synthesizer(samples=1), synthesizer(samples=4)
    world = world_of(scene)
    costs = []
    for on in (one, many):
        episode = begin(on, scene, 0.0)
        kept = []
        cost = Synthesizer._cost

        def spy(self, *arguments, cost=cost, kept=kept):
            kept.append(cost(self, *arguments))
            return kept[-1]

        on._cost = spy.__get__(on)
        on.settings = replace(on.settings, samples=4)
        on.replan(episode, world, EGO.plan(world))
        costs.append(torch.stack(kept))
    assert costs[0].shape == (4, 4) and torch.equal(costs[0], costs[1])
    assert (costs[0].min(0).values <= costs[0][0]).all()


def test_plans_continue_where_the_last_one_was_left():
    on, scene = synthesizer(), scenes(2).scenes
    episode, plan = replanned(on, scene, 0.0)
    end = plan.states()[:, 1:5, 4]
    world = replace(world_of(scene), step=torch.tensor([5, 5]))
    states = world.states.clone()
    states[:, :ROWS] = plan.states()[:, :, 4]
    _, following = on.replan(episode, replace(world, states=states), EGO.plan(replace(world, states=states)))
    step = following.states()[:, 1:5, 0] - end
    torch.testing.assert_close(step[..., 0], 0.1 * end[..., 3], rtol=0, atol=0.1)
    assert step[..., 3].abs().max() < 0.6


@pytest.mark.parametrize("free_space", [False, True])
def test_the_ego_is_seen_as_it_drives_and_free_vehicles_beside_their_route(free_space):
    scene = curved_scenes()
    on = Synthesizer(small_prior(free_space=free_space))
    world = world_of(scene)
    turning = scene["logged"][:, 1 : HORIZON + 1, 0].clone()
    turning[..., 2] = 0.2 * 0.1 * torch.arange(1, HORIZON + 1)  # the ego turns at 0.2 rad/s
    episode = on.begin(scene, torch.tensor([0]), torch.zeros(1))
    episode = replace(episode, state=episode.state.map(lambda value: value + 0.25))
    placed = on._placed(episode, world, turning)
    assert placed.kappa[0, 0].item() == pytest.approx(0.2 / 8.0, rel=1e-3)
    start = on.prior.start(scene, episode.routed.route)[1]
    torch.testing.assert_close(placed.d[:, 0], start.d[:, 0], rtol=0, atol=1e-3)
    kept = placed.d[:, 1:6] - start.d[:, 1:6]
    torch.testing.assert_close(kept, torch.full_like(kept, 0.0 if free_space else 0.25), rtol=0, atol=1e-3)
    torch.testing.assert_close(placed.x[:, 1:], episode.state.x[:, 1:])


def test_who_leaves_its_lane_returns_to_it_once_it_meets_nobody():
    on, scene = synthesizer(reselect=0), scenes(3).scenes
    world = world_of(scene)
    lanes = begin(on, scene, 2.0)
    episode, _ = on.replan(lanes, world, EGO.plan(world))
    assert episode.leaves.any() and not (episode.leaves & ~episode.coalition).any()
    moved = (episode.routed.points != lanes.routed.points).flatten(2).any(-1)
    assert torch.equal(moved, episode.leaves)
    nobody = replace(episode, coalition=episode.coalition & False, target=episode.target * 0 - 1)
    calm, _ = on.replan(nobody, world, EGO.plan(world))
    assert not calm.leaves.any() and torch.equal(calm.routed.points, lanes.routed.points)


def test_a_listener_hears_of_every_choice_and_changes_nothing():
    heard, scene = [], scenes(3).scenes
    for eta in (0.0, 2.0):
        silent, listened = synthesizer(), synthesizer()
        listened.on_selection = heard.append
        episode, plan = replanned(listened, scene, eta, [5, 6, 7])
        assert torch.equal(plan.states(), replanned(silent, scene, eta, [5, 6, 7])[1].states())
        assert bool(heard) == (eta > 0)
    (chosen,) = heard
    assert chosen.seed.tolist() == [5, 6, 7] and chosen.step.tolist() == [0, 0, 0]
    used = chosen.coalition.shape[1]
    assert torch.equal(chosen.coalition, episode.coalition[:, :used]) and chosen.weights.shape[2:] == (used, used)
    assert torch.equal(chosen.target, episode.target[:, :used]) and not (chosen.coalition & ~chosen.feasible).any()
    assert chosen.reference.shape[:3] == chosen.weights.shape[:3] and chosen.moments[0, 0] == pytest.approx(0.1)


@pytest.mark.parametrize("sampler", ["ddim", "dpm_solver_pp", "euler_maruyama"])
def test_the_transport_budget_of_a_rollout_holds_and_is_used(sampler):
    scene = scenes(3).scenes
    settings = SamplerSettings(sampler=sampler, steps=4)

    def spent(budget):
        on = Synthesizer(
            small_prior(0, sampler=settings), SynthesizerSettings(control=ControlSettings(transport_budget=budget))
        )
        episode, plan = replanned(on, scene, 2.0, times=3)
        return episode.kl.sum(-1), plan

    free, _ = spent(None)
    limit = float(free.min()) / 3
    assert limit > 0
    capped, _ = spent(limit)
    assert (capped <= 1.001 * limit).all() and (capped > 0.99 * limit).all()
    none, _ = spent(0.0)
    assert (none == 0).all()
    roomy, plan = spent(2 * float(free.max()))
    torch.testing.assert_close(roomy, free, rtol=1e-3, atol=1e-4)
