"""r rounds and r more after a resume are 2r rounds, bit for bit; nothing half-written, nothing misread."""

import json

import pytest
import torch

from e2rl.ego.actor import ActorEgo
from e2rl.ego.idm import IDMEgo
from e2rl.errors import InputError
from e2rl.learning.checkpoint import latest_checkpoint, load_checkpoint, save_checkpoint
from e2rl.learning.curriculum.adaptive import AdaptiveCurriculum
from e2rl.learning.evolution import Evolution, RoundSettings
from e2rl.learning.planner import PlannerImprovement
from e2rl.sim.env import SimSettings
from tests.learning.small import Ambush, brake_check, small_run, small_scenes

CONFIG = {"seed": 0, "ego": {"hidden": [16]}}


def rounds(run, count):
    return [
        {name: value for name, value in run.run_round().items() if not name.startswith("time/")} for _ in range(count)
    ]


@pytest.mark.parametrize("live", [None, Ambush()], ids=["replay", "live"])
def test_resumed_rounds_are_those_of_one_run(tmp_path, live):
    whole = small_run(seed=3, live=live)
    expected = rounds(whole, 4)
    first = small_run(seed=3, live=live)
    begun = rounds(first, 2)
    save_checkpoint(tmp_path, first, CONFIG)
    second = small_run(seed=99, live=live)
    second.seed = 3
    assert load_checkpoint(tmp_path, second) == 2
    assert begun + rounds(second, 2) == expected
    for key, value in whole.ego.network.weights().items():
        assert torch.equal(value, second.ego.network.weights()[key]), key
    assert torch.equal(whole.curriculum.priority(), second.curriculum.priority())
    moments = [run.improve.learner.optimiser.state_dict()["state"] for run in (whole, second)]
    assert all(torch.equal(moments[0][k]["exp_avg"], moments[1][k]["exp_avg"]) for k in moments[0])
    for key, value in whole.traffic.items():
        assert torch.equal(value, second.traffic[key])


def test_traffic_config_and_actor_are_in_the_checkpoint(tmp_path):
    run = small_run()
    rounds(run, 1)
    folder = save_checkpoint(tmp_path, run, CONFIG)
    assert folder == latest_checkpoint(tmp_path) == latest_checkpoint(folder)
    assert json.loads((folder / "config.json").read_text()) == CONFIG
    other = small_run(seed=5)
    load_checkpoint(folder, other)
    assert torch.equal(run.traffic["states"], other.traffic["states"])
    alone = ActorEgo(hidden=(16,), checkpoint=str(tmp_path))
    assert all(torch.equal(value, alone.network.weights()[key]) for key, value in run.ego.network.weights().items())


def test_only_the_newest_are_kept_and_nothing_partial_is(tmp_path):
    run = small_run()
    for _ in range(4):
        rounds(run, 1)
        save_checkpoint(tmp_path, run, CONFIG, keep_last=2)
    assert [path.name for path in sorted((tmp_path / "checkpoints").iterdir())] == ["round-000003", "round-000004"]


def test_a_planners_parameters_are_resumed(tmp_path):
    def make():
        scenes = small_scenes(3)
        present, grid = {"desired_speed": 10.0, "use_limits": False}, {"desired_speed": [11.0, 12.0]}
        improve = PlannerImprovement(IDMEgo(**present), present, scenes, SimSettings(), grid, batch=3)
        return Evolution(AdaptiveCurriculum(3, 2), improve, brake_check(scenes), RoundSettings(3, "log"))

    run = make()
    rounds(run, 1)
    save_checkpoint(tmp_path, run, CONFIG)
    other = make()
    load_checkpoint(tmp_path, other)
    assert other.ego.desired_speed == run.ego.desired_speed != 10.0
    assert rounds(run, 1) == rounds(other, 1)


def test_what_does_not_fit_is_refused_and_named(tmp_path):
    run = small_run()
    rounds(run, 1)
    folder = save_checkpoint(tmp_path, run, CONFIG)
    with pytest.raises(InputError, match=r"actor\.safetensors: an actor of another architecture: hidden"):
        load_checkpoint(tmp_path, small_run(hidden=(8,)))
    with pytest.raises(InputError, match="holds 4 scenes, the data 5"):
        load_checkpoint(tmp_path, small_run(scenes=small_scenes(5)))
    with pytest.raises(InputError, match="holds no checkpoint"):
        load_checkpoint(tmp_path / "elsewhere", run)
    (folder / "state.pt").write_bytes(b"half of it")
    with pytest.raises(InputError, match=r"state\.pt: damaged"):
        load_checkpoint(tmp_path, small_run())
    torch.save({"something": torch.zeros(1)}, folder / "state.pt")
    with pytest.raises(InputError, match="not a checkpoint"):
        load_checkpoint(tmp_path, small_run())


def test_a_failed_write_leaves_the_last_checkpoint(tmp_path):
    run = small_run()
    rounds(run, 1)
    save_checkpoint(tmp_path, run, CONFIG)
    rounds(run, 1)
    with pytest.raises(TypeError):
        save_checkpoint(tmp_path, run, {"not json": object()})
    assert latest_checkpoint(tmp_path).name == "round-000001"
