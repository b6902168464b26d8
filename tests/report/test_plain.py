"""The summary for a reader who knows none of the field's words: its numbers are those
of the tables, and it is in plain English."""

import json
import math

import pytest

from e2rl.evaluation.rates import EgoRates
from e2rl.evaluation.summary import Headline
from e2rl.report.plain import FEW, INTERVAL, UNKNOWN, plain_answer, plain_rate
from e2rl.tail.interval import Bounds

JARGON = ("η", "ego", "cfr", "rollout", "R157", "NFE", "nats", "prior", "seed")
HEADLINE = Headline(
    scenes=12,
    preventable=3,
    raised=0,
    failed=3,
    ways=4,
    searches=1,
    tries=4.33,
    nfe=630.0,
)
ONCE = HEADLINE._replace(searches=0, tries=0.0, nfe=0.0)


def measured(estimate: dict | None = None) -> dict:
    """A row of metrics.json."""
    metrics = {} if estimate is None else {"cfr_preventable": estimate}
    return {"dataset": "roads", "split": "test", "metrics": metrics}


def estimate(count: int, n: int, low: float = math.nan, high: float = math.nan) -> dict:
    return {"mean": count / n, "low": low, "high": high, "n": n}


def told(headline: Headline, row: dict, eta: float = 2.0) -> dict:
    return plain_answer(headline, row, ego="idm", eta=eta)


def test_the_number_is_that_of_the_tables_with_its_interval_in_words():
    answer = told(HEADLINE, measured(estimate(3, 12, low=0.0917, high=0.53)))
    assert answer["number"] == "In 3 of 12 scenes (25%)"
    assert answer["interval"] == (
        f"In other scenes of this kind, expect between 9.2% and 53%. {INTERVAL}"
    )
    assert "12 of the data set roads (part test)" in answer["driven"]["Scenes"]
    assert "4.3 times" in answer["driven"]["Scenes"]


@pytest.mark.parametrize(
    ("headline", "n", "unit"),
    [
        (ONCE, 12, "scenes"),
        (ONCE, 24, "drives"),
        (HEADLINE._replace(searches=2), 24, "series of tries"),
    ],
)
def test_the_number_says_what_it_counts(headline, n, unit):
    answer = told(headline, measured(estimate(3, n)))
    assert answer["number"].startswith(f"In 3 of {n} {unit} (")


def test_an_interval_that_is_not_known_is_said_to_be_unknown():
    assert told(ONCE, measured(estimate(3, 12)))["interval"] == FEW
    unfinished = told(ONCE, measured())
    assert unfinished["number"] == "In 3 of 12 scenes (25%)"
    assert unfinished["interval"] == UNKNOWN


def test_a_program_that_stops_with_an_error_is_counted_and_named():
    headline = ONCE._replace(raised=2, failed=5)
    answer = told(headline, measured(estimate(5, 12)))
    assert answer["number"].startswith("In 5 of 12 scenes")
    assert "its program stops with an error" in answer["meaning"]
    assert "error" not in told(ONCE, measured(estimate(3, 12)))["meaning"]


def test_only_attacked_traffic_is_said_to_be_steered():
    answers = [told(ONCE, measured(), eta)["driven"] for eta in (0.0, 2.0)]
    assert "Nobody is steered" in answers[0]["Other vehicles"]
    assert "not how often" in answers[1]["Other vehicles"]


def rate(target: str, bounds: Bounds) -> EgoRates:
    return EgoRates(
        ego="idm",
        target=target,
        least=1e-6,
        unresolved=0.0,
        rates={target: {"1000km": bounds}},
        scenes=[{}] * 20,
    )


def test_a_rate_is_told_as_collisions_per_distance():
    answer = plain_rate(rate("preventable", Bounds(34.2, 4.2, 91.0)))
    assert answer["number"] == "About 34 collisions per 1,000 km"
    assert answer["interval"] == f"Expect between 4.2 and 91. {INTERVAL}"
    assert "careful driver" in answer["meaning"]
    contact = plain_rate(rate("contact", Bounds(34.2, math.nan, math.nan)))
    assert "careful driver" not in contact["meaning"]
    assert contact["interval"] == FEW


def test_no_word_of_the_field_is_left_unexplained():
    answers = [
        told(HEADLINE, measured(estimate(3, 12, low=0.1, high=0.5))),
        told(HEADLINE._replace(raised=1, searches=2), measured(estimate(3, 24)), 0.0),
        plain_rate(rate("preventable", Bounds(34.2, 4.2, 91.0))),
    ]
    words = json.dumps(answers, ensure_ascii=False).replace("'", " ").split()
    assert not {word.strip('.,:;()"') for word in words} & set(JARGON)
