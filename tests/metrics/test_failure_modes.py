"""Failure modes: what belongs together, how it is named, and that the order of the
failures does not matter."""

import math
import random
from functools import partial

import pytest
import torch

from e2rl.metrics.failure_modes import (
    cluster_failures,
    feature_vectors,
    known_features,
    large_modes,
    medoid,
    mode_name,
    split_side,
)
from e2rl.metrics.realism import NO_SAMPLES
from e2rl.metrics.statistics import (
    MetricTable,
    bootstrap_draws,
    resampled_labels,
    row_metrics,
    summarise,
)

REAR_END = {
    "approach": "ahead",
    "partner_manoeuvre": "brakes",
    "ego_manoeuvre": "keeps speed",
    "contact_type": "front",
}
CROSSING = {
    "approach": "crossing from the right",
    "partner_manoeuvre": "turns left",
    "ego_manoeuvre": "keeps speed",
    "contact_type": "side",
}


def failure(kind, scene="a", seed=0, ego=10.0, partner=5.0, **changes):
    row = {
        "cfr": 1.0,
        "scene_id": scene,
        "seed": seed,
        "method": "e2",
        "eta": 2.0,
        "location": scene,
    }
    return row | {"ego_speed": ego, "partner_speed": partner} | kind | changes


def crowd(number, seed=0):
    """Failures of all kinds with random words and speeds."""
    draw = random.Random(seed)
    approaches = (
        "ahead",
        "oncoming",
        "from behind",
        "crossing from the left",
        "crossing from the right",
    )
    moves = ("keeps speed", "brakes", "turns left", "veers right")
    return [
        failure(
            {
                "approach": draw.choice(approaches),
                "contact_type": draw.choice(("front", "side")),
            },
            scene=f"scene {index}",
            ego=draw.uniform(0, 20),
            partner=draw.uniform(0, 20),
            partner_manoeuvre=draw.choice(moves),
            ego_manoeuvre=draw.choice(moves[:2]),
        )
        for index in range(number)
    ]


def test_identical_failures_are_one_mode_and_other_approaches_another():
    assert cluster_failures([]) == []
    assert cluster_failures([failure(CROSSING)]) == [1]
    rows = [failure(CROSSING, scene=str(index)) for index in range(7)]
    assert cluster_failures(rows) == [1] * 7
    rows += [failure(REAR_END, scene=str(index)) for index in range(3)]
    assert cluster_failures(rows) == [1] * 7 + [2] * 3


def test_one_manoeuvre_or_a_few_metres_per_second_make_no_mode_of_their_own():
    rows = [
        failure(CROSSING, scene=str(index), ego=8 + index, partner=4 + index)
        for index in range(6)
    ]
    rows += [
        failure(CROSSING, scene="other", ego_manoeuvre="brakes", contact_type="front")
    ]
    assert set(cluster_failures(rows)) == {1}


def test_the_order_of_the_failures_does_not_matter():
    rows = crowd(60)
    result = dict(
        zip((row["scene_id"] for row in rows), cluster_failures(rows), strict=True)
    )
    assert 4 < len(set(result.values())) < 30
    for seed in range(3):
        shuffled = random.Random(seed).sample(rows, len(rows))
        assert [result[row["scene_id"]] for row in shuffled] == cluster_failures(
            shuffled
        )


def test_distances_are_the_weights_of_what_differs():
    def apart(**changes):
        pair = [failure(CROSSING), failure(CROSSING, **changes)]
        first, two = torch.tensor(feature_vectors(pair))
        return (first - two).abs().sum().item()

    assert apart() == 0
    assert apart(approach="crossing from the left") == pytest.approx(0.5)
    assert apart(approach="oncoming") == pytest.approx(2.5), "another kind, and no side"
    assert apart(approach="cut-in from the right") == pytest.approx(2.0)
    assert apart(partner_manoeuvre="veers left") == pytest.approx(0.5)
    assert apart(ego_speed=14.0) == pytest.approx(0.1)


def test_a_duty_splits_modes_where_it_is_known_and_plays_no_part_where_it_is_not():
    rows = [failure(CROSSING, scene=str(index)) for index in range(6)]
    assert "duty" not in known_features(rows)
    for row in rows[:3]:
        row["duty"] = "right_of_way"
    for row in rows[3:]:
        row["duty"] = "none"
        row["ego_speed"] = 11.0
    assert cluster_failures(rows) == [1, 1, 1, 2, 2, 2]
    assert (
        mode_name(rows[:3])
        == "crossing from the right, partner turns left, ego keeps speed: right of way"
    )
    assert mode_name(rows[3:]).endswith(": no duty broken")


def test_names_say_what_two_thirds_agree_on():
    assert mode_name([failure(REAR_END)]) == "ahead, partner brakes, ego keeps speed"
    two_sides = [
        failure(CROSSING),
        failure(CROSSING, approach="crossing from the left"),
    ]
    assert mode_name(two_sides) == "crossing, partner turns left, ego keeps speed"
    mixed = [
        failure(CROSSING, ego_manoeuvre=move)
        for move in ("brakes", "stands", "turns left")
    ]
    assert mode_name(mixed) == "crossing from the right, partner turns left"
    assert (
        mode_name([failure({"approach": word}) for word in ("ahead", "oncoming")])
        == "various"
    )
    assert split_side("beside on the left") == ("beside", "left")
    assert split_side("brakes") == ("brakes", "")


def test_the_medoid_is_the_middle_one_of_the_members():
    members = [
        failure(CROSSING, scene=str(index), ego=float(speed))
        for index, speed in enumerate((3, 9, 10, 12, 40))
    ]
    assert members[medoid(members)]["ego_speed"] == 10
    twins = [failure(CROSSING, scene=name) for name in "cab"]
    assert (
        twins[medoid(twins)]["scene_id"]
        == "a"
        == twins[::-1][medoid(twins[::-1])]["scene_id"]
    )


def test_small_modes_are_those_of_one_or_of_less_than_two_per_cent():
    assert large_modes([1, 1, 2]) == [1, 2], "of few failures each may be one"
    assert large_modes([1] * 8 + [2, 2, 3]) == [1, 2]
    assert large_modes([1] * 200 + [2, 2, 2] + [3] * 5) == [1, 3]
    assert large_modes([]) == []


def expected_labels(labels, places, count):
    """The mean number of different labels, over all ways to pick places and one rollout
    at each."""
    names = sorted(set(places))
    total = []
    for seed in range(4000):
        draw = random.Random(seed)
        chosen = draw.sample(names, count)
        total.append(
            len(
                {
                    draw.choice(
                        [
                            x
                            for x, place in zip(labels, places, strict=True)
                            if place == single
                        ]
                    )
                    for single in chosen
                }
            )
        )
    return sum(total) / len(total)


def test_coverage_is_the_expected_number_of_modes_at_so_many_places():
    labels = [1, 1, 2, 3, 1, 4, 2, 2, 5, 1]
    places = [0, 0, 0, 1, 2, 2, 3, 4, 5, 5]
    coverage = partial(
        resampled_labels,
        torch.tensor(labels, dtype=torch.float64),
        torch.tensor(places),
        draws=bootstrap_draws(6, 3),
    )
    for count in (1, 2, 4, 6):
        result = coverage(places=count)
        assert result[0].item() == pytest.approx(
            expected_labels(labels, places, count=count), abs=0.05
        )
    assert coverage(places=7).isnan().all(), "there are only six places"
    rows = [
        failure(CROSSING, scene=str(index), mode=3) | {"counted": float(index % 3 == 0)}
        for index in range(36)
    ]
    coverage = [metric for metric in row_metrics() if metric.places]
    table = MetricTable.of(rows, coverage)
    totals = table.totals
    weights = table.weights
    assert [metric.name for metric in coverage] == [
        "mode_coverage",
        "mode_coverage_counted",
    ]
    assert weights.sum(0).tolist() == [36, 12]
    assert set((totals / weights)[0].tolist()) == {3.0}


@pytest.mark.parametrize(("brake", "named"), [(6, False), (7, True)])
def test_a_word_that_two_thirds_share_is_in_the_name(brake, named):
    """Of ten failures, six or seven brake."""
    others = ["stands", "turns left", "turns right", "keeps speed"]
    moves = (["brakes"] * brake + others)[:10]
    members = [failure(CROSSING, ego_manoeuvre=move) for move in moves]
    assert ("ego brakes" in mode_name(members)) is named


@pytest.mark.parametrize(("places", "known"), [(9, False), (10, True)])
def test_coverage_is_of_ten_places(places, known):
    rows = [
        failure(CROSSING, scene=str(index), mode=1.0, counted=1.0)
        for index in range(places)
    ]
    samples = [NO_SAMPLES] * places
    result = summarise(rows, samples, draws=2, realism_draws=2)["mode_coverage"]
    assert (not math.isnan(result["mean"])) is known
