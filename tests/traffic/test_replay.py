"""Log replay: the rollout is the log wherever it is recorded, and nobody is there elsewhere."""

import torch

from e2rl.planners.log_replay import ReplayEgo
from e2rl.sim.world import World
from e2rl.traffic.rule_based import Replay
from tests.prior.small import curved_scenes
from tests.traffic.e2.traffic_scenes import ROWS, drive, scenes


def recorded(steps=40):
    """Scenes whose vehicles waver, vanish, come back, end early or arrive late."""
    scene_set = scenes(3, steps=steps)
    logged, valid = scene_set.scenes["logged"], scene_set.scenes["logged_valid"]
    generator = torch.Generator().manual_seed(0)
    logged[:, 1:, 1:6] += 0.3 * torch.randn(3, steps, 5, 4, generator=generator)
    valid[:, 7:13, 1], valid[:, 22:, 2], valid[:, :11, 6] = False, False, False
    valid[:, 11:, 6] = True  # arrives during the scene
    return scene_set


def test_rollouts_are_the_log_bit_for_bit_with_its_gaps():
    scene_set = recorded()
    rollouts = drive(scene_set, Replay(), 0.0)
    logged, valid = scene_set.scenes["logged"][:, :, 1:], scene_set.scenes["logged_valid"][:, :, 1:]
    assert torch.equal(rollouts.valid[:, :, 1:], valid)
    assert torch.equal(rollouts.states[:, :, 1:][valid], logged[valid])
    assert not rollouts.adversaries.any() and (rollouts.transport_others == 0).all()


def test_with_a_replayed_ego_everybody_is_the_log_whatever_the_seed():
    scene_set = recorded()
    for seeds in ([0, 1, 2], [9, 10, 11]):
        rollouts = drive(scene_set, Replay(), 0.0, seeds, ReplayEgo())
        valid = scene_set.scenes["logged_valid"]
        assert torch.equal(rollouts.valid, valid)
        assert torch.equal(rollouts.states[valid], scene_set.scenes["logged"][valid])


def test_after_the_recording_s_end_nobody_is_there():
    scene = curved_scenes(steps=30)
    world = World.at_start(scene)
    world.step = torch.tensor([12])
    _, plan = Replay().replan(None, world, world.states[:, :1])
    here = scene["logged_valid"][:, 13:31, :ROWS].transpose(1, 2)
    assert torch.equal(plan.present[..., :18], here) and not plan.present[..., 18:].any()
    assert torch.equal(plan.states[..., :18, :], scene["logged"][:, 13:31, :ROWS].transpose(1, 2))
