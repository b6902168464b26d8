"""Lane-graph planner: which profile it takes, hazards in closed form."""

import math

import pytest
import torch

from e2rl.planners.hazard import Prediction, circle_gap, circles, collision_hazard
from e2rl.planners.lane_graph_planner import LaneGraphEgo, matched, predict
from e2rl.planners.path import MissionPath, RoutePath
from tests.planners.planners import world_of


def test_vehicles_within_70_metres_are_looked_at():
    _, world = world_of(
        vehicles=[(0, 0, 10), (69, 0, 9), (71, 0, 9)],
        num_vrus=0,
    )
    assert len(predict(world, [1.0], 2.0).scene) == 1


@pytest.mark.parametrize(
    ("offset", "degrees", "expected"),
    [(1.9, 0, True), (2.1, 0, False), (0.0, 19, True), (0.0, 21, False)],
)
def test_a_vehicle_is_on_a_route_within_2_metres_and_20_degrees(
    offset, degrees, expected
):
    route = torch.stack([2.0 * torch.arange(50), torch.zeros(50)], -1)[None]
    state = torch.tensor([[20.0, offset, math.radians(degrees), 10.0]])
    assert matched(RoutePath(state, route)).item() == expected


def test_a_profile_turns_to_its_second_target_after_12_nodes():
    """Of 4 m/s^2, 0.8 m/s a node: from 18 m/s down to 8.4 and up again."""
    _, world = world_of(
        vehicles=[(0, 0, 18.0)],
        num_vrus=0,
        limit=0.0,
    )
    ego = LaneGraphEgo()
    profile = ego.profiles(world, MissionPath(world))[0, ego.speeds - 1]
    assert profile.argmin().item() == 12
    assert profile.min().item() == pytest.approx(18.0 - 12 * 0.8, abs=1e-4)


def test_off_its_route_it_prefers_the_shortest():
    ego = LaneGraphEgo()
    hazard = torch.tensor([[0.01, 0.0, 3.0]])
    driven = torch.tensor([[30.0, 10.0, 40.0]])
    assert ego.choose(hazard, driven, torch.tensor([True])).item() == 0
    assert ego.choose(hazard, driven, torch.tensor([False])).item() == 1
    assert ego.choose(hazard + 1, driven, torch.tensor([True])).item() == 1


def test_without_a_safe_profile_it_takes_the_least_hazardous_or_the_shortest():
    hazard = torch.tensor([[3.0, 2.0, 4.0], [3.0, 0.01, 4.0]])
    driven = torch.tensor([[0.0, 40.0, 20.0]]).expand(2, 3)
    matched = torch.tensor([True, True])
    assert LaneGraphEgo().choose(hazard, driven, matched).tolist() == [1, 1]
    assert LaneGraphEgo(brake_if_unsafe=True).choose(
        hazard, driven, matched
    ).tolist() == [0, 1]


def test_hazard_equals_its_definition():
    generator = torch.Generator().manual_seed(0)
    ego = torch.rand(2, 3, 4, 3, generator=generator).double() * 20
    poses = torch.rand(5, 4, 3, generator=generator).double() * 20
    scene = torch.tensor([0, 1, 1, 0, 1])
    size = torch.tensor([4.0, 2.0]).double().repeat(5, 1)
    ego_size = torch.tensor([4.5, 1.8]).double().repeat(2, 1)
    result = collision_hazard(
        ego,
        ego_size,
        others=Prediction(poses, size, scene=scene),
        slope=0.3,
        growth=0.02,
    )
    safe = torch.ones(2, 3).double()
    for j in range(5):
        for t in range(4):
            gap = circle_gap(
                ego[scene[j], :, t],
                ego_size[0],
                second=poses[j, t],
                second_size=size[j],
            )
            safe[scene[j]] *= torch.tanh(gap.clamp(min=0) * (0.3 + 0.02 * t)).clamp(
                min=1e-6
            )
    assert torch.allclose(result, -safe.log(), rtol=1e-3)


def test_circles_lie_in_their_box():
    x, y, radius = circles(torch.zeros(1, 3), torch.tensor([[4.0, 2.0]]))
    assert (x.abs() + radius <= 2.0 + 1e-6).all()
    assert (y.abs() + radius <= 1.0 + 1e-6).all()
    assert torch.allclose((x.abs() + radius).max(), torch.tensor(2.0))
