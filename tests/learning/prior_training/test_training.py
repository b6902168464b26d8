"""Training: exact resume, the averaged weights, held-out places, and the whole stage on a few scenes."""

import json
from dataclasses import replace

import pytest
import torch

from e2rl.learning.prior_training.loss import denoising_loss
from e2rl.learning.prior_training.optimisation import PriorTraining
from e2rl.learning.prior_training.training import (
    Record,
    TrainingSettings,
    held_out,
    saved_state,
    train_prior,
    train_route_choice,
)
from e2rl.learning.prior_training.windows import make_windows
from e2rl.prior.checkpoint import load_prior
from e2rl.prior.denoiser import DenoiserSettings
from e2rl.prior.prior import Prior
from e2rl.run.errors import InputError
from e2rl.run.parts import read_state
from tests.prior.small import curved_scenes
from tests.synthetic import make_scenes

SETTINGS = TrainingSettings(steps=20, batch=4, levels=2, route_steps=5, learning_rate=3e-3, validate_every=10)


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
    for one, two in ((whole.prior, second.prior), (whole.average, second.average)):
        one, two = one.state_dict(), two.state_dict()
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
        assert all(torch.equal(inside[key], run.average.module.state_dict()[key]) for key in raw)
        assert any(not torch.equal(inside[key], raw[key]) for key in raw)
    assert all(torch.equal(value, raw[key]) for key, value in run.prior.denoiser.state_dict().items())


def test_the_average_is_exponential_with_a_decay_that_grows_to_ema(windows):
    run = PriorTraining(untrained(), windows, replace(SETTINGS, ema=0.2))
    expected = {key: value.clone() for key, value in run.prior.denoiser.state_dict().items()}
    for decay in (2 / 11, 0.2, 0.2):
        run.run(run.step + 1)
        for key, value in run.prior.denoiser.state_dict().items():
            expected[key].lerp_(value, 1 - decay)
    found = run.average.module.state_dict()
    assert all(torch.equal(found[key], value) for key, value in expected.items())


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


def four_places():
    scenes = make_scenes(4)
    scenes.location[:] = ["a", "b", "c", "d"]
    return scenes


def test_the_stage_writes_a_loadable_checkpoint_that_says_what_made_it(tmp_path):
    path = train_prior(untrained(), four_places(), SETTINGS, tmp_path, {"command": "test", "seconds": {"scenes": 1.0}})
    prior, origin = load_prior(str(path))
    state = read_state(tmp_path / "training.pt")
    best = state["record"]["best"]
    assert all(torch.equal(value, best["weights"][key]) for key, value in prior.state_dict().items())
    lines = [json.loads(line) for line in (tmp_path / "progress.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [10, 20] and origin["validation"] in lines
    assert origin["held_out_loss"] == min(line["held_out"] for line in lines)
    assert origin["windows"] > 0 and origin["held_out_windows"] > 0 and origin["command"] == "test"
    assert origin["versions"]["torch"] == torch.__version__ and origin["processes"] == 1
    assert {"scenes", "windows", "routes", "steps", "validation", "total"} == origin["seconds"].keys()


def test_an_interrupted_stage_ends_as_the_whole_one_bit_for_bit(tmp_path):
    """Interrupted in its last validation: the state of the one before is on the disk. Accuracy of the route choice and
    the lines of progress.jsonl are taken up too, and no line is doubled."""
    whole, part = _folder(tmp_path / "whole"), _folder(tmp_path / "part")
    calls = []

    def interrupting(prior):
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return {"real": 0.5}

    def steady(prior):
        return {"real": 0.5}

    settings = replace(SETTINGS, closed_loop_every=1)
    one, origin = load_prior(str(train_prior(untrained(), four_places(), settings, whole, {}, steady)))
    with pytest.raises(KeyboardInterrupt):
        train_prior(untrained(), four_places(), settings, part, {}, interrupting)
    two, again = load_prior(str(train_prior(untrained(seed=3), four_places(), settings, part, {}, steady)))
    assert all(torch.equal(a, b) for a, b in zip(one.state_dict().values(), two.state_dict().values(), strict=True))
    assert (whole / "progress.jsonl").read_text() == (part / "progress.jsonl").read_text()
    for key in ("validation", "route_accuracy", "step"):
        assert origin[key] == again[key] or origin[key] != origin[key]


def test_a_run_does_not_go_on_with_other_data(tmp_path):
    train_prior(untrained(), four_places(), SETTINGS, tmp_path, {"fingerprint": "one"})
    with pytest.raises(InputError, match="other data"):
        train_prior(untrained(), four_places(), SETTINGS, tmp_path, {"fingerprint": "two"})


def test_the_closed_loop_is_driven_by_the_averaged_weights_at_every_nth_validation_and_the_last(tmp_path):
    seen = []
    settings = replace(SETTINGS, steps=5, validate_every=1, closed_loop_every=2)

    def closed_loop(prior):
        seen.append({key: value.clone() for key, value in prior.state_dict().items()})
        return {"real": 0.25}

    train_prior(untrained(), four_places(), settings, tmp_path, {}, closed_loop)
    lines = [json.loads(line) for line in (tmp_path / "progress.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines if "real" in line] == [2, 4, 5]
    average = read_state(tmp_path / "training.pt")["run"]["average"]
    del average["n_averaged"]
    assert all(torch.equal(seen[-1][key.replace("module", "denoiser", 1)], value) for key, value in average.items())


def test_the_lowest_held_out_loss_is_kept_whatever_the_closed_loop_says():
    record, prior = Record(), untrained()
    for step, (loss, real) in enumerate([(0.5, 0.9), (0.4, 0.1), (0.6, 1.0)]):
        record.add({"step": step, "held_out": loss, "real": real}, prior)
    assert record.best["step"] == 1 and len(record.lines) == 3


def _folder(path):
    path.mkdir()
    return path


def test_logs_without_a_usable_window_are_named(tmp_path):
    scenes = make_scenes(2)
    scenes.location[:] = ["a", "b"]
    scenes.scenes["logged_valid"][:, 1:] = False
    with pytest.raises(InputError, match="window"):
        train_prior(untrained(), scenes, SETTINGS, tmp_path, {})


def test_logs_without_a_moving_vehicle_are_named(tmp_path):
    scenes = make_scenes(2, speed=0.0)
    scenes.location[:] = ["a", "b"]
    with pytest.raises(InputError, match="no vehicle moves"):
        train_prior(untrained(), scenes, SETTINGS, tmp_path, {})


@pytest.mark.parametrize("how", ["flipped", "torn", "empty"])
def test_a_damaged_state_is_passed_over_for_the_one_before_it(tmp_path, how):
    assert saved_state(tmp_path) is None
    for step in (1, 2):
        Record(lines=[{"step": step}]).write(tmp_path, {"weights": torch.full((64,), float(step))}, "data")
    assert saved_state(tmp_path)["record"]["lines"] == [{"step": 2}]
    content = (tmp_path / "training.pt").read_bytes()
    where = content.index(torch.full((64,), 2.0).numpy().tobytes())
    flipped = content[:where] + bytes([content[where] ^ 1]) + content[where + 1 :]
    damaged = {"flipped": flipped, "torn": content[: len(content) // 2], "empty": b""}[how]
    (tmp_path / "training.pt").write_bytes(damaged)
    assert saved_state(tmp_path)["run"]["weights"].tolist() == [1.0] * 64
    (tmp_path / "training.previous.pt").write_bytes(damaged)
    with pytest.raises(InputError, match=r"training\.pt: damaged, and no whole one before it"):
        saved_state(tmp_path)
