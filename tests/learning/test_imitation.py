"""Expert pairs come from the log, cloning fits them, and disturbed ones lead back to the lane."""

import pytest
import torch

from e2rl.learning.cloning import clip_expert
from e2rl.learning.imitation import Imitation, ImitationSettings, imitate, recorded_pairs
from e2rl.learning.logging import RunLogger
from e2rl.planners.actor import ActorEgo
from e2rl.planners.reference import executed_action
from e2rl.run.parts import Parts
from e2rl.sim.env import SimSettings
from tests.learning.small import small_scenes


def braking_log(num_scenes=4, steps=20, acceleration=-2.0):
    """Recorded egos that brake from the first frame on."""
    scenes = small_scenes(num_scenes, steps)
    time = 0.1 * torch.arange(steps + 1)
    logged = scenes.scenes["logged"]
    logged[:, :, 0, 3] = 10.0 + acceleration * time
    logged[:, :, 0, 0] = logged[:, :1, 0, 0] + 10.0 * time + acceleration / 2 * time**2
    return scenes


def settings(**changes):
    return ImitationSettings(**({"epochs": 8, "minibatch": 32, "learning_rate": 3e-3, "held_out": 0.25} | changes))


def test_replayed_pairs_are_the_inverse_dynamics_of_the_log():
    pairs = recorded_pairs(braking_log(), SimSettings(), settings(drives=0))
    assert len(pairs) == 4 * 20 and pairs["scene_index"].unique().tolist() == [0, 1, 2, 3]
    assert torch.allclose(pairs["action"], torch.tensor([-2.0, 0.0]).expand(80, 1, 2), atol=2e-3)
    last = executed_action(pairs["observation"]).view(4, 20, 2)
    assert torch.allclose(last[:, 1:], pairs["action"].view(4, 20, 2)[:, :-1], atol=2e-3), "in order of time"


def test_disturbed_pairs_lead_back():
    """Where the ego has turned off its track the label turns it back."""
    pairs = recorded_pairs(braking_log(8), SimSettings(), settings(drives=3, disturbed_yaw_rate=0.2))
    sideways, turned = 3 * pairs["observation"][:, 3], pairs["observation"][:, 4]
    off = (sideways.abs() > 0.1) & (sideways * turned > 0)
    assert off.sum() > 20 and (pairs["action"][off, 0, 1].sign() == -sideways[off].sign()).float().mean() > 0.9


def test_clipping_keeps_actions_off_the_bounds():
    low, high = torch.tensor([-8.0, -1.6]), torch.tensor([5.0, 1.6])
    clipped = clip_expert(torch.tensor([[9.0, -9.0], [0.0, 0.1]]), low, high)
    assert torch.allclose(clipped, torch.tensor([[4.935, -1.584], [0.0, 0.1]]))


def test_cloning_reduces_the_held_out_loss_and_keeps_the_best_weights(tmp_path):
    torch.manual_seed(0)
    ego = ActorEgo(hidden=(32,))
    pairs = recorded_pairs(braking_log(), SimSettings(), settings(drives=1))
    before = Imitation(ego.network, pairs, settings()).measure(pairs)
    best = imitate(ego.network, pairs, settings(), tmp_path)
    assert best["held_out_loss"] < before[0] - 0.3 and best["held_out_miss"] < before[1] / 2
    again = ActorEgo(hidden=(32,), checkpoint=str(tmp_path))
    observation = pairs["observation"]
    assert torch.equal(again.network.network.deterministic(observation), ego.network.network.deterministic(observation))


@pytest.mark.parametrize("stop", [0, 1, 3])
def test_cloning_that_was_interrupted_equals_one_that_was_not(tmp_path, monkeypatch, stop):
    pairs, epoch = recorded_pairs(braking_log(), SimSettings(), settings(drives=1)), Imitation.epoch

    def run(folder):
        torch.manual_seed(0)
        network = ActorEgo(hidden=(32,)).network
        best = imitate(network, pairs, settings(epochs=5), folder, RunLogger("csv", folder), Parts(folder))
        files = [
            (folder / name).read_bytes() for name in ("actor.safetensors", "logs/scalars/train/imitation_loss.csv")
        ]
        return best, files, network.weights()

    def stopped(training):
        if len(training.history) == stop:
            monkeypatch.undo()
            raise KeyboardInterrupt
        return epoch(training)

    best, files, weights = run(tmp_path / "whole")
    monkeypatch.setattr(Imitation, "epoch", stopped)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "parts")
    again = run(tmp_path / "parts")
    assert again[:2] == (best, files) and all(torch.equal(again[2][name], value) for name, value in weights.items())
