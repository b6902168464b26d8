"""Prospects: gaps of short manoeuvres are those of the boxes but for rounded corners;
others go on as they do."""

import math

import pytest
import shapely
import torch

from e2rl.sim import dynamics
from e2rl.sim.env import DrivingEnv
from e2rl.sim.prospects import (
    TIMES,
    Arc,
    Others,
    arc_places,
    gaps,
    manoeuvres_on,
    time_to_contact,
    travelled,
)
from e2rl.sim.settings import SimSettings
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
    place = torch.ones(1, len(cars), dtype=torch.bool)
    return Others(
        torch.stack([x, y], 1),
        direction,
        half_size=half,
        speed=speed,
        arc=Arc(accel, curvature),
        present=place,
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
        shapely.affinity.rotate(
            box,
            heading,
            origin=(0, 0),
            use_radians=True,
        ),
        x,
        y,
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
        result = gaps(ego, torch.tensor([CAR]), others=others((*pose, 0.0, 0.0)))[
            0, :, 0
        ]
        boxes = [polygon(x, 0.0, heading=0.0) for x in ego[0, 0, :, 0].tolist()]
        exact = torch.tensor(
            [box.distance(polygon(*pose)) for box in boxes], dtype=torch.float32
        )
        apart = exact > 0
        assert (result[apart] >= exact[apart] - 1e-3).all()
        assert (result[apart] <= exact[apart] + rounded + 0.1).all()


def test_others_keep_their_acceleration_for_a_second_then_their_speed():
    ego = straight_on(0.0)
    size = torch.tensor([CAR])
    result = gaps(ego, size, others=others((20.0, 0.0, torch.pi, 5.0, -2.0)))[0, :, 0]
    way = [5 * t - t**2 if t <= 1 else 4 + 3 * (t - 1) for t in TIMES]
    assert result.tolist() == pytest.approx(
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
    result = gaps(ego, size, others=others((*pose, speed, 0.0, curvature)))[0, :, 0]
    x, y, heading = pose
    standing = []
    for time in TIMES[:4]:
        turn = curvature * speed * time
        middle = heading + turn / 2
        chord = 2 / curvature * math.sin(turn / 2)
        place = (x + chord * math.cos(middle), y + chord * math.sin(middle))
        car = others((*place, heading + turn, 0.0, 0.0))
        standing.append(gaps(ego, size, others=car)[0, 0, 0])
    torch.testing.assert_close(
        result[:4],
        torch.stack(standing),
        rtol=0,
        atol=1e-4,
    )


@pytest.mark.parametrize(
    ("gap", "expected"), [(8.0, 1.0), (22.0, 2.6), (80.0, TIMES[0] + TIMES[-1])]
)
def test_the_time_to_contact_is_that_of_going_on_behind_a_standing_car(gap, expected):
    """The first moment looked at by which braking at 1 m/s^2 has used up the gap;
    swerving does not count."""
    cars = [(0.0, 0, 10.0), (gap + 4.5, 0, 0.0)]
    observation = DrivingEnv(
        make_scenes(
            1,
            vehicles=cars,
            num_vrus=0,
        ),
        SimSettings(),
        1,
    ).reset()["observation"]
    assert time_to_contact(observation).item() == pytest.approx(expected, abs=1e-3)


def test_an_arc_is_the_unicycle_s_motion_while_it_lasts():
    """Braking by 3 m/s^2 for a second, in a bend of 25 m; a bend that goes on for 2 s."""
    arc = Arc(torch.tensor(-3.0), torch.tensor(0.04))
    steps = torch.arange(1, 11)
    ahead, left, turn = arc_places(torch.tensor(9.0), arc, 0.1 * steps)
    speed = 9.0 - 0.3 * torch.arange(11)
    actions = torch.stack(
        [torch.full((10,), -3.0), 0.04 * (speed[1:] + speed[:-1]) / 2], -1
    )
    states = dynamics.rollout(torch.tensor([0.0, 0.0, 0.0, 9.0]), actions)
    torch.testing.assert_close(
        torch.stack([ahead, left, turn], -1),
        states[:, :3],
        rtol=0,
        atol=0.01,
    )


def test_an_acceleration_lasts_a_second_and_a_bend_two():
    """From 10 m/s by 2 m/s^2: 11 m, then 12 m/s; 20 m of a bend of 20 m, then straight."""
    arc = Arc(torch.tensor(2.0), torch.tensor(0.05))
    times = torch.tensor([1.0, 2.0, 3.0, 4.0])
    ahead, left, turn = arc_places(torch.tensor(10.0), arc, times)
    torch.testing.assert_close(turn, torch.tensor([0.55, 1.0, 1.0, 1.0]))
    last = torch.hypot(ahead.diff()[-1], left.diff()[-1])
    assert last.item() == pytest.approx(12.0, abs=1e-4)


def test_nobody_drives_backwards_after_a_halt():
    arc = Arc(torch.tensor(-4.0), torch.tensor(0.0))
    ahead, _, _ = arc_places(torch.tensor(2.0), arc, torch.tensor([0.5, 1.0, 3.0]))
    torch.testing.assert_close(ahead, torch.tensor([0.5, 0.5, 0.5]))


@pytest.mark.parametrize("accel", [-2.0, 0.0, 1.5])
def test_an_arc_in_reverse_is_the_arc_forwards_of_who_looks_the_other_way(accel):
    times = 0.1 * torch.arange(1, 33)
    back = arc_places(
        torch.tensor(-4.0), Arc(torch.tensor(-accel), torch.tensor(0.05)), times
    )
    ahead = arc_places(
        torch.tensor(4.0), Arc(torch.tensor(accel), torch.tensor(-0.05)), times
    )
    torch.testing.assert_close(back[0], -ahead[0])
    torch.testing.assert_close(back[1], -ahead[1])
    torch.testing.assert_close(back[2], ahead[2])


def test_gaps_are_looked_at_for_three_seconds():
    assert TIMES == (0.5, 1.0, 1.5, 2.0, 2.6, 3.2)


def test_an_offset_is_reached_smoothly_in_a_second_and_a_half():
    """A third of the time: 3 / 9 - 2 / 27 of the way."""
    fraction = manoeuvres_on(torch.device("cpu")).fraction
    expected = torch.tensor([7 / 27, 20 / 27, 1.0, 1.0, 1.0, 1.0])
    torch.testing.assert_close(fraction, expected)


def standing_beside(gap):
    """Prospects of an ego that stands, `gap` m beside a car that stands."""
    scenes = make_scenes(
        1,
        vehicles=[(0.0, 0, 0.0), (0.0, 1, 0.0)],
        num_vrus=0,
    )
    scene = scenes.scenes
    width = scene["size"][0, 0, 1].item()
    for key in ("start", "logged"):
        scene[key][..., 1, 1] = -(gap + width)
    observation = DrivingEnv(scenes, SimSettings(), 1).reset()["observation"][0]
    return observation[-30:].view(2, 5, 3)


@pytest.mark.parametrize(("gap", "seen"), [(1.5, 0.5), (2.7, 0.9), (3.5, 1.0)])
def test_gaps_are_told_apart_up_to_three_metres(gap, seen):
    """Of braking in the lane."""
    assert standing_beside(gap)[0, 0, 1].item() == pytest.approx(seen, abs=0.01)


@pytest.mark.parametrize(("gap", "contact"), [(0.18, True), (0.22, False)])
def test_a_gap_below_two_tenths_of_a_metre_is_none(gap, contact):
    first = standing_beside(gap)[1, 0, 1].item()
    assert first == pytest.approx(0.5 / 3.7 if contact else 1.0)
