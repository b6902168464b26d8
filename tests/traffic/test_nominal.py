"""The prior as traffic: its plans are its samples and continue each other; no planner
can lie to it."""

from dataclasses import replace

import pytest
import torch

from e2rl.api import build_traffic, load_prior
from e2rl.evaluation.build import method_config
from e2rl.planners.ego import Ego, track
from e2rl.prior.lane_relative import HORIZON, SIZE
from e2rl.prior.sde import SamplerSettings
from e2rl.run.config import load_config
from e2rl.scenes.recording import DT
from e2rl.scenes.route import interpolate
from e2rl.sim.world import World
from e2rl.traffic.grouping import noise_of
from e2rl.traffic.nominal import KNOWLEDGE, NominalTraffic
from e2rl.traffic.traffic import keep_velocity
from tests.prior.small import curved_scenes, small_prior
from tests.traffic.e2.crossing import add_route, make_world
from tests.traffic.e2.traffic_scenes import (
    EGO,
    ROWS,
    begin,
    drive,
    executed,
    scenes,
    synthesizer,
)


def nominal(knowledge="predicted"):
    return NominalTraffic(small_prior(0, sampler=SamplerSettings(steps=4)), knowledge)


@pytest.mark.parametrize("knowledge", KNOWLEDGE)
def test_a_plan_is_the_prior_s_sample(knowledge):
    """Padding, which replan crops, changes the order of sums and nothing else."""
    on = nominal(knowledge)
    scene = scenes(2).scenes
    world = World.at_start(scene)
    state = begin(on, scene)
    plan = EGO.plan(world)
    after, result = on.replan(state, world, plan)
    plan = plan if knowledge == "plan" else on.predicted_ego(state, world)[0]
    routed, lane = on.prior.start(scene, state.routed.route)
    lane = on.lane_now(replace(state, routed=routed, lane=lane), world, plan)
    context = on.prior.encode(routed, lane, world, ego_plan=plan)
    noise = noise_of(
        state.seed, torch.ones(2, dtype=torch.long), shape=(4, ROWS, SIZE)
    ).transpose(0, 1)
    expected = on.prior.plan(on.prior.sample(context, noise).x0, context)
    here = scene["valid"][:, :ROWS]
    torch.testing.assert_close(
        result.states[here], expected.states()[here], rtol=1e-4, atol=1e-4
    )
    assert torch.equal(result.present[here], expected.on_map[here])
    assert not result.present[~here].any()
    assert result.adversary is None
    assert after.replans.tolist() == [1, 1]


def test_plans_continue_where_the_last_one_was_left():
    on = nominal()
    scene = scenes(2).scenes
    world = World.at_start(scene)
    state, plan = on.replan(begin(on, scene), world, EGO.plan(world))
    world = executed(world, plan, ego_plan=EGO.plan(world))
    _, following = on.replan(state, world, EGO.plan(world))
    end = plan.states[:, 1:5, 4]
    step = following.states[:, 1:5, 0] - end
    torch.testing.assert_close(step[..., 0], 0.1 * end[..., 3], rtol=0, atol=0.1)
    assert step[..., 3].abs().max() < 0.6


@pytest.mark.parametrize("free_space", [False, True])
def test_everybody_is_seen_where_it_drives_and_goes_on_as_planned(free_space):
    scene = curved_scenes()
    on = nominal()
    world = World.at_start(scene)
    turning = scene["logged"][:, 1 : HORIZON + 1, 0].clone()
    turning[..., 2] = (
        0.2 * 0.1 * torch.arange(1, HORIZON + 1)
    )  # the ego turns at 0.2 rad/s
    state = begin(on, scene)
    state.routed.has_lane[:] = not free_space
    state = replace(state, lane=state.lane.map(lambda value: value + 0.25))
    observed = on.lane_now(state, world, turning)
    assert observed.kappa[0, 0].item() == pytest.approx(0.2 / 8.0, rel=1e-3)
    start = on.prior.start(scene, state.routed.route)[1]
    torch.testing.assert_close(observed.d[:, 0], start.d[:, 0], rtol=0, atol=1e-3)
    for name in ("s", "d", "d1"):
        torch.testing.assert_close(
            getattr(observed, name)[:, 1:6],
            getattr(start, name)[:, 1:6],
            rtol=0,
            atol=1e-3,
        )
    rest = observed.d2[:, 1:6] - start.d2[:, 1:6]
    if not free_space:
        torch.testing.assert_close(rest, torch.full_like(rest, 0.25), rtol=0, atol=1e-3)
    torch.testing.assert_close(observed.a[:, 1:], state.lane.a[:, 1:])
    torch.testing.assert_close(observed.x[:, 1:], state.lane.x[:, 1:])


def test_who_reverses_at_the_start_halts_and_every_step_is_as_long_as_its_speed():
    scene_set = scenes(2, steps=40)
    scene_set.scenes["start"][:, 1, 3] = -3.0
    track = drive(scene_set, nominal(), 0.0).states[:, :, 1]
    step = track[..., :2].diff(dim=1).norm(dim=-1)
    torch.testing.assert_close(
        step, 0.1 * (track[:, 1:, 3] + track[:, :-1, 3]).abs() / 2, rtol=0, atol=1e-3
    )
    torch.testing.assert_close(
        track[:, :10, 3], (-3.0 + 0.3 * torch.arange(10)).expand(2, 10)
    )
    assert (track[:, 10:, 3] >= -1e-5).all()


class Liar(Ego):
    """Drives as EGO does, and announces a plan that leaves its own, by 50 m after 5 s."""

    def plan(self, world):
        announced = EGO.plan(world).clone()
        announced[..., 1] += torch.linspace(1.0, 50.0, announced.shape[1])
        return announced

    def act(self, world, observation, plan):
        honest = EGO.plan(world)
        return track(world.states[:, 0], world.states[:, 0], following=honest[:, 0])


class Honest(Liar):
    def plan(self, world):
        return EGO.plan(world)


def driven(ego, eta=2.0, **settings):
    method = (
        NominalTraffic(synthesizer().prior, **settings)
        if eta == 0
        else synthesizer(**settings)
    )
    return drive(scenes(2, steps=10), method, eta, ego=ego).states


@pytest.mark.parametrize("eta", [0.0, 2.0])
@pytest.mark.parametrize("knowledge", KNOWLEDGE)
def test_nonsense_in_the_announced_plan_is_believed_only_by_whoever_is_told_the_plan(
    eta, knowledge
):
    honest, lied = (driven(ego(1), eta, knowledge=knowledge) for ego in (Honest, Liar))
    assert torch.equal(honest, lied) == (knowledge == "predicted")


def test_the_prediction_begins_at_the_ego():
    on = nominal()
    scene = scenes(3).scenes
    world = World.at_start(scene)
    state = begin(synthesizer(), scene)
    result = on.predicted_ego(state, world)[0]
    assert result.shape == (3, 50, 4)
    assert result.isfinite().all()
    first = world.states[:, 0, 3] * DT
    way = (result[:, 0, :2] - world.states[:, 0, :2]).norm(dim=-1)
    torch.testing.assert_close(way, first, rtol=0.1, atol=0.05)


def fork(copies=3):
    """Scenes of an ego that may go on or turn, with others beside, behind and across
    its ways."""
    others = [
        (40.0, -40.0, 1.5708, 10.0),
        (30.0, 3.5, 0.0, 8.0),
        (-20.0, 0.0, 0.0, 10.0),
    ]
    world = make_world([(0.0, 0.0, 0.0, 10.0), *others], copies)
    add_route(world, 0, candidate=1, heading=0.6)
    return world.scene


METHODS = [
    "nominal",
    "e2",
    "e2_pursuit",
    "ccdiff",
    "ctg_adv",
    "strive",
    "safe_sim_opt",
    "diffscene",
    "cat",
]


def plans_beside(method, scene, times=2):
    """Plans of all but the ego, which keeps its velocity."""
    state = begin(method, scene, eta=2.0 * method.adversarial)
    world = World.at_start(scene)
    result = []
    for _ in range(times):
        certain = keep_velocity(world.states[:, 0])
        state, plan = method.replan(state, world, certain)
        result.append(plan.states[:, 1:])
        world = executed(world, plan, ego_plan=certain)
    return torch.stack(result)


@pytest.mark.parametrize("name", METHODS)
def test_who_is_not_told_the_plan_does_not_know_the_mission(name):
    """Of two egos that drive alike and mean to go elsewhere traffic makes the same,
    where one's way is a candidate, and where it is the recorded path, which nobody
    knows."""
    scene = fork(1)
    turns = scene.clone()
    recorded = scene.clone()
    turns["route_log"][:, 0] = 1
    recorded["route_log"][:, 0] = 2
    recorded["route_points"][:, 0, 2] += torch.linspace(
        0, 30, scene["route_points"].shape[3]
    )[:, None]
    recorded["route_valid"][:, 0, 2] = recorded["route_recorded"][:, 0, 2] = True
    group = method_config(load_config("evaluate", []), name)
    group.knowledge = "predicted"
    if name == "strive":
        group.iterations = 5
    method = build_traffic(group, small_prior(0, sampler=SamplerSettings(steps=2)))
    assert torch.equal(plans_beside(method, scene), plans_beside(method, turns))
    assert torch.equal(plans_beside(method, scene), plans_beside(method, recorded))


def test_the_ego_is_expected_where_it_turns():
    """Two ways part behind it: it is expected on that on which it drives, whatever its
    mission is."""
    method = NominalTraffic(load_prior(), "predicted")
    scene = fork()
    assert scene["route_valid"][:, 0, :2].all()
    for way in (0, 1):
        along = interpolate(scene["route_points"][:, 0, way], torch.full((3, 1), 45.0))
        world = World.at_start(scene)
        states = world.states.clone()
        states[:, 0, :2], states[:, 0, 2] = along[0][:, 0], along[1][:, 0]
        expected = method.as_seen(replace(world, states=states)).scene["route_log"][
            :, 0
        ]
        assert (expected == way).all()
