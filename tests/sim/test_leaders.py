"""Who leads whom: gaps between bumpers, and who does not count."""

import pytest
import torch

from e2rl.scenes.route import project
from e2rl.sim.leaders import (
    IDMParameters,
    Leaders,
    desired_gap,
    idm_acceleration,
    leaders,
)
from tests.loops import CROSSING, loop, track
from tests.prior.small import arc

FREE_GAP = 200.0
GATE_MARGIN = 0.3
LENGTH = 4.0
WIDTH = 2.0
DRIVER = IDMParameters(
    headway=1.0,
    standstill_gap=5.0,
    acceleration=1.0,
    braking=3.0,
)


def lead(agents):
    """Leaders of the first of agents (x, y, heading, speed), whose route is the x axis."""
    agents = torch.tensor(agents, dtype=torch.float32)[None]
    size = torch.tensor([LENGTH, WIDTH]).expand(1, agents.shape[1], 2)
    present = torch.ones(agents.shape[:2]).bool()
    result = leaders(
        agents[:, :1, 0] + 20.0,
        arc(
            0.0,
            0.0,
            heading=0.0,
            curvature=0.0,
        )[None, None],
        agents=agents[:, :, None],
        size=size,
        present=present,
    )
    return tuple(value[0, :, 0] for value in result)


def test_the_gap_is_between_bumpers_of_the_nearest():
    gap, speed, index = lead([(0, 0, 0, 9), (30, 0.3, 0, 6), (18, 0, 0, 7)])
    assert gap.item() == pytest.approx(18 - LENGTH)
    assert speed.item() == pytest.approx(7)
    assert index.item() == 2


def test_a_vehicle_across_the_lane_leads_with_its_side_and_stands_along_it():
    gap, speed, _ = lead([(0, 0, 0, 9), (20, 2.0, torch.pi / 2, 5)])
    assert gap.item() == pytest.approx(20 - LENGTH / 2 - WIDTH / 2, abs=1e-4)
    assert speed.item() == pytest.approx(0, abs=1e-4)


@pytest.mark.parametrize(
    ("s", "gap"), [(20.0, CROSSING[0] - 20), (100.0, CROSSING[1] - 100)]
)
def test_who_stands_at_the_crossing_of_a_loop_leads_at_the_first_passage_to_come(
    s, gap
):
    """Even where it is nearer to the other passage, or to one that lies behind."""
    for x, y in ((35.3, 0.0), (35.0, 0.3), (35.2, -0.2)):
        ego = torch.cat(
            [
                track(
                    loop(),
                    s,
                    speed=8.0,
                    steps=0,
                )[0],
                torch.tensor([x, y, 0.0, 0.0]),
            ]
        ).view(1, 2, 4)
        size = torch.tensor([LENGTH, WIDTH]).expand(1, 2, 2)
        present = torch.ones(1, 2, dtype=torch.bool)
        result = leaders(
            torch.tensor([[s]]),
            loop()[None, None],
            agents=ego[:, :, None],
            size=size,
            present=present,
        )
        assert result.index.item() == 1
        assert abs(result.gap.item() - gap + LENGTH / 2 + 1.5) < 1.0


def all_pairs(
    s,
    points,
    agents,
    size,
    present,
    d,
    free_gap,
):
    """The definition, with every agent projected onto every route."""
    length, width = size[:, : s.shape[1]].unbind(-1)
    at, offset, heading = project(agents[:, None, :, :2], points)
    turn = agents[:, None, :, 2] - heading
    cos = turn.cos()
    sin = turn.sin()
    side = (size[:, None, :, 0] * sin.abs() + size[:, None, :, 1] * cos.abs()) / 2
    along = (size[:, None, :, 0] * cos.abs() + size[:, None, :, 1] * sin.abs()) / 2
    aside = offset - torch.minimum(
        torch.maximum(offset, d[..., None].clamp(max=0)), d[..., None].clamp(min=0)
    )
    leads = (
        (aside.abs() < width[..., None] / 2 + side + GATE_MARGIN)
        & (at > s[..., None])
        & present[:, None]
    )
    leads &= (
        ~torch.eye(*leads.shape[1:], dtype=torch.bool) & present[:, : s.shape[1], None]
    )
    gap, index = torch.where(
        leads, at - s[..., None] - length[..., None] / 2 - along, free_gap
    ).min(-1)
    return (
        gap.clamp(max=free_gap),
        (agents[:, None, :, 3] * cos).gather(-1, index[..., None])[..., 0],
        index,
    )


@pytest.mark.parametrize(
    ("vehicles", "offsets", "free_gap"), [(6, True, FREE_GAP), (1, False, torch.inf)]
)
def test_pruned_pairs_are_those_that_could_not_lead(vehicles, offsets, free_gap):
    """Of all vehicles as the traffic asks, and of the ego alone without a horizon as
    the IDM ego does."""
    generator = torch.Generator().manual_seed(0)
    batch = 40 * 6 // vehicles
    count = 10
    draw = lambda *shape: torch.rand(shape, generator=generator)  # noqa: E731
    bend = 0.04 * (draw(batch, vehicles, 1) - 0.5) * torch.arange(150) + 6.28 * draw(
        batch, vehicles, 1
    )
    step = 2.0 * torch.stack([bend.cos(), bend.sin()], -1)
    points = step.cumsum(2) + 60 * (draw(batch, vehicles, 1, 2) - 0.5)
    # Around points of the first route, so that many are near one.
    place = points[:, 0, torch.randint(0, 150, (count,), generator=generator)] + 8 * (
        draw(batch, count, 2) - 0.5
    )
    agents = torch.cat(
        [place, 6.28 * draw(batch, count, 1), 10 * draw(batch, count, 1)], -1
    )
    size = torch.tensor([4.5, 2.0]).expand(batch, count, 2)
    present = draw(batch, count) < 0.8
    d = 6 * (draw(batch, vehicles) - 0.5) * offsets
    s = 60 * draw(batch, vehicles)
    expected = all_pairs(s, points, agents, size, present, d, free_gap)
    result = leaders(
        s,
        points,
        agents=agents[:, :, None],
        size=size,
        present=present,
        d=d if offsets else None,
        free_gap=free_gap,
    )
    result = Leaders(*(value[..., 0] for value in result))
    led = expected[0] < free_gap
    assert led.sum() > 40
    assert torch.equal(result.index[led], expected[2][led])
    torch.testing.assert_close(
        result.gap,
        expected[0],
        rtol=0,
        atol=1e-4,
    )
    torch.testing.assert_close(
        result.speed[led],
        expected[1][led],
        rtol=0,
        atol=1e-4,
    )
    assert torch.equal(result.speed[~led], agents[:, :vehicles, 3][~led]), (
        "nobody ahead moves as the vehicle does"
    )


def gap(speed, leader_speed):
    driver = IDMParameters(
        headway=1.5,
        standstill_gap=2.0,
        acceleration=1.0,
        braking=4.0,
    )
    return desired_gap(
        torch.tensor(speed), torch.tensor(leader_speed), driver=driver
    ).item()


def accel(
    speed,
    desired,
    gap,
    leading,
    improved,
):
    return idm_acceleration(
        torch.tensor(float(speed)),
        torch.tensor(float(desired)),
        gap=torch.tensor(float(gap)),
        leader_speed=torch.tensor(float(leading)),
        driver=DRIVER,
        improved=improved,
    ).item()


def test_standing_following_closing_and_falling_behind():
    assert gap(0.0, 0.0) == pytest.approx(2.0)
    assert gap(10.0, 10.0) == pytest.approx(2.0 + 15.0)
    assert gap(10.0, 6.0) == pytest.approx(17.0 + 10 * 4 / (2 * 2.0))
    assert gap(10.0, 30.0) == pytest.approx(2.0)


@pytest.mark.parametrize("improved", [False, True])
def test_equilibrium_gap(improved):
    """At constant speed behind a leader of the same speed: gap = (s0 + v T) / sqrt(1 -
    (v / v0)^4)."""
    gap = (5 + 6 * 1.0) / (1 - (6 / 10) ** 4) ** 0.5
    assert (
        abs(
            accel(
                6,
                10,
                gap=gap,
                leading=6,
                improved=improved,
            )
        )
        < 1e-5
    )
    assert (
        accel(
            6,
            10,
            gap=gap + 1,
            leading=6,
            improved=improved,
        )
        > 0
        > accel(
            6,
            10,
            gap=gap - 1,
            leading=6,
            improved=improved,
        )
    )


@pytest.mark.parametrize("improved", [False, True])
def test_a_free_road(improved):
    assert (
        abs(
            accel(
                10,
                10,
                gap=torch.inf,
                leading=0,
                improved=improved,
            )
        )
        < 1e-6
    )
    assert (
        accel(
            0,
            10,
            gap=torch.inf,
            leading=0,
            improved=improved,
        )
        == 1.0
    )


def test_above_the_desired_speed_only_the_improved_term_brakes_comfortably():
    assert (
        -3.0
        <= accel(
            20,
            10,
            gap=torch.inf,
            leading=0,
            improved=True,
        )
        < 0
    )
    assert accel(
        20,
        10,
        gap=torch.inf,
        leading=0,
        improved=False,
    ) == pytest.approx(1 - 2**4)


@pytest.mark.parametrize(("clearance", "leads"), [(0.28, True), (0.32, False)])
def test_who_is_within_three_tenths_of_a_metre_of_the_lane_taken_leads(
    clearance, leads
):
    gap, _, _ = lead([(0, 0, 0, 9), (30, WIDTH + clearance, 0, 6)])
    assert (gap.item() < 200.0) == leads


@pytest.mark.parametrize(("distance", "gap"), [(203.0, 199.0), (206.0, 200.0)])
def test_who_is_beyond_200_metres_leads_nobody(distance, gap):
    assert lead([(0, 0, 0, 9), (distance, 0, 0, 6)])[0].item() == pytest.approx(gap)
