"""Intervals: coverage, pooling, pairing, and what is unknown."""

import math

import pytest
import torch
from scipy.stats import binom, binomtest

from e2rl.metrics.realism import KINEMATICS, OF_ADVERSARIES
from e2rl.metrics.score import score_rollouts
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
from tests.metrics.random_rollouts import random_rollouts


def rows_of(values, clusters=None, name="cfr", **columns):
    """Rows that know one metric, one scene each, and features without samples."""
    empty = {key: torch.zeros(2, 0, dtype=torch.float64) for key in (*KINEMATICS, *OF_ADVERSARIES)}
    rows = [
        {"scene_id": f"s{index}", "location": str(clusters[index]) if clusters else "", "seed": 0, name: value}
        | {key: column[index] for key, column in columns.items()}
        for index, value in enumerate(values)
    ]
    return rows, [empty] * len(rows)


def brief(rows, features):
    return summarise(rows, features, draws=300, realism_draws=2)


def test_intervals_cover_the_truth_in_about_95_of_100_cases_when_rollouts_come_in_clusters():
    """Rates that vary between locations; treating the rollouts as independent would cover in about 70 of 100."""
    generator = torch.Generator().manual_seed(0)
    clusters, members, trials = 40, 8, 400
    rates = torch.distributions.Beta(1.0, 2.0)
    torch.manual_seed(0)
    chance = rates.sample((trials, clusters, 1)).double()
    values = (torch.rand(trials, clusters, members, generator=generator) < chance).double()
    cluster = torch.arange(clusters).repeat_interleave(members)
    draws = bootstrap_draws(clusters, 400)
    means = resampled_means(values.flatten(1).T, torch.ones(clusters * members, trials).double(), cluster, draws)
    low, high = means[1:].quantile(torch.tensor([0.025, 0.975], dtype=torch.float64), dim=0)
    covered = ((low <= 1 / 3) & (high >= 1 / 3)).double().mean().item()
    assert 0.91 <= covered <= 0.98, covered
    alone = torch.arange(clusters * members)
    means = resampled_means(
        values.flatten(1).T, torch.ones(len(alone), trials).double(), alone, bootstrap_draws(len(alone), 400)
    )
    low, high = means[1:].quantile(torch.tensor([0.025, 0.975], dtype=torch.float64), dim=0)
    assert ((low <= 1 / 3) & (high >= 1 / 3)).double().mean().item() < covered - 0.08


def test_locations_are_clusters_and_logs_where_there_is_none():
    rows = [
        {"location": place, "scene_id": name}
        for place, name in (("a", "1"), ("a", "2"), ("", "1"), ("", "1"), ("", "2"), ("1", "9"))
    ]
    cluster, count = cluster_index(rows)
    assert count == 4 and cluster[0] == cluster[1] and cluster[2] == cluster[3] != cluster[4]
    assert cluster[5] not in cluster[:5].tolist(), "a location and a scene of the same name are different clusters"
    windows = [{"location": "", "scene_id": name} for name in ("log@11", "log@102", "other@11")]
    cluster, count = cluster_index(windows)
    assert count == 2 and cluster[0] == cluster[1] != cluster[2], "the windows of a log are one"


def test_unknown_values_are_left_out_and_counted_and_never_zero():
    table = brief(*rows_of([1.0, math.nan, 0.0, math.nan], name="relvel"))
    assert table["relvel"]["n"] == 2 and table["relvel"]["mean"] == 0.5
    assert table["progress"]["n"] == 0 and math.isnan(table["progress"]["mean"])
    assert table["real"]["n"] == 0 and math.isnan(table["real"]["mean"])


def test_a_median_draw_is_the_median_of_the_repeated_values():
    generator = torch.Generator().manual_seed(0)
    values, cluster = torch.rand(41, generator=generator).double(), torch.randint(6, (41,), generator=generator)
    values[::7] = torch.nan
    draws = torch.cat([bootstrap_draws(6, 20), torch.zeros(1, 6, dtype=torch.float64)])
    medians = resampled_medians(values, cluster, draws)
    for draw, median in zip(draws[:-1], medians[:-1], strict=True):
        repeated = values.repeat_interleave(draw[cluster].long())
        assert median.item() == pytest.approx(repeated.nanquantile(0.5, interpolation="midpoint").item())
    assert medians[-1].isnan() and resampled_medians(values * torch.nan, cluster, draws).isnan().all()
    table = brief(*rows_of([1.0, math.nan, 9.0, 2.0], name="contact_time"))["contact_time"]
    assert (table["mean"], table["n"]) == (2.0, 3)


def test_fewer_than_ten_places_give_no_interval():
    for name in ("cfr", "progress", "relvel"):
        values = torch.linspace(0, 1, 30).tolist()
        few = brief(*rows_of(values[:27], clusters=list("abcdefghi") * 3, name=name))[name]
        many = brief(*rows_of(values, clusters=list("abcdefghij") * 3, name=name))[name]
        assert math.isnan(few["low"]) and math.isnan(few["high"]) and few["n"] == 27
        assert many["low"] < many["mean"] < many["high"]


@pytest.mark.parametrize("level", [0.95, 0.975])
@pytest.mark.parametrize(("events", "places"), [(0, 12), (1, 12), (3, 12), (12, 12), (2, 100), (97, 100)])
def test_few_events_have_the_interval_of_clopper_and_pearson(events, places, level):
    expected = binomtest(events, places).proportion_ci(level, "exact")
    assert exact_interval(events / places, places, level) == pytest.approx(tuple(expected), abs=1e-9)
    if level == 0.95:
        found = brief(*rows_of([1.0] * events + [0.0] * (places - events)))["cfr"]
        assert (found["low"], found["high"]) == pytest.approx(tuple(expected), abs=1e-9)


def test_the_bootstrap_takes_over_from_ten_places_with_and_ten_without_an_event():
    for events, exact in ((9, True), (10, False), (30, False), (31, True)):
        found = brief(*rows_of([1.0] * events + [0.0] * (40 - events)))["cfr"]
        assert ((found["low"], found["high"]) == pytest.approx(exact_interval(events / 40, 40), abs=1e-9)) == exact


def test_rollouts_at_one_place_are_one_trial():
    """24 events in 120 rollouts at 40 places, all of them at eight: as 20% of 40, not of 120."""
    values = [1.0] * 24 + [0.0] * 96
    found = brief(*rows_of(values, clusters=[index // 3 for index in range(120)]))["cfr"]
    assert (found["low"], found["high"]) == pytest.approx(exact_interval(0.2, 40)) and found["n"] == 120


def test_exact_intervals_cover_rare_events_in_95_of_100_cases_at_least():
    """The exact probability of the outcomes whose interval holds the truth, over all rates; at 90% it would be less."""
    places, worst = 30, 1.0
    bounds = [exact_interval(k / places, places) for k in range(places + 1)]
    for rate in torch.linspace(0.005, 0.5, 200).tolist():
        covered = sum(binom.pmf(k, places, rate) for k, (low, high) in enumerate(bounds) if low <= rate <= high)
        worst = min(worst, covered)
    assert 0.95 <= worst < 0.97


def test_the_interval_of_a_mean_has_the_width_of_95_per_cent():
    values = torch.randn(400, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    found = summarise(*rows_of(values.tolist(), name="progress"), draws=4000, realism_draws=2)["progress"]
    width = 2 * 1.96 * values.std().item() / 400**0.5
    assert found["high"] - found["low"] == pytest.approx(width, rel=0.05)
    assert interval(torch.arange(1001.0).double(), 10)["low"] == pytest.approx(1 + 0.025 * 999)


def test_draws_that_agree_and_ratios_of_few_events_have_no_interval():
    assert math.isnan(brief(*rows_of([3.0] * 40, name="progress"))["progress"]["low"])
    few, many = (brief(*rows_of([1.0] * n + [0.0] * (60 - n), driven_km=[0.1] * 60)) for n in (9, 10))
    assert math.isnan(few["failures_per_km"]["low"]) and few["failures_per_km"]["mean"] == pytest.approx(1.5)
    assert many["failures_per_km"]["low"] < 10 / 6 < many["failures_per_km"]["high"]


def test_a_difference_of_rare_events_lies_between_the_differences_of_their_bounds():
    ours, theirs = rows_of([1.0] * 8 + [0.0] * 42), rows_of([0.0] * 49 + [1.0])
    found = paired_differences(*ours, *theirs, draws=50, realism_draws=2)["cfr"]
    (low, high), (other_low, other_high) = (exact_interval(k / 50, 50, 0.975) for k in (8, 1))
    assert found["difference"] == pytest.approx(0.14)
    assert (found["low"], found["high"]) == pytest.approx((low - other_high, high - other_low))
    six = paired_differences(*rows_of([0.0] * 6), *rows_of([1.0] * 2 + [0.0] * 4), draws=50, realism_draws=2)["cfr"]
    assert six["difference"] == pytest.approx(-1 / 3) and math.isnan(six["low"]) and math.isnan(six["high"])
    same = paired_differences(*ours, *ours, draws=50, realism_draws=2)["cfr"]
    assert same["difference"] == 0 and same["low"] == -same["high"] < 0


def test_off_road_share_is_pooled_over_vehicle_steps():
    table = brief(*rows_of([0.5, 0.0, math.nan], name="aor_step", aor_vehicle_steps=[10, 90, 0]))
    assert table["aor_step"]["mean"] == pytest.approx(0.05) and table["aor_step"]["n"] == 2


def test_failures_per_kilometre_are_all_failures_over_all_kilometres():
    ours = rows_of([1.0, 0.0, math.nan, 1.0], driven_km=[0.1, 0.3, 5.0, 0.1])
    theirs = rows_of([0.0, 0.0, 1.0, 1.0], driven_km=[0.2, 0.2, 5.0, 0.6])
    table = brief(*ours)["failures_per_km"]
    assert table["mean"] == pytest.approx(2 / 0.5) and table["n"] == 3
    paired = paired_differences(*ours, *theirs, draws=300, realism_draws=2, relative=True)["failures_per_km"]
    assert paired["difference"] == pytest.approx(4 - 1) and paired["n"] == 3
    assert paired["relative"] == pytest.approx(3.0)


def test_a_paired_difference_uses_shared_scenes_and_is_narrower_than_unpaired_ones():
    generator = torch.Generator().manual_seed(3)
    base = torch.rand(60, generator=generator) * 10
    ours, features = rows_of((base + 1 + 0.1 * torch.rand(60, generator=generator)).tolist(), name="progress")
    theirs, other = rows_of(base.tolist(), name="progress")
    result = paired_differences(ours[:50], features[:50], theirs[10:], other[10:], draws=300, realism_draws=2)
    assert result["progress"]["n"] == 40
    assert 1.0 < result["progress"]["low"] < result["progress"]["difference"] < result["progress"]["high"] < 1.1
    own = brief(ours, features)["progress"]
    assert own["high"] - own["low"] > 10 * (result["progress"]["high"] - result["progress"]["low"])


def test_paired_ratios_compare_the_two_groups_own_collisions():
    nan = math.nan
    ours, theirs = rows_of([1.0, 1.0, nan, nan], name="rir"), rows_of([nan, 0.0, 1.0, nan], name="rir")
    result = paired_differences(*ours, *theirs, draws=300, realism_draws=2)["rir"]
    assert result["difference"] == pytest.approx(0.5) and result["n"] == 3


def test_groups_without_a_shared_scene_have_no_difference():
    ours, theirs = rows_of([1.0, 0.0]), rows_of([1.0, 0.0])
    for row in theirs[0]:
        row["seed"] = 7
    result = paired_differences(*ours, *theirs, draws=50, realism_draws=2)
    assert all(math.isnan(value["difference"]) and value["n"] == 0 for value in result.values())


def test_a_method_does_not_differ_from_itself():
    rows, features = score_rollouts(random_rollouts(8))
    result = paired_differences(rows, features, rows, features, draws=50, realism_draws=5)
    assert all(value["difference"] == 0 or math.isnan(value["difference"]) for value in result.values())
    assert result["real"]["difference"] == 0


def test_the_order_of_rows_and_the_draws_seed_fix_the_interval():
    rows, features = score_rollouts(random_rollouts(8))
    first = summarise(rows, features, draws=50, realism_draws=5)
    again = summarise(rows[::-1], features[::-1], draws=50, realism_draws=5)
    for name, value in first.items():
        assert again[name] == pytest.approx(value, nan_ok=True), name


def test_rows_and_features_must_belong_together():
    rows, features = rows_of([1.0, 0.0])
    with pytest.raises(ValueError, match="2 rows but 1 samples"):
        summarise(rows, features[:1])
