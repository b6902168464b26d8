"""The search: it asks the same of whoever tells the same, and learns where failures
are."""

from dataclasses import replace

import torch

from e2rl.metrics.margin import PREVENTED
from e2rl.search.search import RAISES, ROUND, SHARED, Outcome, Search, SearchSettings
from e2rl.search.tries import Family

FAMILIES = [
    Family(name, "e2", ranges={"moment": (1.0, 5.0)})
    for name in ("good", "poor", "idle")
]
CHANCE = {"good": 0.5, "poor": 0.05, "idle": 0.0}
PLAIN = SearchSettings()


def search_of(scenes=40, seed=0, settings=PLAIN, families=FAMILIES):
    return Search(families, range(100, 100 + scenes), seed=seed, settings=settings)


def told(search, rounds, hopeless=()):
    """What a planner is like that fails by chance; in `hopeless` scenes nobody ever
    comes near."""
    for _ in range(rounds):
        tries = search.ask()
        outcomes = []
        for single in tries:
            luck = torch.rand(
                (),
                generator=torch.Generator().manual_seed(
                    hash((single.scene, single.seed)) % 2**31
                ),
            ).item()
            fails = (
                luck < CHANCE.get(single.family, 0.0) and single.scene not in hopeless
            )
            margin = PREVENTED if fails else -25.0 if single.scene in hopeless else -2.0
            outcomes.append(
                Outcome(
                    margin,
                    f"cell {single.scene} {single.number}" if fails else "",
                    nfe=100.0,
                )
            )
        search.tell(tries, outcomes)
    return search


def tries_of(search):
    return [single for scene in search.tries for single in scene]


def test_the_same_answers_lead_to_the_same_questions():
    assert tries_of(told(search_of(), 6)) == tries_of(told(search_of(), 6))
    assert tries_of(told(search_of(), 6)) != tries_of(told(search_of(seed=1), 6))


def test_every_scene_is_tried_before_any_is_tried_more():
    search = told(search_of(), PLAIN.cover)
    assert {len(tries) for tries in search.tries} == {PLAIN.cover}


def test_a_round_of_few_scenes_has_as_many_tries_as_a_batch_is_worth_and_covers_them_all():
    several = [Family(f"family {k}", "e2", ranges={}) for k in range(12)]
    CHANCE.update({family.name: 0.0 for family in several})
    search = search_of(scenes=5, settings=replace(PLAIN, cover=7), families=several)
    first = search.ask()
    assert (
        len({(single.scene, single.family) for single in first})
        == len(first)
        == ROUND + 1
    )  # five of each of five scenes
    search.tell(first, [Outcome(-2.0, "", nfe=100.0)] * len(first))
    assert {len(tries) for tries in told(search, 1).tries} == {7}
    assert len(search.ask()) == ROUND


def test_one_family_is_tried_as_often_at_once_as_a_batch_is_worth():
    search = search_of(scenes=8, families=FAMILIES[:1])
    tries = search.ask()  # of the cover
    assert [single.number for single in tries] == [0, 1] * 8
    search.tell(tries, [Outcome(-2.0, "", nfe=100.0)] * len(tries))
    assert [single.number for single in search.ask()] == [2, 3, 4] * 8


def test_no_family_is_tried_twice_at_once_before_all_are_tried():
    search = search_of(scenes=2)  # of three families
    families = [single.family for single in search.ask()]
    assert [len(set(families[:2])), len(set(families[2:]))] == [2, 2]


def test_rounds_grow_with_the_tries_so_far():
    several = [Family(f"family {k}", "e2", ranges={}) for k in range(12)]
    CHANCE.update({family.name: 0.0 for family in several})
    search = told(
        search_of(settings=replace(PLAIN, growth=0.5), families=several),
        PLAIN.cover + 1,
    )
    for _ in range(4):
        requests = search.ask()
        assert len(requests) == min(max(40, len(tries_of(search)) // 2), 40 * 12 // 4)
        assert len({(single.scene, single.family) for single in requests}) == len(
            requests
        )
        search.tell(requests, [Outcome(-2.0, "", nfe=100.0)] * len(requests))
    assert len(search.ask()) == 120


def test_a_round_is_of_few_families_each_of_which_is_a_batch():
    many = [replace(FAMILIES[0], name=str(number)) for number in range(15)]
    search = told(search_of(scenes=12, families=many), PLAIN.cover)
    tries = search.ask()
    assert len(tries) == ROUND
    assert len({single.family for single in tries}) <= ROUND // SHARED


def test_a_family_that_nearly_finds_is_tried_more():
    families = [Family(name, "e2", ranges={}) for name in ("near", "far", "away")]

    def share(margin):
        search = search_of(settings=replace(PLAIN, again=1.0), families=families)
        for _ in range(15):
            tries = search.ask()
            outcomes = [
                Outcome(margin if single.family == "near" else -2.0, "", nfe=100.0)
                for single in tries
            ]
            search.tell(tries, outcomes)
        tries = tries_of(search)
        return sum(single.family == "near" for single in tries) / len(tries)

    assert share(margin=0.9) > 1.4 * share(margin=-2.0)


def test_tries_go_to_the_family_that_finds_and_not_to_hopeless_scenes():
    search = told(search_of(), 20, hopeless=range(20))
    counts = {
        name: sum(single.family == name for single in tries_of(search))
        for name in CHANCE
    }
    assert counts["good"] > 2 * counts["poor"]
    assert counts["good"] > 2 * counts["idle"]
    hopeless, others = (
        sum(map(len, part)) for part in (search.tries[:20], search.tries[20:])
    )
    assert others > 1.25 * hopeless


def test_it_finds_more_scenes_than_chance_at_equal_cost():
    idle = [Family(f"idle {k}", "e2", ranges={}) for k in range(6)]
    CHANCE.update({family.name: 0.0 for family in idle})

    def found(bandit, seed):
        settings = replace(PLAIN, bandit=bandit, cover=1)
        search = told(
            search_of(seed=seed, settings=settings, families=[FAMILIES[0], *idle]), 5
        )
        return sum(any(outcome.cell for outcome in scene) for scene in search.outcomes)

    learnt, blind = (
        sum(found(bandit, seed) for seed in range(5)) for bandit in (True, False)
    )
    assert learnt > 1.2 * blind


def crashing(scenes, rounds=30):
    """A search against a planner that always raises in some of 12 scenes and never
    fails in the others."""
    search = search_of(scenes=12)
    for _ in range(rounds):
        tries = search.ask()
        search.tell(
            tries,
            [
                Outcome(-2.0, "", nfe=100.0, raised=single.scene in scenes)
                for single in tries
            ],
        )
    return search


def test_no_more_tries_are_spent_where_the_planner_always_raises():
    search = crashing({2, 5, 7})
    assert search.active() == [0, 1, 3, 4, 6, 8, 9, 10, 11]
    assert all(len(search.tries[scene]) == RAISES for scene in (2, 5, 7))
    assert min(len(search.tries[scene]) for scene in search.active()) > 3 * RAISES
    assert crashing(range(12)).ask() == []


def test_a_planner_that_raises_has_failed_in_a_way_of_its_own():
    search = search_of(scenes=2, settings=replace(PLAIN, cover=1))
    tries = search.ask()
    search.tell(tries, [Outcome(-30.0, "", nfe=100.0, raised=True) for _ in tries])
    assert search.cells == {"raised"}
    assert all(search._has_failure(scene) for scene in (0, 1))
