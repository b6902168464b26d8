"""Prospects: gaps of short manoeuvres are those of the boxes but for rounded corners;
others go on as they do."""

import pytest
import shapely
import torch

from e2rl.sim.dynamics import Arc, along_arc
from e2rl.sim.env import DrivingEnv, SimSettings
from e2rl.sim.prospects import TIMES, Others, gaps, time_to_contact, travelled
from tests.synthetic import make_scenes

CAR = (4.6, 2.0)


def others(*cars):
    """Others of one ego: cars (x, y, heading, speed, acceleration, path curvature)."""
    cars = [(*car, 0.0)[:6] for car in cars]
    x, y, heading, speed, accel, curvature = torch.tensor(cars, dtype=torch.float32).T[
        :, None
    ]
    half = (torch.tensor(CAR) / 2)[None, :, None].expand(1, 2, len(cars))
    direction = torch.stack([heading.cos(), heading.sin()], 1)
    there = torch.ones(1, len(cars), dtype=torch.bool)
    return Others(
        torch.stack([x, y], 1),
        direction,
        half_size=half,
        speed=speed,
        arc=Arc(accel, curvature),
        present=there,
    )


def straight_on(speed, accel=0.0):
    """One manoeuvre of an ego that drives straight on: x, y, cosine, sine [4, 1, T, 1]."""
    way = travelled(torch.tensor(speed), torch.tensor(accel), time=torch.tensor(TIMES))
    none = torch.zeros_like(way)
    return torch.stack([way, none, none + 1, none])[:, None, :, None]


def test_the_way_is_driven_to_the_halt_and_never_backwards():
    speed = torch.tensor([10.0, 10.0, 3.0])
    accel = torch.tensor([2.0, -5.0, -6.0])
    way = travelled(speed, accel, time=torch.tensor(4.0))
    assert way.tolist() == pytest.approx([40 + 16, 10**2 / 10, 3**2 / 12])


def polygon(x, y, heading):
    box = shapely.box(-CAR[0] / 2, -CAR[1] / 2, CAR[0] / 2, CAR[1] / 2)
    return shapely.affinity.translate(
        shapely.affinity.rotate(box, heading, origin=(0, 0), use_radians=True), x, y
    )


@pytest.mark.parametrize("seed", range(5))
def test_gaps_are_those_of_the_boxes_but_for_rounded_corners(seed):
    generator = torch.Generator().manual_seed(seed)
    poses = torch.rand(40, 3, generator=generator) * torch.tensor(
        [30.0, 16.0, 6.3]
    ) - torch.tensor([5.0, 8.0, 0.0])
    ego = straight_on(9.0)
    rounded = 2 * (2**0.5 - 1) * CAR[1] / 2
    for pose in poses.tolist():
        found = gaps(ego, torch.tensor([CAR]), others=others((*pose, 0.0, 0.0)))[
            0, :, 0
        ]
        boxes = [polygon(x, 0.0, heading=0.0) for x in ego[0, 0, :, 0].tolist()]
        exact = torch.tensor(
            [box.distance(polygon(*pose)) for box in boxes], dtype=torch.float32
        )
        apart = exact > 0
        assert (found[apart] >= exact[apart] - 1e-3).all() and (
            found[apart] <= exact[apart] + rounded + 0.1
        ).all()


def test_others_keep_their_acceleration_for_a_second_then_their_speed():
    ego = straight_on(0.0)
    size = torch.tensor([CAR])
    found = gaps(ego, size, others=others((20.0, 0.0, torch.pi, 5.0, -2.0)))[0, :, 0]
    way = [5 * t - t**2 if t <= 1 else 4 + 3 * (t - 1) for t in TIMES]
    assert found.tolist() == pytest.approx(
        [20 - driven - CAR[0] for driven in way], abs=0.05
    )


def test_who_turns_goes_on_turning():
    """The gap to a car in a curve is the one to the same car placed where its arc
    leads."""
    ego = straight_on(0.0)
    size = torch.tensor([CAR])
    pose = (12.0, -14.0, 1.4)
    speed = 6.0
    curvature = 0.06
    found = gaps(ego, size, others=others((*pose, speed, 0.0, curvature)))[0, :, 0]
    arc = Arc(torch.tensor(0.0), torch.tensor(curvature))
    path, _ = along_arc(
        torch.tensor([*pose, speed]), arc, times=torch.tensor(TIMES[:4])
    )
    standing = [
        gaps(ego, size, others=others((*state[:3], 0.0, 0.0)))[0, 0, 0]
        for state in path.tolist()
    ]
    torch.testing.assert_close(found[:4], torch.stack(standing))


@pytest.mark.parametrize(
    ("gap", "expected"), [(8.0, 1.0), (22.0, 2.6), (80.0, TIMES[0] + TIMES[-1])]
)
def test_the_time_to_contact_is_that_of_going_on_behind_a_standing_car(gap, expected):
    """The first moment looked at by which braking at 1 m/s^2 has used up the gap;
    swerving does not count."""
    cars = [(0.0, 0, 10.0), (gap + 4.5, 0, 0.0)]
    observation = DrivingEnv(
        make_scenes(1, vehicles=cars, num_vrus=0), SimSettings(), 1
    ).reset()["observation"]
    assert time_to_contact(observation).item() == pytest.approx(expected, abs=1e-3)
