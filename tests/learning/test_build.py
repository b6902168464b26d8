"""Every configuration of learner, curriculum and logger builds and runs, a curriculum of one's own among them."""

import pytest
from omegaconf import open_dict

from e2rl.evaluation.methods import build_ego
from e2rl.learning.bandit import BanditCurriculum
from e2rl.learning.build import build_evolution, build_logger, run_imitation
from e2rl.learning.planner_tuning import PlannerImprovement
from e2rl.learning.policy import PolicyImprovement
from e2rl.learning.run_checkpoint import load_checkpoint, save_checkpoint
from e2rl.learning.scheduler import CurriculumScheduler
from e2rl.learning.schedules import AdaptiveCurriculum, ConstantCurriculum, LinearCurriculum
from e2rl.run.config import choices, load_config
from e2rl.run.errors import InputError
from tests.learning.small import Ambush, brake_check, small_scenes

CURRICULA = {"adaptive": AdaptiveCurriculum, "linear": LinearCurriculum, "constant": ConstantCurriculum}
CURRICULA |= {"bandit": BanditCurriculum}
FULL_ONLY = {"bandit": ["curriculum.templates=[full]"]}  # Ambush knows no templates
POLICY = ["ego.hidden=[16]", "learner.imitation.batch=2", "learner.imitation.epochs=1"]
POLICY += ["learner.ppo.cloning=0.1"]
POLICY += [f"learner.collect.{setting}" for setting in ("batch=4", "steps=20", "iterations=1")]
PLANNER = ["learner=planner_tuning", "ego=lane_graph", "learner.batch=2"]


class Doubling(CurriculumScheduler):
    """A curriculum of one's own: the intensity doubles after every round that the ego has survived."""

    def __init__(self, num_scenes, rounds, seed=0, first=1.0, **scenes):
        super().__init__(num_scenes, rounds, seed, **scenes)
        self._eta = first

    @property
    def eta(self):
        return self._eta

    @property
    def share(self):
        return 1.0

    def advance(self, collision_rate=None):
        super().advance(collision_rate)
        self._eta *= 1 if collision_rate else 2

    def extra_state(self):
        return {"eta": self._eta}

    def load_extra_state(self, state):
        self._eta = state["eta"]


def config_of(*overrides):
    """train.yaml with two rounds of two scenes."""
    return load_config("train", ["rounds=2", "learner.round.scenes=2", *overrides])


def built(config, folder=None):
    scenes = small_scenes(3)
    return build_evolution(config, scenes, build_ego(config), Ambush(), brake_check(scenes), folder)


@pytest.mark.parametrize("curriculum", CURRICULA)
def test_policy_learner(curriculum):
    run = built(config_of(f"curriculum={curriculum}", *FULL_ONLY.get(curriculum, []), *POLICY))
    assert isinstance(run.improve, PolicyImprovement) and type(run.curriculum) is CURRICULA[curriculum]
    assert run.run_round()["train/expert_pairs"] > 0


def test_a_recipe_is_of_options_that_exist():
    for recipe in choices("recipe"):
        run = built(config_of(f"recipe={recipe}", *FULL_ONLY["bandit"], *POLICY))
        assert isinstance(run.improve, PolicyImprovement) and run.improve.teacher is not None


def test_planner_learner():
    config = config_of(*PLANNER)
    config.learner.space, config.learner.search.trials = {"risk_slope": [0.2, 0.5]}, 2
    run = built(config)
    assert isinstance(run.improve, PlannerImprovement)
    assert run.run_round()["train/trials"] == 2


def test_live_traffic_needs_no_stored_one():
    config = config_of("learner.round.traffic=live", *POLICY)
    run = build_evolution(config, small_scenes(3), build_ego(config), Ambush())
    assert run.run_round()["synthesizer/contact"] > 0 and not run.memory.rows


def test_without_a_synthesizer_given_the_traffic_method_attacks():
    config = config_of("learner.round.nominal=log", "curriculum.solvable_only=false", *POLICY)
    run = build_evolution(config, small_scenes(3), build_ego(config), Ambush())
    metrics = run.run_round()
    assert metrics["synthesizer/attacked"] == metrics["synthesizer/contact"] == 1.0
    assert run.memory.rows == 2


def test_a_curriculum_of_ones_own_is_built_and_resumed(tmp_path):
    config = config_of(*POLICY)
    with open_dict(config):
        config.curriculum = {"_target_": f"{__name__}.Doubling", "first": 0.25, "staleness": 0.5}
    run = built(config, tmp_path)
    assert isinstance(run.curriculum, Doubling) and run.curriculum.staleness == 0.5
    assert run.run_round()["curriculum/eta"] == 0.25
    save_checkpoint(tmp_path, run, {})
    again = built(config, tmp_path)
    assert load_checkpoint(tmp_path, again) == 1
    assert again.curriculum.eta == run.curriculum.eta == 0.5
    assert again.run_round()["curriculum/eta"] == 0.5


def test_templates_for_traffic_without_any_are_refused_at_the_start():
    for name in ("nominal", "idm", "replay"):
        config = config_of("curriculum=bandit", f"synthesizer={name}", *POLICY)
        with pytest.raises(InputError, match=rf"curriculum: .*single.*synthesizer={name} has none; set .*\[full\]"):
            built(config)


def test_imitation_stage(tmp_path):
    config, scenes = config_of(*POLICY), small_scenes(3)
    row = run_imitation(config, scenes, build_ego(config), tmp_path, build_logger(config, tmp_path))
    assert row["epoch"] == 0.0 and (tmp_path / "actor.safetensors").is_file()
    assert (tmp_path / "logs/scalars/train/imitation_loss.csv").is_file()


def test_mismatched_groups_are_refused(tmp_path):
    config, scenes = config_of(*PLANNER), small_scenes(3)
    with pytest.raises(InputError, match="stage=imitation"):
        run_imitation(config, scenes, build_ego(config), tmp_path)
    with pytest.raises(InputError, match="improves ego=actor"):
        built(config_of("ego=idm"))
    for group, target in (("learner", "e2rl.planners.idm_planner.IDMEgo"), ("curriculum", "e2rl.no.Such")):
        with pytest.raises(InputError, match=f"{group}={target}"):
            built(config_of(f"{group}._target_={target}", *POLICY))
    with pytest.raises(InputError, match="curriculum"):
        built(config_of("+curriculum.cosine=1", *POLICY))
    with pytest.raises(InputError, match="learner.ppo.clipp"):
        built(config_of("+learner.ppo.clipp=1", *POLICY))


@pytest.mark.parametrize("kind", ["csv", "tensorboard", "wandb", "none"])
def test_logger_groups_name_their_kind(kind):
    assert config_of(f"logger={kind}").logger.kind == kind
