"""What populations of known tallies say of scenes and of egos."""

import math
from types import SimpleNamespace

import pytest
import torch

from e2rl.driving.scored import Scored
from e2rl.tail.estimate import Estimate
from e2rl.tail.interval import Side, of_counts, of_logs, of_ratio
from e2rl.tail.sampler import REACHED, SPENT, Tally
from e2rl.tail.summary import rates_of, scene_rates

SCENES = SimpleNamespace(scene_id=["a", "b", "c"], location=["", "", ""])
MANY = SimpleNamespace(scene_id=[f"scene {k}" for k in range(12)], location=[""] * 12)
STEPS = 80


def reached(scene, repetition, probability, failures=0):
    tally = Tally(
        probability, probability, contact=2 * probability, counted=0.0, rollouts=10
    )
    tally.end = REACHED
    rows = [{"weight": probability / failures} for _ in range(failures)]
    return Estimate(scene, repetition, tally, 0.1, 0, 0, Scored(rows))


def spent(scene, bound):
    return Estimate(
        scene, 0, Tally(bound=bound, rollouts=10, end=SPENT), 0.1, 0, 0, Scored()
    )


@pytest.fixture
def rates():
    estimates = [reached(1, k, p, failures=2) for k, p in enumerate((0.01, 0.03))]
    return scene_rates(
        [*estimates, spent(0, 1e-3), spent(2, 1e-4)], SCENES, "preventable"
    )


def test_scenes_are_sorted_by_their_failure_then_by_what_it_may_be(rates):
    assert [scene.scene_id for scene in rates] == ["b", "a", "c"]


def test_a_probability_is_the_mean_of_repetitions_and_its_nats_their_log(rates):
    assert rates[0].bounds.value == pytest.approx(0.02)
    assert rates[0].nats == pytest.approx(-math.log(0.02))
    assert rates[1].nats == math.inf


def test_a_failure_not_drawn_is_bounded_by_the_last_level(rates):
    assert rates[1].bounds.value == 0
    assert math.isnan(rates[1].bounds.high)
    assert rates[1].at_most == 1e-3
    assert rates[0].at_most == 0


def test_what_a_repetition_did_not_reach_is_part_of_the_interval():
    ended = Estimate(
        0, 1, Tally(bound=0.02, rollouts=10, end=SPENT), 0.1, 0, 0, Scored()
    )
    (scene,) = scene_rates([reached(0, 0, 0.01), ended], SCENES, "preventable")
    assert scene.bounds.value == pytest.approx(0.005)
    assert scene.bounds.low == 0
    assert scene.bounds.high == of_logs(torch.tensor([0.01, 0.02]).log()).high
    assert scene.at_most == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("unit", "exposure"),
    [("scene", 12), ("hour", 12 * 8 / 3600), ("1000km", 12e-4)],
)
def test_scenes_that_were_not_reached_may_add_their_bounds(unit, exposure):
    parts = [reached(scene, 0, 0.01 * scene) for scene in range(10)]
    rates = scene_rates([*parts, spent(10, 1e-3), spent(11, 1e-4)], MANY, "preventable")
    estimates = [scene.probability["preventable"] for scene in rates]
    places = torch.tensor(
        [sorted(MANY.scene_id).index(scene.scene_id) for scene in rates]
    )
    interval = of_ratio(
        Side(estimates, torch.full((12,), exposure / 12).double(), places)
    )
    bounds = rates_of(rates, STEPS)["preventable"][unit]
    assert bounds.value == pytest.approx(interval.value)
    assert bounds.high == pytest.approx(interval.high + 1.1e-3 / exposure)


def test_independent_rollouts_have_the_interval_of_their_counts():
    tally = Tally(0.02, hits=2, rollouts=100, end=REACHED)
    (scene,) = scene_rates(
        [Estimate(0, 0, tally, 0.1, 0, 0, Scored())], SCENES, "contact"
    )
    assert scene.bounds == of_counts(2, 100)


def test_scenes_without_a_hit_share_the_bound_of_independent_rollouts():
    """None of 100 rollouts hits in any: exp(-100 (p + q + ...)) >= 5%."""
    bound = 1 - 0.05 ** (1 / 100)
    tally = Tally(0.0, bound=bound, hits=0, rollouts=100, end=SPENT)
    parts = [Estimate(scene, 0, tally, 0.1, 0, 0, Scored()) for scene in range(12)]
    scenes = scene_rates(parts, MANY, "contact")
    high = rates_of(scenes, STEPS)["contact"]["scene"].high
    assert high == pytest.approx(-math.log(0.05) / 100 / 12)


def test_few_scenes_have_a_rate_without_an_interval(rates):
    bounds = rates_of(rates, STEPS)["preventable"]["scene"]
    assert bounds.value == pytest.approx(0.02 / 3)
    assert math.isnan(bounds.low)
    assert math.isnan(bounds.high)


def test_weights_of_failures_sum_to_the_probability(rates):
    assert sum(row["weight"] for row in rates[0].failures.rows) == pytest.approx(0.02)


def test_failures_have_the_nats_of_their_scene(rates):
    nats = [row["transport"] for row in rates[0].failures.rows]
    assert nats == [rates[0].nats] * 4


def test_rates_are_per_scene_hour_and_1000_km(rates):
    by_event = rates_of(rates, STEPS)
    preventable = by_event["preventable"]
    assert preventable["scene"].value == pytest.approx(0.02 / 3)
    assert preventable["hour"].value == pytest.approx(0.02 / 3 * 3600 / 8)
    assert preventable["1000km"].value == pytest.approx(0.02 / 0.3 * 1000)
    assert by_event["contact"]["scene"].value == pytest.approx(0.04 / 3)
