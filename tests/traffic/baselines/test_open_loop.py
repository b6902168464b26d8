"""A scenario is driven as it was generated, for as long as its plan lasts, and then
made anew."""

import torch

from e2rl.prior.lane_relative import HORIZON, SIZE, decode
from e2rl.sim.world import World
from e2rl.traffic.baselines.open_loop import EVERY, later
from tests.prior.small import arc, random_state
from tests.traffic.baselines.attacks import baseline
from tests.traffic.e2.traffic_scenes import EGO, begin, executed, scenes


def test_a_plan_goes_on_where_it_was_left():
    """On straight and curved routes, the rest of a plan is what the plan was to be:
    positions within 0.3 m."""
    generator = torch.Generator().manual_seed(0)
    points = torch.stack(
        [
            arc(
                0.0,
                5.0 * i,
                heading=0.1 * i,
                curvature=0.004 * (i - 2),
            )
            for i in range(5)
        ]
    )
    start = random_state(points, generator, speed=(5.0, 12.0)).map(
        lambda value: value[None]
    )
    x = 0.5 * torch.randn(1, 5, SIZE, generator=generator)
    whole = decode(x, start, points=points[None])
    on_lane = torch.ones(1, 5, dtype=torch.bool)
    for age in (1, 4, 7):
        lane = whole.map(lambda value, at=5 * age - 1: value[..., at])
        rest = decode(
            later(
                x,
                start,
                lane=lane,
                age=torch.tensor([age]),
                has_lane=on_lane,
            ),
            lane,
            points=points[None],
        )
        certain = HORIZON - 5 * age
        torch.testing.assert_close(
            rest.v[..., :certain],
            whole.v[..., 5 * age :],
            rtol=0,
            atol=0.1,
        )
        gap = torch.hypot(
            rest.x[..., :certain] - whole.x[..., 5 * age :],
            rest.y[..., :certain] - whole.y[..., 5 * age :],
        )
        assert gap.max() < 0.3
        assert gap.mean() < 0.1


def test_after_the_plan_speed_is_kept():
    x = torch.ones(1, 2, SIZE)
    lane = random_state(
        torch.stack(
            [
                arc(
                    0,
                    0,
                    heading=0,
                    curvature=0,
                )
            ]
            * 2
        ),
        torch.Generator().manual_seed(1),
    )
    lane = lane.map(lambda value: value[None])
    rest = later(
        x,
        lane,
        lane=lane,
        age=torch.tensor([9]),
        has_lane=torch.ones(1, 2, dtype=torch.bool),
    )
    assert (rest[..., 0] == 1).all()
    assert (rest[..., 1:10] == 0).all()


def test_a_scenario_is_made_once_and_again_when_its_plan_is_over():
    on = baseline("diffscene")
    scene = scenes(2).scenes
    built = []
    scenario = on.scenario
    on.scenario = lambda replan, *rest: (
        built.append(replan.state.replans.tolist()) or scenario(replan, *rest)
    )
    state = begin(on, scene, eta=2.0)
    world = World.at_start(scene)
    for _ in range(EVERY + 1):
        plan = EGO.plan(world)
        state, traffic = on.replan(state, world, plan)
        world = executed(world, traffic, ego_plan=plan)
    assert built == [[0, 0], [EVERY, EVERY]]


def test_who_is_held_does_not_react_to_the_ego():
    on = baseline("diffscene")
    scene = scenes(2).scenes
    world = World.at_start(scene)
    plan = EGO.plan(world)
    state, first = on.replan(begin(on, scene, eta=2.0), world, plan)
    after = executed(world, first, ego_plan=plan)
    _, calm = on.replan(state, after, EGO.plan(after))
    _, other = on.replan(state, after, EGO.plan(after) + 20.0)
    assert state.held.any()
    assert torch.equal(calm.states[state.held], other.states[state.held])
    moved = first.states[state.held][:, 5:30] - calm.states[state.held][:, :25]
    assert moved[..., :2].norm(dim=-1).mean() < 0.5
