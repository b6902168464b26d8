"""The table of spreads: who has a row, and a ratio of 1 where the sampler takes the
many steps itself."""

import pytest

from e2rl.evaluation import open_loop
from e2rl.evaluation.open_loop import spread_rows
from e2rl.evaluation.protocol import Method
from e2rl.metrics.catalogue import SPREAD_STAGE, STAGES
from e2rl.prior.sde import SamplerSettings
from e2rl.traffic.nominal import NominalTraffic
from e2rl.traffic.rule_based import ConstantVelocity
from tests.prior.small import small_prior
from tests.traffic.e2.traffic_scenes import scenes, synthesizer


def test_the_prior_alone_has_a_row_and_many_steps_are_their_own_measure(monkeypatch):
    monkeypatch.setattr(open_loop, "MANY", 6)
    few, many = (
        NominalTraffic(small_prior(sampler=SamplerSettings(steps=steps)))
        for steps in (2, 6)
    )
    methods = [
        Method("cv", ConstantVelocity()),
        Method("few", few),
        Method("many", many),
    ]
    rows = spread_rows(
        scenes(3), [*methods, Method("e2", synthesizer(), eta=2.0)], samples=4
    )
    assert [row["method"] for row in rows] == ["few", "many"]
    for row in rows:
        assert row["stage"] == SPREAD_STAGE and set(row["metrics"]) == {
            each.name for each in STAGES[SPREAD_STAGE]
        }
    own = rows[1]["metrics"]
    assert [
        own[f"{name}_ratio"]["mean"] for name in ("knot_variance", "travel_std")
    ] == pytest.approx([1.0, 1.0])
    assert rows[0]["metrics"]["knot_variance_ratio"]["mean"] != pytest.approx(
        1.0, abs=0.01
    )
