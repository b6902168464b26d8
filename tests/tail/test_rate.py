"""Rates of an ego in synthetic scenes: the same over processes, and after a kill."""

from dataclasses import replace

import pytest

from e2rl.api import load_prior, make_ego, make_traffic
from e2rl.driving.batches import Work
from e2rl.driving.setup import Setup
from e2rl.planners.ego import Ego
from e2rl.run.parts import Parts
from e2rl.sim.settings import SimSettings
from e2rl.tail.population import vehicle_effect
from e2rl.tail.rate import Rating
from e2rl.tail.sampler import ALONE, REACHED
from e2rl.tail.settings import METHODS, RateSettings
from e2rl.tail.summary import rates_of, scene_rates
from tests.synthetic import make_scenes

STEPS = 20
SETTINGS = RateSettings(
    method="subset",
    target="contact",
    repetitions=2,
    first=8,
    particles=8,
    moves=1,
    rollouts=24,
    least=1e-3,
    together=1,
)


def rating(scenes, ego=None, settings=SETTINGS):
    setup = Setup(
        scenes,
        ego or make_ego("idm"),
        ego_name="idm",
        sim=SimSettings(),
        batch=8,
    )
    prior = load_prior(sampler={"steps": 2})
    return Rating(setup, make_traffic("nominal", prior), settings)


class Crash(Ego):
    """Raises in every rollout."""

    def act(self, observation):
        raise RuntimeError("no plan")

    plan = act


@pytest.fixture(scope="module")
def scenes():
    return make_scenes(2, steps=STEPS)


@pytest.fixture(scope="module")
def estimates(scenes):
    return rating(scenes).estimates(Work())


def test_every_scene_has_a_population(scenes, estimates):
    assert {part.scene for part in estimates} == {0, 1}
    assert all(part.tally.end for part in estimates)
    assert all(part.tally.rollouts <= SETTINGS.rollouts for part in estimates)


@pytest.fixture(scope="module")
def of_processes(scenes, tmp_path_factory):
    """What two processes estimated, and the work whose parts are on disk."""
    work = Work(processes=2, parts=Parts(tmp_path_factory.mktemp("run"), "rate"))
    return rating(scenes).estimates(work), work


def test_processes_do_not_change_it(estimates, of_processes):
    assert of_processes[0] == estimates


def test_what_is_on_disk_is_not_driven_again(scenes, of_processes, monkeypatch):
    results, work = of_processes
    monkeypatch.setattr(Rating, "_drive", lambda *_: pytest.fail("driven again"))
    assert rating(scenes).estimates(work) == results


def test_a_planner_that_raises_fails_surely():
    scenes = make_scenes(1, steps=STEPS)
    parts = rating(scenes, Crash()).estimates(Work())
    rates = scene_rates(parts, scenes, target="contact")
    assert [scene.bounds.value for scene in rates] == [1]
    assert all(scene.end == REACHED for scene in rates)
    assert all(scene.raised == scene.rollouts for scene in rates)


def test_plain_rollouts_are_one_population_of_each_scene(scenes):
    settings = replace(SETTINGS, method="plain", rollouts=8)
    parts = rating(scenes, Crash(), settings).estimates(Work())
    assert [(part.scene, part.repetition) for part in parts] == [(0, 0), (1, 0)]
    assert [part.tally.hits for part in parts] == [8, 8]


@pytest.mark.parametrize("method", METHODS)
def test_a_planner_that_raises_where_nobody_drives_fails_surely(method):
    alone = make_scenes(1, steps=STEPS)
    alone.scenes["valid"][:, 1:] = False
    alone.scenes["logged_valid"][:, :, 1:] = False
    settings = replace(SETTINGS, method=method, repetitions=1)
    (part,) = rating(alone, Crash(), settings).estimates(Work())
    assert part.tally.end == REACHED
    assert part.tally.probability == 1


def test_scenes_without_driven_vehicles_leave_nothing_to_chance(scenes):
    alone = make_scenes(1, steps=STEPS)
    alone.scenes["valid"][:, 1:] = False
    alone.scenes["logged_valid"][:, :, 1:] = False
    assert not vehicle_effect(rating(alone).setup, 0).any()
    (part,) = rating(alone).estimates(Work())
    assert part.tally.end == ALONE
    assert part.tally.bound == 0


def test_vehicles_nearer_to_the_ego_are_expected_to_matter_more(scenes):
    effect = vehicle_effect(rating(scenes).setup, 0)
    start = scenes.batch([0])["start"][0, : len(effect)]
    distance = (start[:, :2] - start[:1, :2]).norm(dim=-1)
    driven = effect > 0
    assert driven.any()
    assert not driven[0]
    assert (effect <= 1).all()
    order = distance[driven].argsort()
    assert (effect[driven][order].diff() <= 0).all()


def test_rates_are_sums_over_scenes_per_exposure(scenes, estimates):
    rates = scene_rates(estimates, scenes, target="contact")
    contact = rates_of(rates, steps=STEPS)["contact"]
    mean = sum(scene.probability["contact"].mean() for scene in rates) / 2
    assert contact["scene"].value == pytest.approx(float(mean))
    assert contact["hour"].value == pytest.approx(float(mean) * 3600 / 2)
