"""The table of spreads: who has a row, and a ratio of 1 where the sampler takes the
many steps itself."""

import pytest

from e2rl.driving.setup import Method
from e2rl.evaluation import spread_table
from e2rl.evaluation.spread_table import spread_rows
from e2rl.metrics.catalogue import SPREAD_STAGE, STAGES
from e2rl.prior.sde import SamplerSettings
from e2rl.traffic.nominal import NominalTraffic
from e2rl.traffic.rule_based import ConstantVelocity
from tests.prior.small import small_prior
from tests.traffic.e2.traffic_scenes import scenes, synthesizer


@pytest.fixture
def rows(monkeypatch):
    """Of a prior of 2 and one of 6 steps, where 6 are the many steps."""
    monkeypatch.setattr(spread_table, "MANY_STEPS", 6)
    methods = [
        Method("cv", ConstantVelocity()),
        *(
            Method(
                name, NominalTraffic(small_prior(sampler=SamplerSettings(steps=steps)))
            )
            for name, steps in (("few", 2), ("many", 6))
        ),
        Method("e2", synthesizer(), eta=2.0),
    ]
    return spread_rows(scenes(3), methods, samples=4)


def test_the_prior_alone_has_a_row_with_every_metric_of_the_stage(rows):
    assert [row["method"] for row in rows] == ["few", "many"]
    for row in rows:
        assert row["stage"] == SPREAD_STAGE
        assert set(row["metrics"]) == {metric.name for metric in STAGES[SPREAD_STAGE]}


def test_many_steps_are_their_own_measure(rows):
    few, many = (row["metrics"] for row in rows)
    for name in ("knot_variance", "travel_std"):
        assert many[f"{name}_ratio"]["mean"] == pytest.approx(1.0)
    assert few["knot_variance_ratio"]["mean"] != pytest.approx(1.0, abs=0.01)
