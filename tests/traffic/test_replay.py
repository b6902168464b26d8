"""Log replay: the rollout is the log wherever it is recorded, and nobody is there elsewhere."""

import torch

from e2rl.ego.replay import ReplayEgo
from e2rl.sim.env import SimSettings
from e2rl.traffic.replay import Replay
from e2rl.traffic.rollout import roll_out
from tests.prior.small import curved_scenes
from tests.synthesizer.test_synthesizer import world_of
from tests.synthesizer.traffic_scenes import ROWS, drive, scenes


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
    assert torch.equal(rollouts["valid"][:, :, 1:], valid)
    assert torch.equal(rollouts["states"][:, :, 1:][valid], logged[valid])
    assert not rollouts["adversaries"].any() and (rollouts["transport_others"] == 0).all()


def test_with_a_replayed_ego_everybody_is_the_log_whatever_the_seed_and_how_often_it_replans():
    scene_set = recorded()
    index = torch.arange(3)
    for seed, replan in ((0, 5), (9, 3), (4, 50)):
        rollouts = roll_out(
            scene_set, index, index + seed, torch.zeros(3), ReplayEgo(), Replay(), SimSettings(replay_ego=True), replan
        )
        valid = scene_set.scenes["logged_valid"]
        assert torch.equal(rollouts["valid"], valid)
        assert torch.equal(rollouts["states"][valid], scene_set.scenes["logged"][valid])


def test_after_the_recording_s_end_nobody_is_there():
    scene = curved_scenes(steps=30)
    on = Replay()
    episode = on.begin(scene, torch.zeros(1, dtype=torch.int64), torch.zeros(1))
    world = world_of(scene)
    world.step = torch.tensor([12])
    _, plan = on.replan(episode, world, world.states[:, :1])
    here = scene["logged_valid"][:, 13:31, :ROWS].transpose(1, 2)
    assert torch.equal(plan.on_map[..., :18], here) and not plan.on_map[..., 18:].any()
    assert torch.equal(plan.states()[..., :18, :], scene["logged"][:, 13:31, :ROWS].transpose(1, 2))
