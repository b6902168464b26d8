"""What populations of known tallies say of scenes and of egos."""

import math
from types import SimpleNamespace

import pytest

from e2rl.tail.rate import Estimate
from e2rl.tail.subset import REACHED, SPENT, Tally
from e2rl.tail.summary import rates_of, ratio, scene_rates

SCENES = SimpleNamespace(scene_id=["a", "b", "c"])
STEPS = 80


def reached(scene, repetition, probability, failures=0):
    tally = Tally(
        probability, probability, contact=2 * probability, counted=0.0, rollouts=10
    )
    tally.end = REACHED
    rows = [{"weight": probability / failures} for _ in range(failures)]
    return Estimate(scene, repetition, tally, 0.1, 0, 0, rows)


def spent(scene, bound):
    return Estimate(scene, 0, Tally(bound=bound, rollouts=10, end=SPENT), 0.1, 0, 0, [])


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
    assert rates[1].bounds == (0, 0, 1e-3)
    assert rates[1].at_most == 1e-3
    assert rates[0].at_most == 0


def test_weights_of_failures_sum_to_the_probability(rates):
    assert sum(row["weight"] for row in rates[0].failures) == pytest.approx(0.02)


def test_rates_are_per_scene_hour_and_1000_km(rates):
    by_event = {rate.event: rate for rate in rates_of(rates, STEPS)}
    preventable = by_event["preventable"]
    assert preventable.scene.value == pytest.approx(0.02 / 3)
    assert preventable.hour.value == pytest.approx(0.02 / 3 * 3600 / 8)
    assert preventable.distance.value == pytest.approx(0.02 / 0.3 * 1000)
    assert by_event["contact"].scene.value == pytest.approx(0.04 / 3)


def test_the_ratio_of_two_egos_is_that_of_their_rates(rates):
    twice = scene_rates(
        [
            *(reached(1, k, p) for k, p in enumerate((0.02, 0.06))),
            spent(0, 1e-3),
            spent(2, 1e-4),
        ],
        SCENES,
        "preventable",
    )
    assert ratio(twice, rates, "preventable").value == pytest.approx(2)
