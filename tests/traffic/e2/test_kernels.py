"""Importance kernels: nothing is drawn for nothing, and what is drawn pays."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from e2rl.prior.lane_relative import (
    ACCEL_SCALE,
    BEND_SCALE,
    HORIZON,
    KNOTS,
    OFFSET_SCALE,
    SIZE,
)
from e2rl.scenes.drivable_area import CELL
from e2rl.sim.world import World
from e2rl.traffic.e2 import kernels
from e2rl.traffic.e2.choice import DRAWN
from e2rl.traffic.e2.kernels import KernelAttack, displacements, propose_kernels
from e2rl.traffic.e2.pull import nats
from tests.traffic.e2.traffic_scenes import EGO, begin, replanned, scenes, synthesizer

CPU = torch.device("cpu")


def proposed(gain, count=5):
    on = synthesizer()
    scene = scenes(3).scenes
    state = begin(on, scene, eta=2.0)
    world = World.at_start(scene)
    context = on.encode(state, world, EGO.plan(world))
    mean = on.prior.estimate(context)
    plan = on.prior.decode(mean, context).states()
    attack = KernelAttack.of(
        world,
        context.active,
        ego_plan=EGO.plan(world),
        plan=plan,
        since=state.since,
        settled=state.settled,
    )
    gains = torch.full((3,), gain)
    return (
        mean,
        world,
        propose_kernels(
            attack,
            state.lane,
            points=state.routed.points,
            mean=mean,
            gain=gains,
            count=count,
        ),
    )


def test_kernels_are_shifts_of_moving_vehicles_that_gain_more_than_they_cost():
    mean, world, chosen = proposed(300.0)
    assert chosen.goal.shape == (3, 5, SIZE)
    assert (chosen.vehicle >= 0).any()
    assert (chosen.vehicle != 0).all()
    parked = world.scene["parked"]
    for b, n in (chosen.vehicle >= 0).nonzero().tolist():
        vehicle = int(chosen.vehicle[b, n])
        shift = chosen.goal[b, n] - mean[b, vehicle]
        assert not parked[b, vehicle]
        assert world.valid[b, vehicle]
        assert (displacements(CPU) - shift).abs().amax(-1).min() < 1e-5
        assert float(nats(shift)) < 300.0
    assert (proposed(0.0)[2].vehicle == -1).all(), (
        "without a gain none is worth its nats"
    )


def test_a_drawn_vehicle_is_an_adversary_that_pays_for_its_shift_and_the_choice():
    on = synthesizer(kernels={"samples": 4}, interception={"reach": 0})
    scene = scenes(4).scenes
    state, plan = replanned(on, scene, eta=3.0)
    assert state.drawn.any()
    assert torch.equal(plan.adversary, state.coalition | state.drawn)
    assert (plan.target[state.drawn] == 0).all()
    assert (plan.path_kl[state.drawn] > 0).all()
    assert (plan.path_kl[state.drawn.any(1), 0] >= math.log(3 / DRAWN)).all()
    _, single = replanned(
        synthesizer(kernels={"samples": 1}, interception={"reach": 0}), scene, eta=3.0
    )
    assert not torch.equal(single.states, plan.states)


def test_a_budget_below_the_price_of_a_choice_draws_nobody_and_none_is_the_prior():
    scene = scenes(3).scenes
    for budget, drawn in ((1.0, False), (None, True)):
        on = synthesizer(
            control={"transport_budget": budget}, interception={"reach": 0}
        )
        assert bool(replanned(on, scene, eta=3.0)[0].drawn.any()) == drawn
    _, prior = replanned(synthesizer(), scene, eta=0.0)
    _, none = replanned(synthesizer(control={"transport_budget": 0.0}), scene, eta=3.0)
    assert torch.equal(none.states, prior.states)
    assert not none.adversary.any()


def with_kernels(*vehicles, speed=8.0):
    """Which of vehicles (x, y) that drive along x have kernels, beside an ego at the
    origin that drives along x, too."""
    count = 1 + len(vehicles)
    states = torch.tensor([(0.0, 0.0), *vehicles])
    states = torch.cat(
        [states, torch.zeros(count, 1), torch.full((count, 1), speed)], 1
    )
    world = World.at_start(scenes(1).scenes)
    world = replace(world, states=states[None])
    plan = states[None, :, None].repeat(1, 1, 50, 1)
    ego_plan = plan[:, 0].clone()
    ego_plan[..., 0] = torch.linspace(0, 100, 50)
    free = torch.ones(1, count, dtype=torch.bool)
    free[:, 0] = False
    attack = KernelAttack.of(
        world,
        free,
        ego_plan=ego_plan,
        plan=plan,
        since=torch.zeros(1, count),
        settled=torch.zeros(1, count, dtype=torch.bool),
    )
    return attack.vehicle.tolist()


def test_who_has_kernels_is_within_60_m_of_the_ego_and_10_m_of_its_path():
    assert with_kernels((59.0, 0.0), (61.0, 0.0)) == [1]
    assert with_kernels((20.0, 9.5), (20.0, 11.0)) == [1]


def test_who_stands_for_all_of_its_plan_has_no_kernels():
    assert with_kernels((20.0, 0.0), speed=0.9) == []
    assert with_kernels((20.0, 0.0), speed=1.1) == [1]


def test_the_ten_nearest_have_kernels():
    row = [(5.0 + 4.0 * number, 0.0) for number in range(12)]
    assert with_kernels(*row) == list(range(1, 11))


@pytest.mark.parametrize(("apart", "drawn"), [(5.9, [1, -1]), (6.1, [1, 1])])
def test_two_kernels_of_a_vehicle_are_6_nats_apart(apart, drawn, monkeypatch):
    """One kernel is no shift, the other one of so many nats; both gain as much."""
    shift = torch.zeros(SIZE)
    shift[-1] = 1.0
    table = torch.stack([0 * shift, shift * (apart / nats(shift)) ** 0.5])
    value = torch.full((1, 3, 2), -torch.inf)
    value[0, 1] = 1.0
    monkeypatch.setattr(kernels, "displacements", lambda _: table)
    monkeypatch.setattr(kernels, "_values", lambda *_, **__: value)
    result = propose_kernels(
        SimpleNamespace(row=torch.tensor([0])),
        None,
        points=None,
        mean=torch.zeros(1, 3, SIZE),
        gain=torch.tensor([1.0]),
        count=2,
    )
    assert result.vehicle[0].tolist() == drawn


def test_a_kernel_accelerates_by_up_to_2_and_brakes_by_up_to_3_m_s2():
    accel = ACCEL_SCALE * displacements(CPU)[:, 2:KNOTS]
    expected = [-3.0, -2.0, -1.2, -0.6, 0.0, 0.6, 1.2, 2.0]
    assert accel.unique().tolist() == pytest.approx(expected)


def test_a_kernel_has_0_4_and_0_8_of_its_acceleration_at_the_first_knots():
    accel = displacements(CPU)[:, :KNOTS]
    torch.testing.assert_close(accel[:, 0], 0.4 * accel[:, 2])
    torch.testing.assert_close(accel[:, 1], 0.8 * accel[:, 2])


def test_a_kernel_shifts_to_either_side_by_up_to_a_lane_and_a_half():
    offset = OFFSET_SCALE * displacements(CPU)[:, -1]
    to_left = [0.8, 1.6, 2.5, 3.5, 4.5]
    expected = [-value for value in to_left[::-1]] + [0.0] + to_left
    assert offset.unique().tolist() == pytest.approx(expected)


def test_half_of_the_kernels_have_come_half_of_the_way_early():
    """The last two coordinates: what the offset is beside the path at half of the
    lateral horizon, in its own unit, and at the end."""
    *_, bend, offset = displacements(CPU).unbind(-1)
    early = 2 * BEND_SCALE * bend / (OFFSET_SCALE * offset)
    assert early[offset != 0].unique().tolist() == pytest.approx([0.0, 0.5])


def impossible(*, lateral=0.0, gap=100.0, inside=5.0):
    """Whether a plan is impossible that takes a lateral acceleration, passes another
    vehicle by `gap` m and comes from 5 m to `inside` m inside the road."""
    world = World.at_start(scenes(1).scenes)
    states = world.states.clone()
    states[0, :3] = torch.tensor([[0.0, 0, 0, 8], [30, 0, 0, 8], [30, gap, 0, 8]])
    scene = world.scene.clone()
    x = scene["field_origin"][0, 0] + CELL * torch.arange(scene["field"].shape[1])
    scene["field"].fill_(-5.0)
    scene["field"][:, x > 45] = -inside
    valid = torch.zeros_like(world.valid)
    valid[0, :3] = True
    world = replace(world, scene=scene, states=states, valid=valid)
    plan = states[:, :8, None].repeat(1, 1, HORIZON, 1)
    plan[:, 1:, :, 0] += 30.0
    attack = KernelAttack(
        row=torch.tensor([0]),
        vehicle=torch.tensor([1]),
        world=world,
        ego_plan=plan[:, 0],
        plan=plan,
        since=torch.zeros(1),
        settled=torch.zeros(1, dtype=torch.bool),
    )
    return attack.impossible(
        plan[:, 1:2],
        torch.full((1, 1), lateral),
        time=torch.full((1, 1), torch.inf),
    ).item()


@pytest.mark.parametrize(("lateral", "expected"), [(3.9, False), (4.1, True)])
def test_a_kernel_takes_4_m_s2_to_the_side_at_most(lateral, expected):
    assert impossible(lateral=lateral) is expected


@pytest.mark.parametrize(("gap", "expected"), [(2.3, False), (2.1, True)])
def test_a_kernel_keeps_2_2_m_between_its_centre_and_another_s(gap, expected):
    assert impossible(gap=gap) is expected


@pytest.mark.parametrize(("inside", "expected"), [(0.35, False), (0.25, True)])
def test_a_kernel_stays_0_3_m_inside_the_road(inside, expected):
    assert impossible(inside=inside) is expected
