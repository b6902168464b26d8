"""Driven again: who keeps its way and brakes with reason, and constructed collisions
whose verdict is known."""

import math

import pytest
import torch

from e2rl.metrics.drivers import DRIVERS, HumanDriver
from e2rl.metrics.preventable import (
    Collision,
    Tracks,
    along_path,
    contacts,
    driven_length,
    follows,
    last_direction,
    poses,
    preventions,
    redrive,
)
from e2rl.scenes.recording import DT
from tests.metrics.cut_ins import LENGTH, WIDTH, CutIn, lateral_motion
from tests.metrics.test_drivers import MODELS, oracle

SIZE = torch.tensor([[4.5, 2.0]], dtype=torch.float64)


def track(speed, heading=0.0, start=(0.0, 0.0), steps=80):
    """States [1, steps + 1, 4] of a vehicle at speeds `speed` (a number or one per
    step), along a fixed heading."""
    speed = torch.as_tensor(speed, dtype=torch.float64).expand(steps + 1)
    way = torch.nn.functional.pad(((speed[1:] + speed[:-1]) / 2 * DT).cumsum(0), (1, 0))
    x = start[0] + way * math.cos(heading)
    y = start[1] + way * math.sin(heading)
    return torch.stack([x, y, torch.full_like(x, heading), speed], -1)[None]


def circle(radius, speed, steps=80):
    angle = torch.arange(steps + 1, dtype=torch.float64) * DT * speed / radius
    values = (
        radius * angle.sin(),
        radius * (1 - angle.cos()),
        angle,
        torch.full_like(angle, speed),
    )
    return torch.stack(values, -1)[None]


def others(*tracks):
    states = torch.cat(tracks)[None].transpose(1, 2)
    return Tracks(
        states,
        SIZE.expand(1, len(tracks), 2),
        present=torch.ones(states.shape[:3], dtype=torch.bool),
    )


@pytest.mark.parametrize(
    "way", [track(9.0), circle(30.0, 8.0), track(torch.linspace(10, 0, 81))]
)
@pytest.mark.parametrize("name", DRIVERS)
def test_a_vehicle_alone_drives_as_recorded(way, name):
    far = others(track(0.0, start=(500.0, 500.0)))
    driven = redrive(
        DRIVERS[name], way, size=SIZE, others=along_path(way, SIZE[:, 1], others=far)
    )
    assert torch.allclose(driven[..., :2], way[..., :2], atol=0.02)
    assert torch.allclose(driven[..., 3], way[..., 3], atol=1e-9)


@pytest.mark.parametrize("name", DRIVERS)
def test_it_never_leaves_its_way_nor_outruns_its_recording(name):
    way = circle(40.0, 12.0)
    blocker = others(
        torch.tensor([[[36.0, 22.0, 1.0, 0.0]]], dtype=torch.float64).expand(1, 81, 4)
    )
    driven = redrive(
        DRIVERS[name],
        way,
        size=SIZE,
        others=along_path(way, SIZE[:, 1], others=blocker),
    )
    assert (
        (driven[..., :2] - torch.tensor([0.0, 40.0])).norm(dim=-1) - 40.0
    ).abs().max() < 0.05
    assert (driven_length(driven) <= driven_length(way) + 0.01).all()
    assert (driven[..., 3] < way[..., 3] - 1).any()  # it did brake


def test_poses_interpolate_the_way_and_go_on_straight():
    way = circle(20.0, 10.0)
    length = driven_length(way)
    middle = (length[:, :-1] + length[:, 1:]) / 2
    assert (
        (poses(way, middle)[..., :2] - torch.tensor([0.0, 20.0])).norm(dim=-1) - 20
    ).abs().max() < 0.01
    beyond = poses(way, length[:, -1:] + 7.0)[0, 0]
    assert (beyond[:2] - way[0, -1, :2]).norm().item() == pytest.approx(7.0)
    assert beyond[2].item() == pytest.approx(way[0, -1, 2].item())


def driven_again(driver, cut_in):
    """Crashes [B] bool of cut-ins as tracks on a plane, judged by the room that judges
    rollouts."""
    side_speed, side, start = lateral_motion(cut_in)
    steps = min(start + 240, len(side) - 1)
    time = DT * (torch.arange(steps + 1, dtype=torch.float64)[:, None] - start)
    zero = torch.zeros_like(time * cut_in.speed)
    ego = torch.stack(
        [time * cut_in.speed, zero, zero, zero + cut_in.speed], -1
    ).transpose(0, 1)
    x = LENGTH + cut_in.gap + time * cut_in.other_speed
    y = side[: steps + 1] + WIDTH
    # The oracle's vehicles do not turn: their lateral speed is not in their heading.
    other = torch.stack([x, y, zero, zero + cut_in.other_speed], -1).transpose(0, 1)
    size = torch.tensor([[LENGTH, WIDTH]], dtype=torch.float64).expand(len(ego), 2)
    tracks = Tracks(
        other[:, :, None],
        size[:, None],
        present=torch.ones_like(other[..., :1], dtype=torch.bool),
    )
    along = along_path(ego, size[:, 1], others=tracks)._replace(
        lateral_speed=side_speed[: steps + 1, :, None]
    )
    return contacts(redrive(driver, ego, size=size, others=along), size, others=tracks)[
        ..., 0
    ].any(1)


@pytest.mark.parametrize("name", MODELS)
def test_verdicts_on_recorded_tracks_agree_with_the_oracle(name):
    cut_in, expected = oracle(MODELS[name])
    crash = driven_again(DRIVERS[name], CutIn(*(field[::8] for field in cut_in)))
    assert (crash == expected[::8]).double().mean() >= 0.95


LANE = 3.5


def cut_in(gap, speed, other_speed, at=10, side=1.0):
    """A vehicle that comes over from the next lane within a second, `gap` m ahead
    (bumper to bumper) at step `at`."""
    other = track(other_speed, steps=80)
    other[..., 0] += gap + 4.5 + (speed - other_speed) * 0.1 * at
    share = ((torch.arange(81) - at + 5) / 10.0).clamp(0, 1)
    other[0, :, 1] = side * LANE * (1 - share * share * (3 - 2 * share))
    return other


def collision(ego, *others, partner=1):
    """The Collision of an ego with others, at their first contact with the partner."""
    states = torch.stack([ego[0], *(other[0] for other in others)], 1)[None]
    gap = (states[0, :, 0, :2] - states[0, :, partner, :2]).abs()
    touch = (gap[:, 0] < 4.5) & (gap[:, 1] < 2.0)
    assert touch.any()
    stop = touch.int().argmax()[None]
    present = torch.ones(states.shape[:3], dtype=torch.bool)
    return Collision(
        states,
        present,
        size=SIZE.expand(1, states.shape[2], 2),
        partner=torch.tensor([partner]),
        stop=stop,
    )


def human(case):
    return preventions(case, {"human": HumanDriver()})["human"]


def test_a_cut_in_is_preventable_where_there_is_room_to_brake():
    ego = track(14.0)
    near, far = (
        human(collision(ego, cut_in(gap, 14.0, other_speed=6.0))) for gap in (5.0, 14.0)
    )
    assert not near.avoided.any()
    assert far.avoided.all()
    assert not far.followers.any()
    needed = HumanDriver().stopping_gap(torch.tensor(8.0))
    assert 5.0 < needed < 14.0


@pytest.mark.parametrize("speed", [14.0, 16.0, 20.0])
def test_a_driver_that_the_end_of_the_rollout_spares_has_not_got_away(speed):
    """Whoever stands at this distance is hit by every driver, though later than by the
    ego, at whose contact the rollout ends. A rollout that goes on has the same verdict.
    """
    case = collision(track(speed), track(0.0, start=(4.5 + 1.6 * speed, 0.0)))
    last = int(case.stop) + 1
    cut = case._replace(states=case.states[:, :last], present=case.present[:, :last])
    assert not human(case).avoided
    assert not human(cut).avoided
    driven = human(cut).states[0, -1, 0]
    assert driven + 4.5 < 4.5 + 1.6 * speed, (
        "the driver is not there yet as the rollout ends"
    )


def follower(gap, speed=14.0):
    return track(speed, start=(-4.5 - gap, 0.0))


@pytest.mark.parametrize("gap, avoided", [(20.0, True), (1.0, False)])
def test_a_follower_that_is_replayed_into_the_driver_brakes_as_competently_as_it_can(
    gap, avoided
):
    case = collision(track(14.0), cut_in(14.0, 14.0, other_speed=6.0), follower(gap))
    result = human(case)
    assert result.avoided.item() is avoided
    assert (result.followers > 0).item() is avoided


@pytest.mark.parametrize("gap, avoided", [(44.0, True), (30.0, False)])
def test_a_second_follower_must_manage_behind_the_first(gap, avoided):
    result = human(
        collision(
            track(14.0),
            cut_in(14.0, 14.0, other_speed=6.0),
            follower(20.0),
            follower(gap),
        )
    )
    assert result.avoided.item() is avoided


def test_the_order_of_the_others_does_not_matter():
    case = collision(
        track(14.0),
        cut_in(13.0, 14.0, other_speed=6.0),
        follower(20.0),
        track(10.0, start=(3.0, -3.5)),
    )
    order = torch.tensor([0, 3, 2, 1])
    other = preventions(
        case._replace(states=case.states[:, :, order], partner=torch.tensor([3]))
    )
    for name, result in preventions(case).items():
        assert other[name].avoided.item() == result.avoided.item()


def later_contact(steps):
    """The human driver's Prevention where the partner is put onto the driver, who has
    braked for it, so many steps after the ego's contact."""
    case = collision(track(14.0), track(0.0, start=(45.0, 0.0)))
    driver = human(case).states
    states = case.states.clone()
    later = int(case.stop) + steps
    states[0, later:, 1, :2] = driver[0, later:, :2] + torch.tensor([0.0, 1.0])
    return human(case._replace(states=states))


@pytest.mark.parametrize(("steps", "avoided"), [(30, False), (31, True)])
def test_the_driver_must_touch_nobody_for_three_seconds_after_the_contact(
    steps, avoided
):
    assert later_contact(steps).avoided.item() is avoided


@pytest.mark.parametrize(("nearer", "avoided"), [(14, False), (15, True)])
def test_the_partner_and_the_fifteen_nearest_others_are_there(nearer, avoided):
    """One that is put onto the driver after the ego's contact, and others that pass
    beside, nearer to the ego."""
    case = collision(
        track(14.0),
        track(0.0, start=(45.0, 0.0)),
        *(track(14.0, start=(0.0, 4.0 + 0.1 * k)) for k in range(nearer)),
        track(0.0, start=(-200.0, 0.0)),
    )
    driver = human(case).states
    states = case.states.clone()
    later = int(case.stop) + 20
    states[0, later:, -1, :2] = driver[0, later:, :2] + torch.tensor([0.0, 1.0])
    result = human(case._replace(states=states))
    assert result.avoided.item() is avoided


def test_a_chain_has_two_followers():
    """Two brake in time one behind the other; the third, which could not, is not
    looked at."""
    case = collision(
        track(14.0),
        cut_in(14.0, 14.0, other_speed=6.0),
        follower(20.0),
        follower(35.3),
        follower(40.0),
    )
    result = human(case)
    assert result.followers.item() == 2
    assert result.avoided.item()


@pytest.mark.parametrize(("way", "reverses"), [(0.019, False), (0.021, True)])
def test_two_centimetres_in_a_step_tell_the_direction_of_motion(way, reverses):
    states = torch.zeros(1, 3, 4, dtype=torch.float64)
    states[0, 1:, 0] = -way
    direction = last_direction(states, torch.tensor([2]))
    assert (direction.abs() > 3).item() is reverses


@pytest.mark.parametrize(("degrees", "expected"), [(59, True), (61, False)])
def test_a_follower_drives_within_60_degrees_of_its_leader(degrees, expected):
    behind = others(track(5.0, math.radians(degrees), start=(-4.0, 0.0)))
    step = torch.tensor([0])
    result = follows(track(5.0), behind, step=step, index=step)
    assert result.item() is expected


def test_a_path_goes_on_straight_beyond_its_end():
    standing = track(0.0)
    crossing = others(track(0.0, math.pi / 2, start=(75.0, 0.0)))
    along = along_path(standing, SIZE[:, 1], others=crossing)
    assert along.rear[0, 0, 0].item() == pytest.approx(74.0)


class Asleep:
    """A driver who sees nothing."""

    def step(self, state, observation):
        return state, torch.full_like(observation.gap, torch.inf)


@pytest.mark.parametrize(("speed", "struck"), [(0.45, True), (0.55, False)])
def test_a_driver_who_creeps_at_half_a_metre_a_second_is_struck(speed, struck):
    """Head-on, by a partner at 3 m/s."""
    oncoming = track(3.0, math.pi, start=(20.0, 0.0))
    case = collision(track(speed), oncoming)
    result = preventions(case, {"asleep": Asleep()})["asleep"]
    assert result.struck.item() is struck
