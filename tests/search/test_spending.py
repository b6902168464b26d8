"""Searches with a budget: spent but not much exceeded, the same however they run, and
gone on with after a kill."""

from dataclasses import replace

import pytest
import torch

from e2rl.driving.batches import HERE, Work
from e2rl.driving.setup import Method, Setup
from e2rl.evaluation.build import build_searches
from e2rl.evaluation.check import evaluation_settings
from e2rl.evaluation.trials import PlannerTrials
from e2rl.planners.idm_planner import IDMEgo
from e2rl.run.config import load_config
from e2rl.run.errors import InputError
from e2rl.run.parts import NO_PARTS, Parts
from e2rl.search.search import RAISES, Search, SearchSettings
from e2rl.search.spending import (
    SearchMethod,
    Spending,
    in_turns,
    search_all,
    spend_together,
)
from e2rl.search.tries import TRIES, Family, Try
from e2rl.search.tries_file import failures_of, write_tries
from e2rl.sim.settings import SimSettings
from e2rl.traffic.rule_based import ConstantVelocity
from tests.prior.small import small_prior
from tests.traffic.e2.traffic_scenes import scenes, synthesizer

RULE = Family("rule", "e2", ranges={})
LATE = Family("late", "e2", ranges={"patience": 2.0})


def setup_of():
    return Setup(
        scenes(3, steps=5),
        IDMEgo(),
        ego_name="idm",
        sim=SimSettings(),
        batch=2,
        evasions=False,
    )


def plan_of():
    on = Method("e2", synthesizer(steps=2, kernels={"samples": 2}), eta=2.0)
    settings = replace(SearchSettings(), cover=1)
    return SearchMethod(
        "search", [RULE, LATE], traffic={"rule": on, "late": on}, settings=settings
    )


@pytest.fixture(scope="module")
def setup():
    return setup_of()


@pytest.fixture(scope="module")
def plan():
    return plan_of()


def spend(setup, plan, work=HERE, **settings):
    """What one search spends."""
    options = {"seed": 3, "scenes": range(3), "budget": 4.0, "unit": "tries"}
    (spent,) = spend_together([Spending(setup, plan, **options | settings)], work)
    return spent


@pytest.fixture(scope="module")
def whole(setup, plan, tmp_path_factory):
    """What one search spends, and its parts."""
    parts = Parts(tmp_path_factory.mktemp("parts"), "search")
    return spend(setup, plan, Work(processes=1, parts=parts)), parts


def timeless(tries):
    """What does not depend on the clock."""
    return [
        {name: value for name, value in row.items() if name != "seconds"}
        for row in tries
    ]


def test_a_budget_of_tries_is_spent_and_not_exceeded(whole):
    scored, tries = whole[0].scored, whole[0].tries
    assert len(scored.rows) == len(scored.samples) == len(tries)
    assert not scored.errored
    spent = [row["tries"] for row in tries]
    assert spent[-1] == pytest.approx(4.0)
    assert spent == sorted(spent)
    assert {row["seed"] // TRIES for row in tries} == {3}
    assert {row["method"] for row in tries} == {"search"}
    assert len({(row["scene_id"], row["seed"]) for row in tries}) == len(tries)


@pytest.mark.parametrize(("unit", "budget"), [("tries", 2.4), ("nfe", 25.0)])
def test_what_is_returned_is_within_the_budget(setup, plan, unit, budget):
    """Rows, samples and lines of tries; one more try would exceed it."""
    spent = spend(setup, plan, budget=budget, unit=unit)
    rows = spent.scored.rows
    lines = spent.tries
    assert len(rows) == len(spent.scored.samples) == len(lines) > 0
    cost = {"tries": [1.0] * len(rows), "nfe": [row["nfe"] for row in rows]}[unit]
    assert sum(cost) / 3 == pytest.approx(lines[-1][unit])
    assert lines[-1][unit] <= budget * (1 + 1e-9)
    assert (sum(cost) + 2 * max(cost)) / 3 > budget or unit == "nfe"


class Crashes(IDMEgo):
    """Raises at once, where the ego of a scene starts at one of the speeds."""

    def __init__(self, speeds):
        super().__init__()
        self.speeds = speeds

    def plan(self, world):
        if bool(
            torch.isin(world.scene["start"][:, 0, 3], torch.tensor(self.speeds)).any()
        ):
            raise KeyError("lane")
        return super().plan(world)


def test_a_planner_that_always_raises_does_not_use_up_the_budget(plan):
    crashing = setup_of()
    crashing.scenes.scenes["start"][:, 0, 3] = torch.tensor([6.0, 7.0, 8.0])
    spent = spend(replace(crashing, ego=Crashes([6.0, 7.0, 8.0])), plan, budget=50.0)
    assert len(spent.scored.rows) == len(spent.tries) == RAISES * 3
    assert len(spent.scored.errored) == RAISES * 3
    spent = spend(replace(crashing, ego=Crashes([7.0])), plan, budget=6.0)
    lines = spent.tries
    names = [row["scene_id"] for row in spent.scored.rows]
    crashed = crashing.scenes.scene_id[1]
    assert names.count(crashed) == RAISES < len(names) / 2
    assert all(bool(row["raised"]) == (row["scene_id"] == crashed) for row in lines)


def test_a_budget_that_ends_within_a_round_goes_to_scenes_at_random(setup, plan):
    firsts = {
        spend(setup, plan, seed=seed, budget=0.3).tries[0]["scene_id"]
        for seed in range(4)
    }
    assert len(firsts) > 1


def test_scenes_take_turns_within_a_round():
    attempts = [
        Try(scene, number, "", seed=0, decisions=())
        for scene, number in [(0, 4), (0, 5), (1, 2), (2, 0), (2, 1)]
    ]
    turns = in_turns(attempts, [2, 0, 1])
    assert [turn[:2] for turn in turns] == [(1, 2), (2, 0), (0, 4), (2, 1), (0, 5)]


def test_processes_change_nothing(setup, plan, whole):
    forked = spend(setup, plan, Work(processes=2, parts=NO_PARTS))
    assert timeless(forked.tries) == timeless(whole[0].tries)


def test_a_search_beside_another_finds_what_it_finds_alone(setup, plan, whole):
    """The other has a third of the budget, so that its rounds end first."""
    options = {"setup": setup, "method": plan, "scenes": range(3), "unit": "tries"}
    other = Spending(seed=4, budget=1.4, **options)
    same = Spending(seed=3, budget=4.0, **options)
    (alone,) = spend_together([other])
    for processes in (1, 2):
        spent, beside = spend_together([same, other], Work(processes=processes))
        assert timeless(spent.tries) == timeless(whole[0].tries)
        assert timeless(beside.tries) == timeless(alone.tries)


def test_a_search_goes_on_where_it_was_killed(setup, plan, whole):
    spent, parts = whole
    files = sorted(parts.folder.rglob("tries-*.pt"))
    assert len(files) > 2
    times = {file: file.stat().st_mtime_ns for file in files[:-2]}
    for file in files[-2:]:
        file.unlink()
    again = spend(setup, plan, Work(processes=1, parts=parts))
    assert timeless(again.tries) == timeless(spent.tries)
    assert {file: file.stat().st_mtime_ns for file in times} == times, (
        "what was done is not done again"
    )
    assert sorted(parts.folder.rglob("tries-*.pt")) == files


def test_the_tries_that_hit_an_ego_are_driven_again_as_they_were(
    setup, plan, whole, tmp_path
):
    spent, _ = whole
    lines = spent.tries
    rows = spent.scored.rows
    chosen = [k for k in range(len(lines)) if k % 3 != 1]
    write_tries(
        tmp_path / "tries.csv",
        [row | {"margin": 0.5 if k in chosen else -1.0} for k, row in enumerate(lines)],
    )
    parts = failures_of(tmp_path / "tries.csv", "idm", method=plan, setup=setup)
    again = {}
    for part, method, tasks in parts:
        scored = part.score(method, tasks)
        again |= {(row["scene_id"], row["seed"]): row for row in scored.rows}
    keys = [(lines[k]["scene_id"], lines[k]["seed"]) for k in chosen]
    before = {
        (row["scene_id"], row["seed"]): row
        for row in rows
        if (row["scene_id"], row["seed"]) in keys
    }
    assert again.keys() == before.keys()
    assert len(before) == len(chosen) > 4
    for key, row in before.items():
        for name in ("progress", "min_dtc", "transport"):
            assert again[key][name] == pytest.approx(row[name], rel=1e-3, abs=1e-3), (
                name
            )
    measured = PlannerTrials(
        setup, [], seeds=[0], make=lambda _: setup.ego, failures=parts
    )({})
    assert measured["progress"] == pytest.approx(
        sum(row["progress"] for row in before.values()) / len(before), rel=1e-3
    )


def test_tries_that_are_not_of_this_search_are_refused(setup, plan, tmp_path):
    lines = spend(setup, plan, budget=1.0).tries
    file = tmp_path / "tries.csv"
    with pytest.raises(InputError, match="no table of a search's tries"):
        failures_of(file, "idm", method=plan, setup=setup)
    write_tries(file, [row | {"margin": -1.0} for row in lines])
    with pytest.raises(InputError, match="no try of search hits idm"):
        failures_of(file, "idm", method=plan, setup=setup)
    for change, message in (
        ({"family": "other"}, "family other"),
        ({"scene_id": "elsewhere"}, "scene=elsewhere"),
    ):
        write_tries(file, [row | {"margin": 1.0} | change for row in lines])
        with pytest.raises(InputError, match=message):
            failures_of(file, "idm", method=plan, setup=setup)
    write_tries(file, [row | {"margin": 1.0} for row in lines])
    with pytest.raises(InputError, match="a try of Own depends on those before it"):
        failures_of(
            file,
            "idm",
            method=replace(plan, search=type("Own", (Search,), {})),
            setup=setup,
        )


def test_a_method_that_evaluates_no_network_has_no_budget_of_evaluations(setup):
    traffic = {"still": Method("still", ConstantVelocity(), eta=0.0)}
    still = SearchMethod(
        "still",
        [Family("still", "still", ranges={})],
        traffic=traffic,
        settings=SearchSettings(),
    )
    with pytest.raises(
        InputError, match="still evaluate no network.*budget_unit=tries"
    ):
        search_all([setup], [plan_of(), still], budget=640.0, unit="nfe", seeds=[0])


def test_a_line_for_each_try(setup, plan, tmp_path):
    lines = spend(setup, plan, budget=1.0).tries
    write_tries(tmp_path / "tries.csv", lines)
    assert len((tmp_path / "tries.csv").read_text().splitlines()) == 1 + len(lines)


def plans(*overrides):
    config = load_config("evaluate", ["budget=640", *overrides])
    settings = evaluation_settings(config)
    return build_searches(config, small_prior(), settings.eta[0])


def test_a_row_for_each_method_and_variant_and_its_families_from_the_configuration():
    portfolio, e2, other = plans(
        "methods=[search,e2]", "+variants.other={search.cover: 3}"
    )
    assert [searched.name for searched in (portfolio, e2, other)] == [
        "search",
        "e2",
        "other",
    ]
    assert len(portfolio.families) > 3
    assert {family.name for family in portfolio.families} == set(portfolio.traffic)
    assert (len(e2.families), e2.settings.bandit) == (1, False)
    assert other.settings == replace(portfolio.settings, cover=3)
    assert len(other.families) == len(portfolio.families)


def test_no_family_of_the_search_is_told_the_plan_of_the_ego():
    (portfolio,) = plans("methods=[search]")
    assert {method.traffic.knowledge for method in portfolio.traffic.values()} == {
        "predicted"
    }


def test_a_variant_of_the_prior_is_driven_by_its_own():
    e2, short = plans("methods=[e2]", "+variants.short={prior.sampler.steps: 2}")
    assert (
        short.traffic["short"].traffic.prior.sampler.steps
        == 2
        < e2.traffic["e2"].traffic.prior.sampler.steps
    )


class Broken(ConstantVelocity):
    def reset(self, *options):
        raise RuntimeError("broken")


def test_tries_that_error_cost_what_they_are_said_to_cost(setup):
    broken = Method("broken", Broken(), eta=0.0)
    plan = SearchMethod(
        "search",
        [Family("broken", "broken", ranges={}, nfe=100.0)],
        traffic={"broken": broken},
        settings=SearchSettings(),
    )
    for budget, unit, tries in (
        (400.0, "nfe", 4),
        (3.0, "tries", 3),
        (1.0, "seconds", 2),  # those of the first round
    ):
        spent = spend(setup, plan, seed=0, budget=budget, unit=unit)
        rows = spent.scored.rows
        assert not spent.tries
        assert len(rows) == len(spent.scored.errored) == 3 * tries
        assert all(row["errored"] == 1 for row in rows)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("search.families=null", "name at least one"),
        ("+search.families.odd={method: e3}", "e3"),
        ("+search.families.odd={speed: 1}", r"search\.families\.odd: decision speed"),
        (
            "+search.families.odd={changes: {reselekt: 1}}",
            r"search\.families\.odd\.changes",
        ),
        (
            "+search.families.odd={method: ccdiff, patience: 2}",
            r"search\.families\.odd\.patience: ccdiff",
        ),
        ("eta=[1,2]", "one intensity"),
    ],
)
def test_what_cannot_be_searched_is_told(override, words):
    with pytest.raises(InputError, match=words):
        plans("methods=[search]", override)


def test_what_each_batch_scored_is_watched(setup, plan, whole):
    spent, parts = whole
    batches = []
    spend(setup, plan, Work(parts=parts, watch=batches.append))
    rows = [row for scored in batches for row in scored.rows]
    keys = {(row["scene_id"], row["seed"]) for row in rows}
    assert {(row["scene_id"], row["seed"]) for row in spent.scored.rows} <= keys
