"""Every configuration of learner, curriculum and logger builds and runs, a curriculum
of one's own among them."""

import pytest
from e2rl.scripts.train import train_round
from omegaconf import open_dict

from e2rl.api import load_prior
from e2rl.evaluation.build import build_ego
from e2rl.learning.rounds.build import (
    TRY,
    build_attackers,
    build_evolution,
    build_progress,
    check_training,
    rollouts_of,
)
from e2rl.learning.rounds.checkpoint import load_checkpoint, save_checkpoint
from e2rl.learning.rounds.policy import PolicyImprovement
from e2rl.learning.rounds.scheduler import CurriculumScheduler
from e2rl.learning.rounds.schedules import (
    AdaptiveCurriculum,
    ConstantCurriculum,
    LinearCurriculum,
)
from e2rl.run.config import load_config
from e2rl.run.errors import InputError
from e2rl.traffic.fusing import EARNED
from tests.learning.small import Ambush, brake_check, small_scenes

CURRICULA = {
    "adaptive": AdaptiveCurriculum,
    "linear": LinearCurriculum,
    "constant": ConstantCurriculum,
}
POLICY = ["ego.hidden=[16]"]
POLICY += [
    f"learner.collect.{setting}" for setting in ("batch=4", "steps=20", "iterations=1")
]


class Doubling(CurriculumScheduler):
    """A curriculum of one's own: the intensity doubles after every round that the ego
    has survived."""

    lasting = ("eta",)

    def __init__(self, num_scenes, rounds, seed=0, first=1.0, **scenes):
        super().__init__(num_scenes, rounds, seed, **scenes)
        self.eta = first
        self.fraction = 1.0

    def advance(self, collision_rate=None):
        super().advance(collision_rate)
        self.eta *= 1 if collision_rate else 2


def config_of(*overrides):
    """train.yaml with two rounds of two scenes."""
    small = ["rounds=2", "learner.round.scenes=2", *POLICY]
    return load_config("train", [*small, *overrides])


def built(config, folder=None):
    scenes = small_scenes(3)
    return build_evolution(
        config,
        scenes,
        ego=build_ego(config),
        attacks=[brake_check(scenes)],
        folder=folder,
    )


@pytest.mark.parametrize("curriculum", CURRICULA)
def test_policy_learner(curriculum):
    run = built(config_of(f"curriculum={curriculum}"))
    assert isinstance(run.improve, PolicyImprovement)
    assert type(run.curriculum) is CURRICULA[curriculum]
    assert train_round(run)["synthesizer/memory_rows"] > 0


def test_the_experiment_of_training_is_of_options_that_exist():
    run = built(config_of("experiment=harden"))
    assert isinstance(run.improve, PolicyImprovement)
    assert run.ego.evader is not None


def test_without_a_synthesizer_given_the_traffic_method_attacks():
    config = config_of("learner.round.nominal=log", "curriculum.solvable_only=false")
    run = build_evolution(
        config, small_scenes(3), ego=build_ego(config), attackers=[Ambush()]
    )
    metrics = train_round(run)
    assert metrics["synthesizer/attacked"] == metrics["synthesizer/contact"] == 1.0
    assert run.memory.rows == 2


@pytest.mark.parametrize(
    ("synthesizer", "count"), [("e2", 2), ("e2_unbound", 1), ("nominal", 1)]
)
def test_a_harder_attack_joins_in_where_one_is_named(synthesizer, count):
    config = config_of(f"synthesizer={synthesizer}")
    assert len(build_attackers(config, load_prior())) == count


def test_a_learner_that_names_no_harder_attack_has_one_attacker():
    config = config_of()
    with open_dict(config):
        del config.learner.round.harder
    assert len(build_attackers(config, load_prior())) == 1


def test_a_curriculum_of_ones_own_is_built_and_resumed(tmp_path):
    config = config_of()
    with open_dict(config):
        config.curriculum = {
            "_target_": f"{__name__}.Doubling",
            "first": 0.25,
        }
    run = built(config, tmp_path)
    assert isinstance(run.curriculum, Doubling)
    assert train_round(run)["curriculum/eta"] == 0.25
    save_checkpoint(tmp_path, run)
    again = built(config, tmp_path)
    assert load_checkpoint(tmp_path, again) == 1
    assert again.curriculum.eta == run.curriculum.eta == 0.5
    assert train_round(again)["curriculum/eta"] == 0.5


def test_settings_that_do_not_fit_are_refused_at_the_start():
    with pytest.raises(InputError, match="curriculum"):
        built(config_of("+curriculum.cosine=1"))


def test_the_time_left_is_told_once_each_kind_of_phase_was_measured(monkeypatch):
    current = [0.0]
    left = []
    monkeypatch.setattr("time.monotonic", lambda: current[0])
    progress = build_progress(load_config("train", ["rounds=2"]))
    for kind, seconds in (
        ("measurement", 600),
        ("round", 60),
        ("round", 10),
        ("measurement", 10),
    ):
        left.append(progress.left())
        with progress.phase(kind):
            current[0] += seconds
    assert left == ["", "", "about 11 min left", "about 10 min left"]
    assert progress.left() == ""


def test_a_run_that_goes_on_has_measured_nothing_yet():
    progress = build_progress(load_config("train", ["rounds=2"]), done=1)
    with progress.phase("round"):
        pass
    assert progress.left() == ""


def test_a_device_for_learning_that_cannot_be_used_is_refused():
    config = config_of("learner.device=banana")
    with pytest.raises(InputError, match="banana: .*use learner.device=cpu or cuda"):
        check_training(config)


def test_a_training_round_a_planner_that_evades_earns_compiling_and_the_default_does_not():
    default = rollouts_of(load_config("train", []))
    assert default == 8 * 2 * 48 + 2 * 48 * (2 * 3 + 8 + 640 / TRY)
    harden = rollouts_of(load_config("train", ["experiment=harden"]))
    assert default < EARNED < harden
    few = rollouts_of(load_config("train", ["num_scenes=10", "measure.budget=0"]))
    assert few == 8 * 2 * 10 + 2 * 48 * (2 * 3 + 8)
    assert rollouts_of(load_config("train", ["stage=prior"])) == 0
