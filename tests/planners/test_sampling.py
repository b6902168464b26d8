"""Sampling planner: no way out, bounds, mirrors; its parts."""

import math
from itertools import product

import pytest
import torch

from e2rl.planners.candidates import drive, speed_profiles, steer
from e2rl.planners.ego import PLAN_STEPS
from e2rl.planners.path import MissionPath
from e2rl.planners.sampling import PROFILES, SHIFTS, SamplingEgo
from e2rl.planners.scoring import (
    MOVING,
    Forecast,
    Pairs,
    contact_cost,
    discomfort,
    forecast,
    nearest,
    pair_costs,
)
from e2rl.scenes.boxes import separation
from e2rl.scenes.recording import DT
from e2rl.sim import dynamics
from tests.planners.planners import world_of, worlds
from tests.synthetic import LANE_WIDTH, make_scenes

TIMES = torch.arange(1, 21) * 0.2


def test_boxed_in_it_is_never_worse_than_hard_braking():
    """Cars on both sides and one standing ahead, too near to stop: the plan hits no
    harder than braking would."""
    box = [(0.0, 0, 12.0), (11.0, 0, 0.0), (0.0, 1, 12.0), (-25.0, 0, 12.0)]
    _, world = world_of(
        vehicles=box,
        num_vrus=0,
    )
    plan = SamplingEgo().plan(world)[0]
    size = world.scene["size"][0, 0]
    wall = world.states[0, 1]
    braking = dynamics.rollout(
        world.states[0, 0], torch.tensor([-8.0, 0.0]).expand(PLAN_STEPS, 2)
    )

    def impact(states):
        hit = (
            separation(
                states,
                size,
                second=wall,
                second_size=size,
            )
            < 0
        ).nonzero()
        return states[hit[0, 0], 3].item() if len(hit) else 0.0

    assert impact(braking) > 1
    assert impact(plan) <= impact(braking) + 0.5


def test_candidates_obey_the_simulator_s_bounds():
    scenes = make_scenes(2, num_vehicles=6)
    scenes.scenes["start"][1, 0, 1:3] = torch.tensor([1.5, 0.6])
    _, world = worlds(scenes)
    candidates = SamplingEgo().candidates(world)
    count = len(PROFILES) * (2 * len(SHIFTS) + 1)
    assert candidates.states.shape == (2, count, PLAN_STEPS, 4)
    assert torch.isfinite(candidates.states).all()
    start = world.states[:, :1].expand(-1, count, -1)[:, :, None]
    states = torch.cat([start, candidates.states], 2)
    actions = dynamics.inverse(states)
    assert (actions[..., 0] > -8 - 1e-3).all()
    assert (actions[..., 0] < 5 + 1e-3).all()
    mean = (states[..., 1:, 3] + states[..., :-1, 3]) / 2
    assert (
        actions[..., 1].abs()
        <= torch.clamp(dynamics.yaw_rate_bound(mean), max=1.6) + 1e-3
    ).all()
    assert (
        torch.hypot(actions[..., 0], actions[..., 1] * mean)
        < dynamics.MAX_LATERAL + 0.05
    ).all()
    torch.testing.assert_close(
        dynamics.rollout(start[:, :, 0], actions),
        candidates.states,
        atol=2e-3,
        rtol=0,
    )


def test_moves_lead_beside_the_mission():
    _, world = world_of(
        num_vehicles=1,
        num_vrus=0,
        limit=0.0,
    )
    candidates = SamplingEgo().candidates(world)
    cruise = PROFILES.index((0.0, 0.0)) * (2 * len(SHIFTS) + 1)
    side = candidates.states[0, cruise : cruise + len(SHIFTS), -1, 1]
    torch.testing.assert_close(
        side,
        torch.tensor(SHIFTS),
        atol=0.25,
        rtol=0,
    )


@pytest.mark.parametrize("beside", [1.0, -1.0])
def test_a_mirrored_scene_gets_the_mirrored_plan(beside):
    """Somebody comes over from one side; the road is as wide on both."""
    plans = []
    for sign in (beside, -beside):
        scenes = make_scenes(
            1,
            vehicles=[(0.0, 0, 10.0), (3.0, 0, 10.0)],
            num_vrus=0,
        )
        start = scenes.scenes["start"]
        start[0, 1, 1:3] = torch.tensor([2.6 * sign, -0.12 * sign])
        scenes.scenes["field"].fill_(-10.0)
        plans.append(
            SamplingEgo().plan(worlds(scenes)[1]) * torch.tensor([1.0, sign, sign, 1.0])
        )
    torch.testing.assert_close(
        plans[0],
        plans[1],
        atol=1e-3,
        rtol=0,
    )
    assert plans[0][..., 1].abs().max() > 0.3


def test_speed_profiles_keep_the_caps():
    caps = (torch.tensor([[8.0]]).expand(1, 100)) ** 2
    speed = speed_profiles(
        torch.tensor([10.0]),
        torch.tensor([[0.0, 0.0], [5.0, 5.0], [-8.0, -8.0]]),
        caps=caps,
        braking=4.0,
    )
    assert speed.shape == (1, 3, PLAN_STEPS + 1)
    assert (speed[..., 0] == 10).all()
    assert torch.allclose(speed[0, :2, 10:], torch.tensor(8.0))
    assert (speed[0, 2, 15:] == 0).all()
    assert (speed.diff(dim=-1) / DT > -8.001).all()
    assert (speed[0, :2].diff(dim=-1) / DT > -4.001).all()


def test_steering_catches_up_with_what_a_bound_withheld():
    aimed = torch.tensor([0.3, 0.3, 0.3, 0.3])
    turns = steer(torch.tensor(0.0), aimed, bound=torch.tensor(0.1).expand(4))
    torch.testing.assert_close(turns, torch.tensor([0.1, 0.1, 0.1, 0.0]))


def test_a_curve_is_driven_along_its_mission():
    scenes = make_scenes(
        1,
        num_vehicles=1,
        num_vrus=0,
    )
    angle = torch.arange(150) * 2.0 / 40
    scenes.scenes["route_points"][0, 0, 0] = torch.stack(
        [40 * angle.sin() - 20, 40 * (1 - angle.cos())], -1
    )
    scenes.scenes["start"][0, 0] = torch.tensor([-20.0, 0.0, 0.0, 8.0])
    _, world = worlds(scenes)
    path = MissionPath(world)
    steady = torch.full((1, 1, PLAN_STEPS + 1), 8.0)
    candidates = drive(
        world.states[:, 0],
        path,
        speed=steady,
        shift=torch.zeros(1, 1),
        time=torch.ones(1),
    )
    driven = candidates.states[0, 0]
    radius = (driven[:, :2] - torch.tensor([-20.0, 40.0])).norm(dim=-1)
    assert (radius - 40).abs().max() < 0.5
    assert driven[-1, 2] > 0.9


def test_forecasts_of_constant_acceleration_and_turn():
    scenes = make_scenes(
        1,
        vehicles=[(0.0, 0, 10.0), (20.0, 0, 10.0), (40.0, 1, 10.0)],
        num_vrus=0,
    )
    scenes.scenes["start_accel"][0, 1], scenes.scenes["start_yaw_rate"][0, 2] = (
        -8.0,
        0.5,
    )
    _, world = worlds(scenes)
    agents, present = nearest(world, 5)
    assert present.tolist() == [[True, True, False, False, False]]
    assert agents[0, :2].tolist() == [1, 2]
    states = forecast(
        world,
        (agents, present),
        times=TIMES,
        hold=1.0,
        turn=2.0,
    ).states[0]
    expected = (
        20 + 10 * TIMES - 4 * TIMES.clamp(max=1) ** 2 - 8 * (TIMES - 1).clamp(min=0)
    )
    torch.testing.assert_close(
        states[0, :, 0],
        expected,
        atol=1e-3,
        rtol=0,
    )
    torch.testing.assert_close(states[0, :, 3], 10 - 8 * TIMES.clamp(max=1))
    early = TIMES < 2
    torch.testing.assert_close(
        states[1, early, 0],
        40 + 20 * (0.5 * TIMES[early]).sin(),
        atol=0.02,
        rtol=0,
    )
    torch.testing.assert_close(
        states[1, early, 1],
        LANE_WIDTH + 20 * (1 - (0.5 * TIMES[early]).cos()),
        atol=0.02,
        rtol=0,
    )
    assert torch.allclose(states[1, -1, 2], torch.tensor(1.0), atol=1e-3)


def compared(x, y, ego_speed, *, other_speed=0.0, length=4.0):
    """Cost, and time of the contact, of a vehicle of so many metres x 2 m beside or
    ahead of another, by the file's weights: 200 for a contact, 30 for nearness, 1.5 s
    of headway; margin 1 m."""
    size = torch.tensor([[length, 2.0]])
    pairs = Pairs(
        torch.zeros(1, dtype=torch.int64),
        ego_size=size,
        states=torch.tensor([[[x, y, 0.0, other_speed]]]),
        size=size,
        margin=torch.ones(1, 1),
    )
    pose = torch.tensor([0.0, 0.0, 1.0, 0.0, ego_speed])[:, None, None, None]
    prices = SamplingEgo().prices(size)
    costs, contact = pair_costs(pose, pairs, torch.zeros(1), prices)
    return costs.item(), contact.item()


def cost_of(*place, **vehicle):
    """The cost of `compared`."""
    return compared(*place, **vehicle)[0]


def test_no_candidate_ends_at_a_contact_from_behind():
    assert compared(3.9, 0.0, 10.0)[1] == 0
    assert compared(-3.9, 0.0, 5.0, other_speed=10.0)[1] == torch.inf


def test_candidates_cost_their_worst_moment_with_each_agent_until_they_touch_one():
    """Summed over agents by an oracle that loops over them, candidates and moments."""
    torch.manual_seed(2)
    scale = torch.tensor([6.0, 3.0, 0.5, 8.0])[:, None, None, None]
    ego = torch.randn(4, 5, 2, 9) * scale
    ego[3] = ego[3].abs()
    size = torch.tensor([[4.5, 2.0], [4.0, 1.8]])
    states = torch.randn(2, 3, 5, 4) * scale.flatten() + torch.tensor([4.0, 0, 0, 0])
    sizes = torch.rand(2, 3, 2) + torch.tensor([4.0, 1.5])
    present = torch.tensor([[True, True, True], [True, False, True]])
    others = Forecast(states, sizes, present=present)
    times = 0.4 * torch.arange(1, 6.0)
    prices = SamplingEgo().prices(size)
    cost = contact_cost(ego, size, others, times=times, prices=prices)
    for b, c in product(range(2), range(9)):
        costs = torch.zeros(3, 5)
        ends = [torch.inf]
        for m, t in product(present[b].nonzero()[:, 0].tolist(), range(5)):
            x, y, heading, speed = ego[:, t, b, c]
            moving = (states[b, m, t, 3] / MOVING).clamp(max=1)
            pairs = Pairs(
                torch.zeros(1, dtype=torch.int64),
                size[b : b + 1],
                states=states[b, m, t].view(1, 1, 4),
                size=sizes[b, m][None],
                margin=(prices.margin + prices.margin_growth * times[t] * moving).view(
                    1, 1
                ),
            )
            pose = torch.stack([x, y, heading.cos(), heading.sin(), speed])
            pair, contact = pair_costs(
                pose[:, None, None, None], pairs, torch.zeros(1), prices
            )
            costs[m, t] = pair.item() * math.exp(-prices.fade * times[t])
            ends.append(times[t].item() + contact.item())
        counted = costs * (times <= min(ends) + 1e-6)
        assert cost[b, c].item() == pytest.approx(
            counted.amax(1).sum().item(), rel=1e-4
        )


def test_pair_costs_order_situations():
    """Contact costs more than nearness, faster contact more than slower, behind less
    than ahead, far nothing."""

    def cost(x, y, speed):
        return cost_of(x, y, 10.0, other_speed=speed, length=4.5)

    assert cost(4.0, 0.0, 0.0) > cost(4.0, 0.0, 8.0) > cost(5.0, 0.0, 8.0) > 0
    assert cost(4.0, 0.0, 8.0) > cost(-4.0, 0.0, 12.0) > 0
    assert cost(10.0, 0.0, 0.0) > cost(10.0, 0.0, 8.0) == 0
    assert cost(0.0, 2.2, 10.0) > cost(0.0, 2.6, 10.0) > cost(0.0, 3.1, 10.0) == 0


@pytest.mark.parametrize(
    ("speed", "severity"), [(10.0, 2.0), (1.0, 1.01 * 0.75), (0.0, 0.5)]
)
def test_a_contact_costs_by_the_relative_velocity_and_half_of_who_stands(
    speed, severity
):
    """Twice as much at 10 m/s; from 2 m/s on it is the ego's own doing in full."""
    assert cost_of(3.9, 0.0, speed) == pytest.approx(200 * severity + 30, rel=1e-4)


@pytest.mark.parametrize(("gap", "touches"), [(0.14, True), (0.16, False)])
def test_a_gap_of_15_centimetres_counts_as_a_contact(gap, touches):
    assert (cost_of(0.0, 2.0 + gap, 10.0, other_speed=10.0) > 100) == touches


@pytest.mark.parametrize(("gap", "expected"), [(0.29, 26.0), (0.31, 0.0)])
def test_who_has_30_centimetres_beside_the_ego_is_not_ahead(gap, expected):
    """2 m ahead of 15 m of headway that are missing."""
    assert cost_of(6.0, 2.0 + gap, 10.0) == pytest.approx(expected, abs=1e-3)


def test_a_first_change_of_acceleration_costs_a_tenth_of_a_second_of_it():
    x = torch.arange(1, PLAN_STEPS + 1.0)[:, None, None]
    states = torch.stack([x, 0 * x, 0 * x, 0 * x + 10.0])
    assert discomfort(states, torch.tensor([[10.0], [-2.0]])).item() == pytest.approx(
        0.2
    )
