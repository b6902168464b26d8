"""One drive per row of a pool: in order, whatever the batch, counted to its first failure."""

import pytest
import torch

from e2rl.learning.driving import PoolDriver, episodes_of
from e2rl.planners.idm_planner import IDMEgo
from e2rl.sim.env import SimSettings
from e2rl.traffic.pool import TrafficPool
from tests.learning.small import brake_check, small_scenes


def attacked(scenes, eta=1.0):
    index = torch.arange(len(scenes))
    return TrafficPool.stored(brake_check(scenes)(None, index, eta, 0), eta) + TrafficPool.recorded(index)


def test_outcomes_do_not_depend_on_the_batch():
    scenes = small_scenes(5, steps=40)
    pool = attacked(scenes)
    parts = [PoolDriver(scenes, SimSettings(), batch).drive_all(IDMEgo(), pool)[0] for batch in (10, 4, 16)]
    for name in ("row", "scene_index", "contact", "returns", "progress", "acceleration"):
        for part in parts[1:]:
            assert torch.equal(getattr(parts[0], name), getattr(part, name)), name
    assert parts[0].row.tolist() == list(range(10)) and parts[0].adversarial.tolist() == [True] * 5 + [False] * 5


def test_a_drive_counts_until_its_first_contact():
    scenes = small_scenes(2, steps=40)
    pool = attacked(scenes, eta=7.0)
    rows = torch.tensor([0, 2])
    frames = PoolDriver(scenes, SimSettings(), 2).drive(IDMEgo(hardest_braking=0.1, braking=0.1), pool, rows)
    episodes = episodes_of(frames, pool, rows)
    assert episodes.contact.tolist() == [True, False]
    assert frames["alive"][1].all() and frames["alive"][0].sum() < 40
    assert frames["contact"][0].sum() == 1 and not frames["reward"][0][~frames["alive"][0]].any()


def test_disturbances_are_executed_but_not_intended():
    scenes = small_scenes(2)
    driver, pool = PoolDriver(scenes, SimSettings(), 2), TrafficPool.recorded(torch.arange(2))
    frames = driver.drive(IDMEgo(), pool, torch.arange(2), lambda action, step: action + torch.tensor([1.0, 0.0]))
    assert torch.allclose(frames["executed"][..., 0], frames["intended"][..., 0] + 1.0, atol=1e-3)


def test_mean_acceleration_is_that_of_the_drive():
    scenes = small_scenes(2, num_vehicles=1, num_vrus=0, limit=30.0)
    driver, pool = PoolDriver(scenes, SimSettings(), 2), TrafficPool.recorded(torch.arange(2))
    episodes, _ = driver.drive_all(IDMEgo(acceleration=1.0), pool)
    gained = driver.env.world().states[:, 0, 3] - 10.0
    assert episodes.acceleration.tolist() == pytest.approx((gained / 2.0).tolist(), abs=1e-3)
