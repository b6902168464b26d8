"""Every configuration of learner, curriculum and logger builds and runs."""

from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import open_dict

from e2rl.errors import InputError
from e2rl.learning.build import build_evolution, build_logger, run_imitation
from e2rl.learning.improvement import PlannerImprovement, PolicyImprovement
from tests.learning.small import brake_check, small_scenes

CONF = str(Path(__file__).resolve().parents[2] / "conf")
GROUPS = ("sim", "ego", "learner", "curriculum", "logger")


def config_of(*choices):
    """The groups of these rooms, as train.yaml composes them."""
    chosen = {"sim": "default", "ego": "actor", "learner": "ppo_bc", "curriculum": "adaptive", "logger": "csv"}
    chosen |= dict(choice.split("=") for choice in choices)
    with initialize_config_dir(CONF, version_base="1.3"):
        config = compose(overrides=[f"+{group}={chosen[group]}" for group in GROUPS])
    with open_dict(config):
        config.update({"seed": 0, "device": "cpu", "rounds": 2})
    return config


def small(config):
    config.learner.round.scenes = 2
    if config.learner.kind == "policy":
        config.learner.collect.update({"batch": 4, "steps": 20, "iterations": 1})
        config.learner.imitation.update({"epochs": 1, "batch": 2})
        config.ego.hidden = [16]
    else:
        config.learner.grid = {"risk_slope": [0.5]}
        config.learner.batch = 2
    return config


@pytest.mark.parametrize("curriculum", ["adaptive", "linear", "constant"])
def test_policy_learner(curriculum):
    config, scenes = small(config_of(f"curriculum={curriculum}")), small_scenes(3)
    run = build_evolution(config, scenes, instantiate(config.sim), instantiate(config.ego), brake_check(scenes))
    assert isinstance(run.improve, PolicyImprovement) and run.curriculum.settings.schedule == curriculum
    assert run.run_round()["train/expert_pairs"] > 0


def test_planner_learner():
    config, scenes = small(config_of("learner=planner_tuning", "ego=lane_graph")), small_scenes(3)
    run = build_evolution(config, scenes, instantiate(config.sim), instantiate(config.ego), brake_check(scenes))
    assert isinstance(run.improve, PlannerImprovement)
    assert run.run_round()["train/trials"] == 2


def test_imitation_stage(tmp_path):
    config, scenes = small(config_of()), small_scenes(3)
    row = run_imitation(
        config, scenes, instantiate(config.sim), instantiate(config.ego), tmp_path, build_logger(config, tmp_path)
    )
    assert row["epoch"] == 0.0 and (tmp_path / "actor.safetensors").is_file()
    assert (tmp_path / "logs/scalars/train/imitation_loss.csv").is_file()


def test_mismatched_groups_are_refused(tmp_path):
    config, scenes = small(config_of("learner=planner_tuning", "ego=lane_graph")), small_scenes(3)
    with pytest.raises(InputError, match="stage=imitation"):
        run_imitation(config, scenes, instantiate(config.sim), instantiate(config.ego), tmp_path)
    config = small(config_of())
    config.learner.kind = "guess"
    with pytest.raises(InputError, match="guess"):
        build_evolution(config, scenes, instantiate(config.sim), instantiate(config.ego), brake_check(scenes))


@pytest.mark.parametrize("kind", ["csv", "wandb", "none"])
def test_logger_groups_name_their_kind(kind):
    assert config_of(f"logger={kind}").logger.kind == kind
