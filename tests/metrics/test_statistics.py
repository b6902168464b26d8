"""Intervals: coverage, pooling, pairing, and what is unknown."""

import math

import pytest
import torch
from scipy.stats import binomtest

from e2rl.metrics.realism import KINEMATICS, OF_ADVERSARIES
from e2rl.metrics.statistics import (
    bootstrap_draws,
    cluster_index,
    exact_interval,
    interval,
    paired_differences,
    resampled_means,
    resampled_medians,
    summarise,
)


def rows_of(values, clusters=None, name="cfr", **columns):
    """Rows that know one metric, one scene each, and features without samples."""
    empty = {
        key: torch.zeros(2, 0, dtype=torch.float64)
        for key in (*KINEMATICS, *OF_ADVERSARIES)
    }
    rows = [
        {
            "scene_id": f"s{index}",
            "location": str(clusters[index]) if clusters else "",
            "seed": 0,
            name: value,
        }
        | {key: column[index] for key, column in columns.items()}
        for index, value in enumerate(values)
    ]
    return rows, [empty] * len(rows)


def brief(rows, features):
    return summarise(rows, features, draws=300, realism_draws=2)


def differences(ours, theirs, draws=300):
    return paired_differences(*ours, *theirs, draws=draws, realism_draws=2)


def test_intervals_cover_the_truth_in_about_95_of_100_cases_when_rollouts_come_in_clusters():
    """Rates that vary between locations; treating the rollouts as independent would
    cover in about 70 of 100."""
    generator = torch.Generator().manual_seed(0)
    clusters = 40
    members = 8
    trials = 400
    rates = torch.distributions.Beta(1.0, 2.0)
    torch.manual_seed(0)
    chance = rates.sample((trials, clusters, 1)).double()
    values = (
        torch.rand(trials, clusters, members, generator=generator) < chance
    ).double()
    cluster = torch.arange(clusters).repeat_interleave(members)
    draws = bootstrap_draws(clusters, 400)
    means = resampled_means(
        values.flatten(1).T,
        torch.ones(clusters * members, trials).double(),
        cluster=cluster,
        draws=draws,
    )
    low, high = means[1:].quantile(
        torch.tensor([0.025, 0.975], dtype=torch.float64), dim=0
    )
    covered = ((low <= 1 / 3) & (high >= 1 / 3)).double().mean().item()
    assert 0.91 <= covered <= 0.98, covered
    alone = torch.arange(clusters * members)
    means = resampled_means(
        values.flatten(1).T,
        torch.ones(len(alone), trials).double(),
        cluster=alone,
        draws=bootstrap_draws(len(alone), 400),
    )
    low, high = means[1:].quantile(
        torch.tensor([0.025, 0.975], dtype=torch.float64), dim=0
    )
    assert ((low <= 1 / 3) & (high >= 1 / 3)).double().mean().item() < covered - 0.08


def test_locations_are_clusters_and_logs_where_there_is_none():
    cluster, count = cluster_index(["a", "a", "", "", "", "1"], "121129")
    assert count == 4
    assert cluster[0] == cluster[1]
    assert cluster[2] == cluster[3] != cluster[4]
    assert cluster[5] not in cluster[:5].tolist(), (
        "a location and a scene of the same name are different clusters"
    )
    cluster, count = cluster_index([""] * 3, ("log@11", "log@102", "other@11"))
    assert count == 2
    assert cluster[0] == cluster[1] != cluster[2], "the windows of a log are one"


def test_unknown_values_are_left_out_and_counted_and_never_zero():
    table = brief(*rows_of([1.0, math.nan, 0.0, math.nan], name="relvel"))
    assert table["relvel"]["n"] == 2
    assert table["relvel"]["mean"] == 0.5
    assert table["progress"]["n"] == 0
    assert math.isnan(table["progress"]["mean"])
    assert table["real"]["n"] == 0
    assert math.isnan(table["real"]["mean"])


def test_a_median_draw_is_the_median_of_the_repeated_values():
    generator = torch.Generator().manual_seed(0)
    values = torch.rand(41, generator=generator).double()
    cluster = torch.randint(6, (41,), generator=generator)
    values[::7] = torch.nan
    draws = torch.cat([bootstrap_draws(6, 20), torch.zeros(1, 6, dtype=torch.float64)])
    medians = resampled_medians(values, cluster, draws=draws)
    for draw, median in zip(draws[:-1], medians[:-1], strict=True):
        repeated = values.repeat_interleave(draw[cluster].long())
        assert median.item() == pytest.approx(
            repeated.nanquantile(0.5, interpolation="midpoint").item()
        )
    assert medians[-1].isnan()
    assert resampled_medians(values * torch.nan, cluster, draws=draws).isnan().all()
    table = brief(*rows_of([1.0, math.nan, 9.0, 2.0], name="contact_time"))[
        "contact_time"
    ]
    assert (table["mean"], table["n"]) == (2.0, 3)


def test_fewer_than_ten_places_give_no_interval():
    for name in ("cfr", "progress", "relvel"):
        values = torch.linspace(0, 1, 30).tolist()
        few = brief(*rows_of(values[:27], clusters=list("abcdefghi") * 3, name=name))[
            name
        ]
        several = brief(*rows_of(values, clusters=list("abcdefghij") * 3, name=name))[
            name
        ]
        assert math.isnan(few["low"])
        assert math.isnan(few["high"])
        assert few["n"] == 27
        assert several["low"] < several["mean"] < several["high"]


@pytest.mark.parametrize("level", [0.95, 0.975])
@pytest.mark.parametrize(
    ("events", "places"), [(0, 12), (1, 12), (3, 12), (12, 12), (2, 100), (97, 100)]
)
def test_few_events_have_the_interval_of_clopper_and_pearson(events, places, level):
    expected = binomtest(events, places).proportion_ci(level, "exact")
    assert exact_interval(events / places, places, level=level) == pytest.approx(
        tuple(expected), abs=1e-9
    )
    if level == 0.95:
        result = brief(*rows_of([1.0] * events + [0.0] * (places - events)))["cfr"]
        assert (result["low"], result["high"]) == pytest.approx(
            tuple(expected), abs=1e-9
        )


def test_the_bootstrap_takes_over_from_ten_places_with_and_ten_without_an_event():
    for events, exact in ((9, True), (10, False), (30, False), (31, True)):
        result = brief(*rows_of([1.0] * events + [0.0] * (40 - events)))["cfr"]
        assert (
            (result["low"], result["high"])
            == pytest.approx(exact_interval(events / 40, 40), abs=1e-9)
        ) == exact


def test_rollouts_at_one_place_are_one_trial():
    """24 events in 120 rollouts at 40 places, all of them at eight: as 20% of 40, not
    of 120."""
    values = [1.0] * 24 + [0.0] * 96
    result = brief(*rows_of(values, clusters=[index // 3 for index in range(120)]))[
        "cfr"
    ]
    assert (result["low"], result["high"]) == pytest.approx(exact_interval(0.2, 40))
    assert result["n"] == 120


def test_medians_that_agree_and_ratios_of_few_events_have_no_interval():
    assert interval(torch.arange(1001.0).double(), 10)["low"] == pytest.approx(
        1 + 0.025 * 999
    )
    assert math.isnan(
        brief(*rows_of([3.0] * 40, name="contact_time"))["contact_time"]["low"]
    )
    few, several = (
        brief(*rows_of([1.0] * n + [0.0] * (60 - n), driven_km=[0.1] * 60))
        for n in (9, 10)
    )
    assert math.isnan(few["failures_per_km"]["low"])
    assert few["failures_per_km"]["mean"] == pytest.approx(1.5)
    assert (
        several["failures_per_km"]["low"] < 10 / 6 < several["failures_per_km"]["high"]
    )


def test_a_difference_of_rare_events_lies_between_the_differences_of_their_bounds():
    ours = rows_of([1.0] * 8 + [0.0] * 42)
    theirs = rows_of([0.0] * 49 + [1.0])
    result = differences(ours, theirs, draws=50)["cfr"]
    (low, high), (other_low, other_high) = (
        exact_interval(k / 50, 50, level=0.975) for k in (8, 1)
    )
    assert result["difference"] == pytest.approx(0.14)
    assert (result["low"], result["high"]) == pytest.approx(
        (low - other_high, high - other_low)
    )
    six = paired_differences(
        *rows_of([0.0] * 6), *rows_of([1.0] * 2 + [0.0] * 4), draws=50, realism_draws=2
    )["cfr"]
    assert six["difference"] == pytest.approx(-1 / 3)
    assert math.isnan(six["low"])
    assert math.isnan(six["high"])
    same = differences(ours, ours, draws=50)["cfr"]
    assert same["difference"] == 0
    assert same["low"] == -same["high"] < 0


@pytest.mark.parametrize("places", [9, 10, 40])
def test_a_fraction_that_is_the_same_at_each_place_is_bounded_by_that_of_places_that_are_otherwise(
    places,
):
    """Half of two rollouts at each; the exact bound u of none of them solves (1 -
    u)^places = 0.025."""
    halves = [0.0, 1.0] * places
    clusters = [index // 2 for index in range(2 * places)]
    result = brief(*rows_of(halves, clusters))["cfr"]
    u = 1 - 0.025 ** (1 / places)
    expected = (0.5 * (1 - u), 0.5 * (1 + u)) if places >= 10 else (math.nan, math.nan)
    assert (result["low"], result["high"]) == pytest.approx(expected, nan_ok=True)
    assert result["mean"] == 0.5
    none = brief(*rows_of([0.0] * places))["cfr"]
    assert (none["low"], none["high"]) == pytest.approx(
        (0.0, u) if places >= 10 else expected, nan_ok=True
    )


def test_a_mean_that_is_the_same_at_each_place_is_its_own_interval():
    result = brief(*rows_of([0.1] * 30, name="progress"))["progress"]
    assert result["low"] == result["high"] == result["mean"] == pytest.approx(0.1)
    assert (
        brief(*rows_of([0.1] * 29 + [0.2], name="progress"))["progress"]["low"]
        < result["high"]
    )


@pytest.mark.parametrize("events", [0, 5, 20, 40])
def test_what_has_not_changed_is_bounded_by_the_places_that_may_differ(events):
    """Exactly by those of which there may be as many where none of 40 has been seen,
    for the worse or the better."""
    ours = rows_of(
        [1.0] * events + [0.0] * (40 - events), progress=[30.0 + k for k in range(40)]
    )
    result = differences(ours, ours, draws=100)
    u = exact_interval(0.0, 40)[1]
    assert [
        result["cfr"][end] for end in ("low", "difference", "high")
    ] == pytest.approx([-u, 0.0, u])
    assert [result["progress"][end] for end in ("low", "difference", "high")] == [
        0.0,
        0.0,
        0.0,
    ]


def test_a_change_that_is_the_same_at_each_place_is_within_what_others_may_have():
    """One of two rollouts more fails at each of 20 places: others may have lost or won
    all."""
    clusters = [index // 2 for index in range(40)]
    ours = rows_of([1.0, 1.0] * 20, clusters)
    theirs = rows_of([0.0, 1.0] * 20, clusters)
    result = differences(ours, theirs, draws=100)["cfr"]
    u = exact_interval(0.0, 20)[1]
    assert (result["low"], result["high"]) == pytest.approx(
        (0.5 - 1.5 * u, 0.5 + 0.5 * u)
    )
    longer = paired_differences(
        *rows_of([40.1 + k for k in range(20)], name="progress"),
        *rows_of([40.0 + k for k in range(20)], name="progress"),
        draws=100,
        realism_draws=2,
    )["progress"]
    assert longer["low"] == longer["high"] == longer["difference"] == pytest.approx(0.1)


def test_failures_per_kilometre_are_all_failures_over_all_kilometres():
    ours = rows_of([1.0, 0.0, math.nan, 1.0], driven_km=[0.1, 0.3, 5.0, 0.1])
    theirs = rows_of([0.0, 0.0, 1.0, 1.0], driven_km=[0.2, 0.2, 5.0, 0.6])
    table = brief(*ours)["failures_per_km"]
    assert table["mean"] == pytest.approx(2 / 0.5)
    assert table["n"] == 3
    paired = differences(ours, theirs, draws=300)["failures_per_km"]
    assert paired["difference"] == pytest.approx(4 - 1)
    assert paired["n"] == 3


def test_rates_per_distance_leave_out_what_the_planner_raised_in():
    """2 failures in 0.5 km, and 20 rollouts in which it raised: 4 a km, not 44."""
    values = [1.0, 0.0, 1.0] + [math.nan] * 20
    rows = rows_of(
        values,
        driven_km=[0.1, 0.3, 0.1] + [math.nan] * 20,
        errored=[0.0] * 3 + [1.0] * 20,
    )
    table = brief(*rows)
    assert table["failures_per_km"]["mean"] == pytest.approx(2 / 0.5)
    assert table["failures_per_km"]["n"] == 3
    assert table["cfr"]["mean"] == pytest.approx(22 / 23)
    assert table["cfr"]["n"] == 23
    nothing = brief(
        *rows_of([math.nan] * 2, driven_km=[math.nan] * 2, errored=[1.0] * 2)
    )["failures_per_km"]
    assert math.isnan(nothing["mean"])
    assert nothing["n"] == 0


def test_a_paired_difference_uses_shared_scenes_and_is_narrower_than_unpaired_ones():
    generator = torch.Generator().manual_seed(3)
    base = torch.rand(60, generator=generator) * 10
    ours, features = rows_of(
        (base + 1 + 0.1 * torch.rand(60, generator=generator)).tolist(), name="progress"
    )
    theirs, other = rows_of(base.tolist(), name="progress")
    result = paired_differences(
        ours[:50],
        features[:50],
        other_rows=theirs[10:],
        other_samples=other[10:],
        draws=300,
        realism_draws=2,
    )
    assert result["progress"]["n"] == 40
    assert (
        1.0
        < result["progress"]["low"]
        < result["progress"]["difference"]
        < result["progress"]["high"]
        < 1.1
    )
    mine = brief(ours, features)["progress"]
    assert mine["high"] - mine["low"] > 10 * (
        result["progress"]["high"] - result["progress"]["low"]
    )


def test_paired_ratios_compare_the_two_groups_own_collisions():
    nan = math.nan
    ours = rows_of([1.0, 1.0, nan, nan], name="rir")
    theirs = rows_of([nan, 0.0, 1.0, nan], name="rir")
    result = differences(ours, theirs, draws=300)["rir"]
    assert result["difference"] == pytest.approx(0.5)
    assert result["n"] == 3
