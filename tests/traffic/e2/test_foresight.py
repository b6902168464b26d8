"""The predicted verdict: worth something is what worse drivers run into and the
competent one does not."""

import pytest
import torch

from e2rl.metrics.drivers import HumanDriver
from e2rl.sim.world import World
from e2rl.traffic.e2.foresight import foresee, time_before
from tests.synthetic import make_scenes

STEPS = 51
SPEED = 10.0
SIZE = torch.tensor([[4.0, 2.0]])


def standing(gap, aside=0.0, speed=SPEED):
    """Foresight of a vehicle that stands from now on `gap` m ahead of the ego's front;
    the ego keeps its speed."""
    path = torch.zeros(1, STEPS, 4)
    path[0, :, 0] = speed * 0.1 * torch.arange(STEPS)
    path[..., 3] = speed
    tracks = torch.zeros(1, 1, STEPS, 4)
    tracks[..., 0], tracks[..., 1] = gap + 4.0, aside
    return lambda since=-1.0, settled=False: foresee(
        path,
        SIZE,
        tracks=tracks,
        sizes=SIZE,
        since=torch.tensor([since]),
        settled=torch.tensor([settled]),
    )


def test_the_competent_driver_prevents_what_is_farther_than_its_stopping_gap():
    need = float(HumanDriver().stopping_gap(torch.tensor(SPEED)))
    for gap in (0.8 * need, 1.15 * need):
        assert bool(standing(gap)().prevented) == (gap > need)


def test_worth_is_highest_just_beyond_what_the_competent_driver_needs():
    need = float(HumanDriver().stopping_gap(torch.tensor(SPEED)))
    near, middle, far = (
        float(standing(gap)().worth) for gap in (1.1 * need, 1.5 * need, 40.0)
    )
    assert 0.5 < near < 1
    assert near > middle > far > 0
    assert float(standing(0.8 * need)().worth) == 0, "nobody could prevent it"
    assert float(standing(40.0, aside=4.0)().worth) == 0, "nobody is in the way"


def test_what_has_begun_need_not_be_prevented_again():
    need = float(HumanDriver().stopping_gap(torch.tensor(SPEED)))
    plan = standing(0.8 * need)
    assert float(plan(settled=True).worth) > 0.5
    assert bool(plan(since=0.7).prevented), (
        "a driver that has begun to react 0.7 s ago still stops"
    )


def mirrored(states):
    """The same motion of a vehicle that looks the other way."""
    turned = states.clone()
    turned[..., 2] += torch.pi
    turned[..., 3] *= -1
    return turned


def test_who_reverses_is_foreseen_as_the_same_motion_forwards():
    """From 10 m/s, braking by 1 m/s^2, towards who stands 20 m ahead."""
    path = torch.zeros(1, STEPS, 4)
    time = 0.1 * torch.arange(STEPS)
    path[0, :, 0], path[0, :, 3] = SPEED * time - time**2 / 2, SPEED - time
    tracks = torch.zeros(1, 1, STEPS, 4)
    tracks[..., 0] = 24.0
    ways = [
        foresee(
            item,
            SIZE,
            tracks=tracks,
            sizes=SIZE,
            since=torch.tensor([-1.0]),
            settled=torch.tensor([False]),
        )
        for item in (path, mirrored(path))
    ]
    assert float(ways[0].worth) > 0.2
    assert float(ways[0].time) < 3
    for ahead, back in zip(*ways, strict=True):
        torch.testing.assert_close(back, ahead)


def test_the_clock_starts_where_the_ego_reverses_into_the_risk():
    scene = make_scenes(
        1, vehicles=[(0, 0, 10.0), (18.0, 0, 1.0), (18.0, 1, 1.0)], steps=20
    ).scenes
    world = World.at_start(scene)
    plan = world.states[:, :1] + torch.zeros(1, 50, 4)
    plan[..., 0] += torch.arange(1, 51)
    world.states[:, :1] = mirrored(world.states[:, :1])
    since = time_before(
        world, mirrored(plan), since=torch.full((1, scene["route_log"].shape[1]), -1.0)
    )
    assert since[0, 1:3].tolist() == [0.0, -1.0]


@pytest.mark.parametrize(("ahead", "before"), [(18.0, -1.0), (18.0, 0.5), (80.0, 0.5)])
def test_the_clock_starts_at_the_competent_driver_s_risk_and_runs_while_it_lasts(
    ahead, before
):
    scene = make_scenes(
        1, vehicles=[(0, 0, 10.0), (ahead, 0, 1.0), (ahead, 1, 1.0)], steps=20
    ).scenes
    world = World.at_start(scene)
    plan = world.states[:, :1] + torch.zeros(1, 50, 4)
    plan[..., 0] += torch.arange(1, 51)
    since = time_before(
        world, plan, since=torch.full((1, scene["route_log"].shape[1]), before)
    )
    begins = 0.0 if ahead < 30 else -1.0
    assert float(since[0, 1]) == (before + 0.5 if before >= 0 else begins)
    assert float(since[0, 2]) == -1.0, "it is in the next lane"


def test_the_worth_of_a_plan_is_the_share_of_drivers_whom_it_hits_less_for_later_ones():
    """A car that stands 38 m ahead is hit by the driver who does not react alone, of
    weight 0.05, after some 4 s of 5.1; a tenth is lost at the end of the horizon."""
    foresight = standing(38.0)()
    time = float(foresight.time)
    assert time == pytest.approx(3.9, abs=0.2)
    assert float(foresight.worth) == pytest.approx(0.05 * (1 - 0.1 * time / 5.1))


def test_all_but_the_competent_driver_run_into_what_only_that_one_prevents():
    need = float(HumanDriver().stopping_gap(torch.tensor(SPEED)))
    foresight = standing(1.02 * need)()
    late = 1 - 0.1 * float(foresight.time) / 5.1
    assert float(foresight.worth) == pytest.approx(
        (0.4 + 0.3 + 0.15 + 0.1 + 0.05) * late
    )


@pytest.mark.parametrize(("lap", "counts"), [(0.7, True), (0.9, False)])
def test_a_contact_is_the_ego_s_front_if_they_lapped_by_less_than_0_8_m(lap, counts):
    """A car comes from the next lane into the ego's, its rear so far behind the ego's
    front."""
    path = torch.zeros(1, STEPS, 4)
    path[0, :, 0] = SPEED * 0.1 * torch.arange(STEPS)
    path[..., 3] = SPEED
    tracks = torch.zeros(1, 1, STEPS, 4)
    tracks[..., 0] = path[..., 0] + 4.0 - lap
    tracks[..., 1] = torch.where(torch.arange(STEPS) < 10, 4.0, 0.0)
    tracks[..., 3] = SPEED
    foresight = foresee(
        path,
        SIZE,
        tracks=tracks,
        sizes=SIZE,
        since=torch.tensor([-1.0]),
        settled=torch.tensor([True]),
    )
    assert bool(foresight.worth > 0) == counts


# Delay s and braking m/s^2 of the drivers who react, and what each weighs.
DRIVERS = [(0.85, 6.5, 0.4), (1.0, 5.5, 0.3), (1.25, 5.0, 0.15), (1.6, 4.0, 0.1)]


def needed_gap(delay, braking, speed):
    """v (t + b / 2 j) + v^2 / 2 b, the braking rising by j, of UN R157."""
    rise = braking / (2 * 12.65)
    return speed * (delay + rise) + speed**2 / (2 * braking)


@pytest.mark.parametrize("more", [-1.5, 0.5])
@pytest.mark.parametrize("number", range(len(DRIVERS)))
def test_each_driver_stops_within_its_delay_and_braking(number, more):
    """From 15 m/s. Where it does, all worse ones and the one who never reacts are hit;
    with less room it is, too."""
    delay, braking, weight = DRIVERS[number]
    foresight = standing(needed_gap(delay, braking, 15.0) + more, speed=15.0)()
    late = 1 - 0.1 * float(foresight.time) / 5.1
    hit = sum(worse for *_, worse in DRIVERS[number + 1 :]) + 0.05
    if more < 0:
        hit += weight
    assert float(foresight.worth) == pytest.approx(hit * late, abs=1e-3)


@pytest.mark.parametrize(("more", "prevented"), [(-1.0, False), (0.5, True)])
def test_the_competent_driver_reacts_after_0_75_s_and_brakes_by_0_774_g(
    more, prevented
):
    gap = needed_gap(0.75, 7.59, 15.0) + more
    assert bool(standing(gap, speed=15.0)().prevented) is prevented


@pytest.mark.parametrize(("speed", "counts"), [(0.95, False), (1.05, True)])
def test_who_is_slower_than_a_metre_a_second_runs_into_nobody(speed, counts):
    """Who never reacts, 2 m behind a vehicle that stands."""
    foresight = standing(2.0, speed=speed)()
    assert foresight.time.isfinite().item()
    assert (foresight.worth > 0).item() is counts
