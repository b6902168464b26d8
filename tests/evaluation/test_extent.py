"""How many rollouts a budget is, and what a rollout costs."""

from types import SimpleNamespace

import pytest

from e2rl.driving.setup import Method, Setup
from e2rl.evaluation import extent
from e2rl.evaluation.extent import cost_of, extent_of
from e2rl.planners.idm_planner import IDMEgo
from e2rl.search.search import SearchSettings
from e2rl.search.spending import SearchMethod
from e2rl.search.tries import Family
from e2rl.sim.env import SimSettings
from e2rl.traffic.rule_based import LogReplay
from tests.synthetic import make_scenes

REPLAY = Method("replay", LogReplay())
SEARCH = SearchMethod(
    "search",
    families=[Family("a", "a", {}, nfe=100.0), Family("b", "b", {}, nfe=220.0)],
    traffic={"a": REPLAY, "b": REPLAY},
    settings=SearchSettings(),
)


@pytest.mark.parametrize(
    ("row", "budget", "unit", "tries"),
    [
        (REPLAY, None, "nfe", 1),
        (SEARCH, 640.0, "nfe", 4),
        (SEARCH, 7.0, "tries", 7),
        (SEARCH, 30.0, "seconds", 15),
    ],
)
def test_a_budget_is_so_many_rollouts(monkeypatch, row, budget, unit, tries):
    monkeypatch.setattr(extent, "cost_of", lambda setup, method: (2.0, 10.0))
    settings = SimpleNamespace(budget=budget, budget_unit=unit)
    assert extent_of(None, [row], settings, pairs=3).rollouts == 3 * tries


def test_a_rollout_costs_time_and_room():
    setup = Setup(make_scenes(2, steps=30), IDMEgo(), ego_name="idm", sim=SimSettings())
    seconds, size = cost_of(setup, REPLAY)
    assert 0 < seconds < 60
    assert 1e3 < size < 1e6
