"""Training: exact resume, the averaged weights, held-out places, and the whole stage on
a few scenes."""

from dataclasses import replace

import pytest
import torch

from e2rl.learning.logging import RunLogger
from e2rl.learning.pretraining.prior import training
from e2rl.learning.pretraining.prior.loss import held_out_loss
from e2rl.learning.pretraining.prior.training import (
    PriorTraining,
    TrainingSettings,
    held_out,
    train_prior,
    train_route_choice,
)
from e2rl.learning.pretraining.prior.windows import make_windows
from e2rl.prior.checkpoint import load_prior
from e2rl.prior.denoiser import DenoiserSettings
from e2rl.prior.prior import Prior
from e2rl.run.errors import InputError
from e2rl.run.parts import Parts
from tests.prior.small import curved_scenes
from tests.synthetic import make_scenes

SETTINGS = TrainingSettings(
    steps=20, batch=4, route_steps=5, learning_rate=3e-3, validate_every=10, bf16=False
)


@pytest.fixture(scope="module")
def windows():
    return make_windows(curved_scenes(2))


def untrained(seed=0):
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return Prior(DenoiserSettings(width=16, heads=2, blocks=1))


def of(windows, seed=0, settings=SETTINGS):
    return PriorTraining(
        untrained(seed),
        windows,
        test=windows,
        settings=settings,
    )


def test_training_lowers_the_loss(windows):
    run = of(
        windows,
        settings=replace(
            SETTINGS,
            steps=60,
            batch=8,
            learning_rate=5e-3,
        ),
    )
    before = held_out_loss(run.prior, windows, batch=8)
    run.train(60)
    assert held_out_loss(run.prior, windows, batch=8) < 0.8 * before


def test_the_average_is_exponential_with_a_decay_that_grows_to_ema(
    windows, monkeypatch
):
    monkeypatch.setattr(training, "EMA", 0.2)
    run = of(windows)
    expected = {
        key: value.clone() for key, value in run.prior.denoiser.state_dict().items()
    }
    for decay in (2 / 11, 0.2, 0.2):
        run.train(run.done + 1)
        for key, value in run.prior.denoiser.state_dict().items():
            expected[key].lerp_(value, 1 - decay)
    result = run.average.module.state_dict()
    assert all(torch.equal(result[key], value) for key, value in expected.items())


def test_the_rate_warms_up_and_ends_at_zero(windows):
    run = of(windows, settings=replace(SETTINGS, steps=200, learning_rate=1.0))
    rates = []
    for run.done in (0, 24, 49, 100, 200):
        rates.append(run.learning_rate())
    cosine = [
        (1 + torch.tensor(step / 200 * torch.pi).cos().item()) / 2
        for step in (0, 24, 49)
    ]
    assert rates == pytest.approx(
        [cosine[0] / 50, cosine[1] / 2, cosine[2], 0.5, 0.0], abs=1e-6
    )


def test_half_of_the_windows_have_estimated_starts_where_so_many_are_asked_for(
    windows, monkeypatch
):
    monkeypatch.setattr(training, "CAUSAL", 0.25)
    run = of(windows, settings=replace(SETTINGS, batch=4000))
    assert windows["causal"][run.pick()].float().mean().item() == pytest.approx(
        0.25, abs=0.03
    )


def test_route_choice_learns_the_candidate_that_is_driven():
    scene = curved_scenes(2)
    scene["route_valid"][:, :6, 1] = True
    scene["route_points"][:, :, 1] = scene["route_points"][:, :, 0] + torch.tensor(
        [0.0, 3.5]
    )
    assert (
        train_route_choice(
            untrained(), scene, settings=TrainingSettings(route_steps=60)
        )
        == 1.0
    )


def test_places_are_held_out_whole():
    scenes = make_scenes(20)
    scenes.location[:] = [f"place-{k // 2}" for k in range(20)]
    mask = held_out(scenes)
    assert mask.tolist() == [k // 2 in (0, 8) for k in range(20)]
    scenes.location[:] = ["one"] * 20
    with pytest.raises(InputError, match="one place"):
        held_out(scenes)


def four_places():
    scenes = make_scenes(4)
    scenes.location[:] = ["a", "b", "c", "d"]
    return scenes


def test_an_interrupted_training_ends_as_the_whole_one_and_its_checkpoint_says_what_made_it(
    tmp_path, monkeypatch
):
    """Interrupted in its second validation: the state after the first one is on the
    disk."""
    calls = []

    def stopping(*arguments, **options):
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return held_out_loss(*arguments, **options)

    def trained(name, seed=0):
        folder = tmp_path / name
        how = {"logger": RunLogger("csv", folder), "parts": Parts(folder)}
        return train_prior(
            untrained(seed),
            four_places(),
            settings=SETTINGS,
            folder=folder,
            origin={"command": "test"},
            **how,
        )

    first, origin = load_prior(str(trained("whole")))
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(training, "held_out_loss", stopping)
        trained("part")
    two, again = load_prior(str(trained("part", seed=3)))
    assert all(
        torch.equal(a, b)
        for a, b in zip(
            first.state_dict().values(), two.state_dict().values(), strict=True
        )
    )
    assert origin["held_out_loss"] == again["held_out_loss"]
    losses = [
        (tmp_path / name / "logs/scalars/train/prior_held_out_loss.csv")
        .read_text()
        .split()
        for name in ("whole", "part")
    ]
    assert losses[0] == losses[1]
    assert len(losses[0]) == 2
    assert origin["held_out_loss"] == pytest.approx(
        min(float(line.split(",")[1]) for line in losses[0])
    )
    assert origin["windows"] > 0
    assert origin["command"] == "test"
    assert origin["versions"]["torch"] == torch.__version__


def test_logs_without_a_moving_vehicle_are_named(tmp_path):
    scenes = make_scenes(2, speed=0.0)
    scenes.location[:] = ["a", "b"]
    with pytest.raises(InputError, match="no vehicle moves"):
        train_prior(
            untrained(),
            scenes,
            settings=SETTINGS,
            folder=tmp_path,
            origin={},
        )
