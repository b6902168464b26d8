"""The package holds everything that its commands need, and its few names are what they
say."""

import tomllib
from pathlib import Path

import pytest

import e2rl
from e2rl.driving.setup import Method, Setup, Task
from e2rl.evaluation.build import build_prior, build_sim, build_traffic
from e2rl.planners.idm_planner import IDMEgo
from e2rl.run.config import load_config
from e2rl.run.errors import InputError

ROOT = Path(__file__).parents[1]


def test_every_package_and_the_configuration_are_in_the_wheel():
    setup = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    result = {
        ".".join(file.parent.relative_to(ROOT).parts)
        for file in (ROOT / "e2rl").rglob("__init__.py")
    }
    assert set(setup["packages"]) == result | {"e2rl.scripts", "e2rl.scripts.conf"}
    assert (ROOT / setup["package-dir"]["e2rl.scripts.conf"] / "evaluate.yaml").exists()
    assert (ROOT / setup["package-dir"]["e2rl.scripts"] / "train.py").exists()


def test_a_notebook_rolls_out_what_the_command_does():
    """The ten lines of e2rl.api: the rollouts do not depend on how they are asked for."""
    scenes = e2rl.load_scenes("bundled", num_scenes=2, build={"steps": 20})
    ego = e2rl.make_ego("lane_graph")
    prior = e2rl.load_prior()
    ours = e2rl.roll_out(scenes, ego, traffic=e2rl.make_traffic("e2", prior), eta=2.0)
    config = load_config("evaluate", ["num_scenes=2"])
    setup = Setup(scenes, ego, ego_name="lane_graph", sim=build_sim(config))
    traffic = build_traffic(config.synthesizer, build_prior(config)[0])
    theirs = setup.roll_out(Method("e2", traffic, eta=2.0), [Task(0, 0), Task(1, 0)])
    assert (ours.states == theirs.states).all()
    assert ours.adversaries.any()
    rows = e2rl.score(ours)
    assert [row["scene_id"] for row in rows] == scenes.scene_id
    assert {row["eta"] for row in rows} == {2.0}


def test_a_failure_is_found_in_a_few_rollouts(tmp_path):
    """Places first: with the bundled scenes the first four are of four places."""
    scenes = e2rl.load_scenes("bundled", num_scenes=12)
    result = e2rl.find_failures("lane_graph", "e2", scenes=scenes)
    assert result
    assert all(
        failure.row["cfr"] == 1 and failure.contact is not None for failure in result
    )
    assert {failure.rollout.scene_id for failure in result} <= set(scenes.scene_id)
    assert e2rl.save_video(result[0], tmp_path / "failure.gif").stat().st_size > 10_000


def test_a_class_is_no_planner():
    with pytest.raises(InputError, match="ego=IDMEgo: is a class; give an object"):
        e2rl.find_failures(IDMEgo)


def test_settings_reach_the_objects_and_wrong_ones_are_named():
    traffic = e2rl.make_traffic(
        "e2",
        e2rl.load_prior(sampler={"steps": 4}),
        support="topology",
        topology={"beta": 2.0},
    )
    assert traffic.support == "topology"
    assert traffic.topology.beta == 2.0
    assert traffic.prior.sampler.steps == 4
    with pytest.raises(InputError, match="synthesizer=e2: .*suport"):
        e2rl.make_traffic("e2", e2rl.load_prior(), suport="topology")
    with pytest.raises(InputError, match="ego=nobody"):
        e2rl.make_ego("nobody")
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = e2rl.nothing
