"""Training: exact resume, the averaged weights, held-out places, and the whole stage on a few scenes."""

import json

import pytest
import torch

from e2rl.errors import InputError
from e2rl.prior.checkpoint import load_prior
from e2rl.prior.denoiser import DenoiserSettings
from e2rl.prior.loss import TrainingSettings, denoising_loss
from e2rl.prior.prior import Prior
from e2rl.prior.training import PriorTraining, held_out, train_prior, train_route_choice
from e2rl.prior.windows import make_windows
from tests.prior.small import curved_scenes
from tests.synthetic import make_scenes

SETTINGS = TrainingSettings(steps=20, batch=4, levels=2, route_steps=5, learning_rate=3e-3)


@pytest.fixture(scope="module")
def windows():
    return make_windows(curved_scenes(2))


def untrained(seed=0):
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return Prior(DenoiserSettings(width=16, heads=2, blocks=1))


def test_ten_steps_and_ten_more_are_twenty(windows):
    whole = PriorTraining(untrained(), windows, SETTINGS)
    whole.run(20)
    first = PriorTraining(untrained(), windows, SETTINGS)
    first.run(10)
    saved = {key: value for key, value in first.state_dict().items()}
    saved = torch.load(_stored(saved), weights_only=True)
    second = PriorTraining(untrained(seed=5), windows, SETTINGS)
    second.load_state_dict(saved)
    second.run(20)
    for one, two in ((whole.prior.state_dict(), second.prior.state_dict()), (whole.average, second.average)):
        assert all(torch.equal(one[key], two[key]) for key in one)


def _stored(state):
    import io

    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return file


def test_training_lowers_the_loss(windows):
    run = PriorTraining(untrained(), windows, TrainingSettings(steps=60, batch=8, levels=2, learning_rate=5e-3))
    loss = lambda: denoising_loss(run.prior, windows, SETTINGS, torch.Generator().manual_seed(1))[0].item()  # noqa: E731
    before = loss()
    run.run(60)
    assert loss() < 0.8 * before


def test_averaged_weights_are_held_only_inside_the_context(windows):
    run = PriorTraining(untrained(), windows, SETTINGS)
    run.run(5)
    raw = {key: value.clone() for key, value in run.prior.denoiser.state_dict().items()}
    with run.averaged():
        inside = run.prior.denoiser.state_dict()
        assert all(torch.equal(inside[key], run.average[key]) for key in raw)
        assert any(not torch.equal(inside[key], raw[key]) for key in raw)
    assert all(torch.equal(value, raw[key]) for key, value in run.prior.denoiser.state_dict().items())


def test_the_rate_warms_up_and_ends_at_zero(windows):
    run = PriorTraining(untrained(), windows, TrainingSettings(steps=200, learning_rate=1.0))
    rates = []
    for step in (0, 49, 100, 200):
        run.step = step
        rates.append(run.learning_rate())
    assert rates[0] < 0.03 and rates[1] > 0.8 and rates[2] == pytest.approx(0.5) and rates[3] == pytest.approx(0)


def test_route_choice_learns_the_candidate_that_is_driven():
    scene = curved_scenes(2)
    scene["route_valid"][:, :6, 1] = True
    scene["route_points"][:, :, 1] = scene["route_points"][:, :, 0] + torch.tensor([0.0, 3.5])
    assert train_route_choice(untrained(), scene, TrainingSettings(route_steps=60)) == 1.0


def test_places_are_held_out_whole():
    scenes = make_scenes(20)
    scenes.location[:] = [f"place-{k // 2}" for k in range(20)]
    mask = held_out(scenes)
    assert mask.tolist() == [k // 2 in (0, 8) for k in range(20)]
    scenes.location[:] = ["one"] * 20
    with pytest.raises(InputError, match="one place"):
        held_out(scenes)


def test_the_stage_writes_a_loadable_checkpoint_and_resumes(tmp_path):
    scenes = make_scenes(4)
    scenes.location[:] = ["a", "b", "c", "d"]
    whole = train_prior(untrained(), scenes, SETTINGS, 10, _folder(tmp_path / "whole"), {"command": "test"})
    part = _folder(tmp_path / "part")
    train_prior(untrained(), scenes, SETTINGS, 10, part, {"command": "test"})
    again = train_prior(untrained(seed=3), scenes, SETTINGS, 10, part, {"command": "test"})
    one, origin = load_prior(str(whole))
    two, _ = load_prior(str(again))
    assert all(torch.equal(a, b) for a, b in zip(one.state_dict().values(), two.state_dict().values(), strict=True))
    assert origin["windows"] > 0 and origin["held_out_windows"] > 0
    lines = [json.loads(line) for line in (tmp_path / "whole" / "progress.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [10, 20]


def _folder(path):
    path.mkdir()
    return path


def test_logs_without_a_usable_window_are_named(tmp_path):
    scenes = make_scenes(2)
    scenes.location[:] = ["a", "b"]
    scenes.scenes["logged_valid"][:, 1:] = False
    with pytest.raises(InputError, match="window"):
        train_prior(untrained(), scenes, SETTINGS, 10, tmp_path, {})
