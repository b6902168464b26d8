"""Windows of the ego bits tell what recorded vehicles saw and did, and imitation lowers
its losses on them."""

from pathlib import Path

import pytest
import torch

from e2rl.learning.logging import RunLogger
from e2rl.learning.pretraining import bits
from e2rl.learning.pretraining.bits import (
    BitsSettings,
    BitsTraining,
    as_ego,
    losses,
    run_bits_stage,
    windows,
    world_at,
)
from e2rl.planners.bits import observed
from e2rl.planners.bits_network import BitsNetwork, drive_controls, load_bits
from e2rl.planners.path import RoutePath
from e2rl.run.config import load_config
from e2rl.run.run import Run
from e2rl.sim.env import DrivingEnv
from e2rl.sim.observation import ELAPSED
from e2rl.sim.settings import SimSettings
from tests.learning.small import small_scenes
from tests.synthetic import LANE_WIDTH


def settings(**changes):
    quick = {
        "hidden": 32,
        "epochs": 10,
        "minibatch": 32,
        "learning_rate": 3e-3,
        "held_out": 0.1,
    }
    return BitsSettings(**quick | changes)


def braking_scenes(num_scenes=4):
    """Recorded egos halt within 2 s; the other vehicles keep their speed."""
    scenes = small_scenes(num_scenes, steps=60)
    time = (0.1 * torch.arange(61)).clamp(max=2.0)
    logged = scenes.scenes["logged"]
    logged[:, :, 0, 3] = 10.0 - 5.0 * time
    logged[:, :, 0, 0] = logged[:, :1, 0, 0] + 10.0 * time - 2.5 * time**2
    return scenes


def test_a_window_sees_what_the_environment_shows_a_replayed_ego():
    scenes = braking_scenes(2)
    env = DrivingEnv(
        scenes, SimSettings(replay_ego=True, end_on_contact=False), 2, agents=True
    )
    env.reset(
        env.reset().select("scene_index").set("scene_index", torch.arange(2)[:, None])
    )
    frames = env.rollout(11, break_when_any_done=False)
    ours = as_ego(
        scenes.scenes, torch.arange(2), vehicle=torch.zeros(2, dtype=torch.long)
    )
    for step in (0, 10):
        expected = frames["observation"][:, step].clone()
        expected[:, ELAPSED] = 0
        torch.testing.assert_close(
            observed(world_at(ours, step)), expected, atol=2e-3, rtol=0
        )


def test_a_vehicle_that_plays_the_ego_sees_the_ego():
    scenes = small_scenes(2, steps=60)
    ours = as_ego(scenes.scenes, torch.tensor([1]), vehicle=torch.tensor([1]))
    world = world_at(ours, 3)
    assert torch.equal(world.states[0, [1, 0, 2]], scenes.scenes["logged"][1, 3, :3])
    assert torch.equal(
        ours["route_points"][0, 0, 0], scenes.scenes["route_points"][1, 1, 0]
    )


def test_goals_are_where_the_recording_is_5_s_later():
    data = windows(small_scenes(3, steps=60), 0)
    assert (
        len(data) == 2 * 3 * 3 * 3
    )  # exact and disturbed, steps 0, 5 and 10, vehicles, scenes
    exact = data[data["start"][:, 2] == 0]
    disturbed = data[data["start"][:, 2] != 0]
    torch.testing.assert_close(
        exact["distance"], torch.full((27,), 50.0), atol=1e-2, rtol=0
    )
    assert exact["offset"].abs().max() < 1e-3
    assert disturbed["offset"].abs().max() < 1e-3, "each on its own route"
    assert set((exact["start"][:, 1] / LANE_WIDTH).round().tolist()) == {0, 1}
    moved = (
        disturbed["start"][:, 1]
        - LANE_WIDTH * (disturbed["start"][:, 1] / LANE_WIDTH).round()
    )
    assert 0.2 < moved.std() < 1.0
    assert 0.3 < disturbed["start"][:, 3].std() < 2.0


def test_training_lowers_the_losses_and_the_plan_halts_as_recorded(monkeypatch):
    for name in ("FEATURE_NOISE", "LAST_ACTION_NOISE"):
        monkeypatch.setattr(bits, name, 0.05)
    torch.manual_seed(0)
    data = windows(braking_scenes(), 0)
    network = BitsNetwork(32)
    run = BitsTraining(network, data, settings=settings(held_out=0.0, epochs=40))
    before = run.measure(data)
    for _ in range(40):
        run.turn()
    after = run.measure(data)
    assert after["trajectory"] < 0.4 < before["trajectory"] / 5
    assert after["goal"] < before["goal"] - 3
    start = data[(data["start"][:, 3] == 10) & (data["distance"] < 20)][:1]
    path = RoutePath(start["start"], start["route"])
    code = network.encode(start["observation"])
    controls = network.controls(
        code,
        speed=start["start"][:, 3],
        offset=path.d,
        distance=start["distance"][:, None],
        side=start["offset"][:, None],
    )
    driven = drive_controls(controls, start["start"], path=path)
    assert driven.states[0, 0, -1, 3] < 1.0
    assert abs(driven.distance.item() - 10.0) < 1.5


def test_a_loss_of_zero_is_the_recording():
    """A vehicle at constant speed on its goal: the untrained policy keeps its speed, so
    its plan is the recording."""
    data = windows(small_scenes(2, steps=60), 0, disturbed=(0.0, 0.0, 0.0))
    result = losses(BitsNetwork(16).eval(), data)
    assert result["trajectory"] < 1e-3
    assert result["goal"] > 5


def small_stage(monkeypatch, folder, scenes=None):
    """stage=bits on small scenes."""
    options = ["stage=bits", "stage.hidden=16", "stage.epochs=3", "stage.minibatch=16"]
    monkeypatch.setattr(
        bits, "load_scenes", lambda *given, **named: scenes or braking_scenes()
    )
    monkeypatch.setattr(Run, "begin", lambda run, inputs: None)
    monkeypatch.setattr(bits, "origin_of", lambda folder: {})
    torch.manual_seed(0)
    return run_bits_stage(
        Run(load_config("train", options), folder, choices={}), RunLogger("csv", folder)
    )


def test_the_stage_writes_the_weights_of_the_lowest_held_out_loss_and_goes_on_exactly(
    tmp_path, monkeypatch
):
    row = small_stage(monkeypatch, tmp_path / "whole")
    log = Path("logs/scalars/train/bits_held_out_loss.csv")
    logged = (tmp_path / "whole" / log).read_text().split()
    assert min(float(line.split(",")[1]) for line in logged) == pytest.approx(
        row["held_out_loss"]
    )
    turn = BitsTraining.turn
    calls = []

    def stopped(training):
        calls.append(None)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return turn(training)

    monkeypatch.setattr(BitsTraining, "turn", stopped)
    with pytest.raises(KeyboardInterrupt):
        small_stage(monkeypatch, tmp_path / "parts")
    assert small_stage(monkeypatch, tmp_path / "parts") == row
    first, two = (
        load_bits(str(tmp_path / name)).state_dict() for name in ("whole", "parts")
    )
    assert all(torch.equal(value, two[name]) for name, value in first.items())
