"""What every driver keeps to, closed forms, and concrete cut-ins against the public
reference study's own program."""

import csv
from pathlib import Path

import pytest
import torch

from e2rl.metrics.drivers import (
    DRIVERS,
    MAX_JERK,
    FuzzySafetyModel,
    HumanDriver,
    Observation,
    RegulationLimit,
    ResponsibilitySensitiveSafety,
    no_conflict,
)
from e2rl.scenes.recording import DT
from tests.metrics.cut_ins import CutIn, simulate_cut_ins

BOUNDS = {"human": 7.59, "regulation": 6.0, "rss": 7.59, "fsm": 6.0}
EACH = pytest.mark.parametrize("name", DRIVERS)


def observe(**fields):
    """One conflict: an ego at 20 m/s, 5 m behind the overlapping rear of a vehicle at
    10 m/s, unless said otherwise."""
    usual = Observation(
        20.0,
        0.0,
        gap=5.0,
        other_speed=10.0,
        lateral_gap=-1.9,
        lateral_speed=0.0,
        length=4.3,
        other_length=4.3,
    )._asdict()
    values = {key: torch.as_tensor(value) for key, value in (usual | fields).items()}
    values = {k: v.double() if v.is_floating_point() else v for k, v in values.items()}
    return Observation(
        **dict(zip(values, torch.broadcast_tensors(*values.values()), strict=True))
    )


def drive(driver, observations):
    """Accelerations [T, ...] of a driver that sees one observation after the other."""
    state = no_conflict(observations[0].speed)
    actions = []
    for observation in observations:
        state, acceleration = driver.step(state, observation)
        actions.append(acceleration)
    return torch.stack(actions)


@EACH
def test_braking_keeps_its_bound_and_jerk_whatever_happens(name):
    generator = torch.Generator().manual_seed(0)

    def draw(low, high):
        return low + (high - low) * torch.rand(
            512, generator=generator, dtype=torch.float64
        )

    slow = [draw(0, 30), draw(0, 20), draw(-5, 60), draw(-2, 2)]
    observations = []
    for _ in range(60):
        speed, other, gap, side = (value + draw(-0.5, 0.5) for value in slow)
        fields = {
            "speed": speed.clamp(min=0),
            "other_speed": other,
            "gap": gap,
            "lateral_gap": side,
        }
        observations.append(
            observe(
                **fields,
                acceleration=draw(-8, 3),
                lateral_speed=draw(-1, 2),
            )
        )
    action = drive(DRIVERS[name], observations)
    assert action.isfinite().all()
    assert (action <= 0).all()
    assert action.min().item() == pytest.approx(-BOUNDS[name])
    if name != "regulation":  # R157 5.2.5.2 has no build-up
        assert (-action.diff(dim=0)).max() <= MAX_JERK * DT + 1e-9


def test_the_human_driver_releases_the_pedal_then_brakes_ever_harder():
    action = -drive(HumanDriver(), [observe()] * 20)
    assert action[:8].tolist() == pytest.approx(
        [0.4] * 8
    )  # 0.75 s, hence the first step from 0.8 s on
    assert action[8:13].tolist() == pytest.approx(
        [0.4 + 1.265 * n for n in range(1, 6)]
    )
    assert action[14:].tolist() == pytest.approx([7.59] * 6)


@EACH
def test_no_reaction_without_a_conflict(name):
    calm = {
        "nobody is there": observe(gap=torch.inf, lateral_gap=torch.inf),
        "the other is faster and far": observe(other_speed=25.0, gap=60.0),
        "the other keeps its lane": observe(lateral_gap=1.6, gap=8.0),
        "the other leaves": observe(lateral_gap=1.4, lateral_speed=-0.5),
        "the ego has passed": observe(gap=-8.0, lateral_gap=0.2, lateral_speed=0.5),
    }
    for case, observation in calm.items():
        assert not drive(DRIVERS[name], [observation] * 20).any(), case


def test_the_human_driver_perceives_overlap_within_two_seconds_and_a_step():
    gap = torch.tensor([20.9, 21.1])
    assert drive(HumanDriver(), [observe(gap=gap)])[0].tolist() == pytest.approx(
        [-0.4, 0]
    )
    aside = {
        "lateral_gap": torch.tensor([1.2, 1.3]),
        "lateral_speed": 0.5,
    }
    assert not drive(HumanDriver(), [observe(**aside)]).any()
    assert drive(HumanDriver(perception_gap=1.225), [observe(**aside)])[
        0
    ].tolist() == pytest.approx([-0.4, 0])


def test_the_regulation_judges_once_at_the_intrusion():
    limit = 10 * (10 / 12 + 0.35)
    gap = torch.tensor([limit - 0.1, limit + 0.1])
    steps = [observe(gap=gap, lateral_gap=0.4, lateral_speed=0.5)] + [
        observe(gap=gap + 50)
    ] * 10
    assert drive(RegulationLimit(), steps)[-1].tolist() == pytest.approx([0, -6])


def test_rss_brakes_within_both_safe_distances():
    rss = ResponsibilitySensitiveSafety()
    ahead = rss.safe_distance(torch.tensor(20.0), torch.tensor(10.0)).item()
    assert ahead == pytest.approx(
        15 + 3 * 0.75**2 / 2 + 22.25**2 / 15.18 - 100 / 15.18, abs=1e-4
    )
    aside = rss.safe_lateral_distance(torch.tensor([0.5, -2.0])).tolist()
    assert aside == pytest.approx([0.3 + 0.375 + 0.75**2 / 2 + 1.25**2 / 2, 0.3])
    gap = torch.tensor([ahead - 1, ahead - 1, ahead + 1])
    side = torch.tensor([aside[0] - 0.1, aside[0] + 0.1, 0.0])
    danger = observe(gap=gap, lateral_gap=side, lateral_speed=0.5)
    assert (drive(rss, [danger] * 10)[-1] < 0).tolist() == [True, False, False]


def test_fuzzy_metrics_are_linear_between_unsafe_and_safe():
    fsm = FuzzySafetyModel()
    speed = torch.tensor(20.0)
    other = torch.tensor(10.0)
    unsafe = 15 - 100 / 14 + 400 / 12
    safe = 15 - 100 / 14 + 400 / 8 + 2
    gap = 2 + torch.tensor([unsafe - 1, unsafe, (unsafe + safe) / 2, safe, safe + 1])
    assert fsm.proactive(gap, speed, other).tolist() == pytest.approx(
        [1, 1, 0.5, 0, 0], abs=1e-5
    )
    unsafe = 7.5 + 100 / 12
    safe = 7.5 + 100 / 8
    gap = torch.tensor([unsafe - 1, unsafe, (unsafe + safe) / 2, safe, safe + 1])
    assert fsm.critical(
        gap, speed, acceleration=torch.tensor(0.0), other_speed=other
    ).tolist() == pytest.approx([1, 1, 0.5, 0, 0], abs=1e-5)
    # Braking by 4 m/s^2 makes 12 m/s as slow as the other within the reaction: 2 m / 8
    # decide.
    gap = torch.tensor([0.4, 0.6])
    assert fsm.critical(
        gap,
        torch.tensor(12.0),
        acceleration=torch.tensor(-9.0),
        other_speed=other,
    ).tolist() == [1, 0]


@pytest.mark.parametrize(("seconds", "brakes"), [(1.95, True), (1.97, False)])
def test_fsm_anticipates_who_comes_over_before_the_ego_has_passed(seconds, brakes):
    """The ego needs 18.6 m / 10 m/s = 1.86 s to pass, with 0.1 s of margin 1.96 s."""
    observation = observe(gap=10.0, lateral_gap=1.6, lateral_speed=1.6 / seconds)
    last = drive(FuzzySafetyModel(), [observation] * 10)[-1]
    assert (last < 0).item() is brakes


ORACLE = Path(__file__).parents[2] / ".." / "shared" / "reference" / "r157_cut_in.csv"
MODELS = {
    "human": "CC_human_driver",
    "regulation": "Reg157",
    "rss": "RSS",
    "fsm": "FSM",
}
CRASHES = {"human": 246, "regulation": 173, "rss": 83, "fsm": 89}
FIELDS = ("ego_kmh", "cut_in_kmh", "gap_m", "lateral_mps")


def oracle(model):
    """The oracle's (cut-ins, whether they crash [B]) of one model."""
    if not ORACLE.exists():
        pytest.skip(f"the oracle {ORACLE} is not there")
    with open(ORACLE, newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["model"] == model]
    ego, other, gap, lateral = torch.tensor(
        [[float(row[f]) for f in FIELDS] for row in rows], dtype=torch.float64
    ).T
    return CutIn(ego / 3.6, other / 3.6, gap=gap, lateral_speed=lateral), torch.tensor(
        [int(row["crash_type"]) > 0 for row in rows]
    )


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("name", MODELS)
def test_verdicts_are_the_oracle_s(name, dtype):
    scenarios, expected = oracle(MODELS[name])
    crash = simulate_cut_ins(
        DRIVERS[name], CutIn(*(field.to(dtype) for field in scenarios))
    )
    assert len(crash) == 792
    assert crash.sum() == CRASHES[name]
    different = crash != expected
    assert not different.any(), [
        tuple(field[different].tolist()) for field in scenarios
    ]


@pytest.mark.parametrize("closing", [4.0, 6.0, 8.0])
def test_the_human_driver_needs_its_stopping_gap_and_no_more(closing):
    """The way until the speeds are equal: the delay, then braking that grows by the
    jerk up to its bound."""
    ramp = 7.59 / 12.65
    whole = closing - 7.59 * ramp / 2  # m/s that are lost at the full braking
    way = closing * 0.75 + closing * ramp - 7.59 * ramp**2 / 6 + whole**2 / (2 * 7.59)
    assert HumanDriver().stopping_gap(torch.tensor(closing)).item() == pytest.approx(
        way, rel=0.03
    )

    def least(gap):
        state = no_conflict(torch.tensor(0.0).double())
        speed = torch.tensor(10.0 + closing).double()
        smallest = gap = torch.tensor(gap).double()
        for _ in range(80):
            state, wanted = HumanDriver().step(
                state, observe(speed=speed, gap=gap, other_speed=10.0)
            )
            speed = (speed + wanted * DT).clamp(min=0)
            gap = gap - (speed - 10.0) * DT
            smallest = smallest.minimum(gap)
        return smallest.item()

    assert 0 < least(way) < 0.2 * closing, (
        "the pedal's release and whole steps save a little"
    )
    assert least(way + 1.0) == pytest.approx(least(way) + 1.0, abs=0.02), (
        "it does not brake harder when there is less"
    )


@pytest.mark.parametrize(("more", "brakes"), [(0.9e-4, True), (1.1e-4, False)])
def test_a_tenth_of_a_millimetre_decides_a_tie_in_the_time_to_collision(more, brakes):
    """Two seconds and a step at 10 m/s are 21 m."""
    action = drive(HumanDriver(), [observe(gap=21.0 + more)])
    assert (action < 0).item() is brakes
