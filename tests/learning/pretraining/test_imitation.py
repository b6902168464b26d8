"""Demonstrations come from the log, cloning fits them, and disturbed ones lead back to
the lane."""

import pytest
import torch

from e2rl.learning.pretraining import imitation
from e2rl.learning.pretraining.cloning import clip_expert
from e2rl.learning.pretraining.imitation import (
    Imitation,
    ImitationSettings,
    recorded_demonstrations,
)
from e2rl.planners.actor import ActorEgo
from e2rl.sim.settings import SimSettings
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
    return ImitationSettings(
        **(
            {"epochs": 8, "minibatch": 32, "learning_rate": 3e-3, "held_out": 0.25}
            | changes
        )
    )


def test_replayed_demonstrations_are_the_inverse_dynamics_of_the_log():
    shown = recorded_demonstrations(
        braking_log(),
        SimSettings(),
        seed=0,
        drives=0,
    )
    assert len(shown) == 4 * 20
    assert shown["scene_index"].unique().tolist() == [
        0,
        1,
        2,
        3,
    ]
    assert torch.allclose(
        shown["action"], torch.tensor([-2.0, 0.0]).expand(80, 2), atol=2e-3
    )
    last = (shown["observation"][:, 1:3] * torch.tensor([4.0, 1.0])).view(
        4, 20, 2
    )  # as the observation reports it
    assert torch.allclose(
        last[:, 1:], shown["action"].view(4, 20, 2)[:, :-1], atol=2e-3
    ), "in order of time"


def test_disturbed_demonstrations_lead_back(monkeypatch):
    """Where the ego has turned off its track the label turns it back."""
    monkeypatch.setattr(imitation, "DISTURBED", (1.0, 0.2))
    shown = recorded_demonstrations(braking_log(8), SimSettings(), seed=0)
    sideways = 3 * shown["observation"][:, 3]
    turned = shown["observation"][:, 4]
    off = (sideways.abs() > 0.1) & (sideways * turned > 0)
    assert off.sum() > 20
    assert (
        shown["action"][off, 1].sign() == -sideways[off].sign()
    ).float().mean() > 0.9


def test_clipping_keeps_actions_off_the_bounds():
    low = torch.tensor([-8.0, -1.6])
    high = torch.tensor([5.0, 1.6])
    clipped = clip_expert(torch.tensor([[9.0, -9.0], [0.0, 0.1]]), low, high=high)
    assert torch.allclose(clipped, torch.tensor([[4.935, -1.584], [0.0, 0.1]]))


def test_cloning_reduces_the_held_out_loss_and_takes_the_best_weights():
    torch.manual_seed(0)
    ego = ActorEgo(hidden=(32,), room=None)
    shown = recorded_demonstrations(
        braking_log(),
        SimSettings(),
        seed=0,
        drives=1,
    )
    training = Imitation(ego.network, shown, settings=settings())
    before = training.measure(training.held_out)
    best = training.fit("imitation", 8)
    assert best["held_out_loss"] < before["loss"] - 0.3
    assert best["held_out_miss"] < before["miss"] / 2
    assert best["held_out_loss"] == min(
        row["held_out_loss"] for row in training.history
    )
    assert training.measure(training.held_out)["loss"] == pytest.approx(
        best["held_out_loss"], abs=1e-6
    )
