"""The observation of a mirrored scene is the mirrored observation."""

import torch

import e2rl
from e2rl.sim.env import DrivingEnv, SimSettings
from e2rl.sim.observation import mirrored


def observations(scenes, actions):
    """[B, T, D] of a drive by actions [T, 2] in every scene."""
    env, seen = DrivingEnv(scenes, SimSettings(), len(scenes)), []
    td = env.reset()
    for action in actions:
        seen.append(td["observation"])
        td = env.step(td.set("action", action.expand(len(scenes), 2)))["next"].exclude("reward")
    return torch.stack(seen, 1)


def test_driving_in_the_mirror_looks_like_the_mirror_of_driving():
    """Roads, lights, curves and traffic of the bundled scenes; the ego steers and accelerates at random."""
    torch.manual_seed(0)
    scenes = e2rl.load_scenes("bundled", num_scenes=16, mirror=True)
    first = [k for k, name in enumerate(scenes.scene_id) if f"{name}~mirrored" in scenes.scene_id][:8]
    other = [scenes.scene_id.index(f"{scenes.scene_id[k]}~mirrored") for k in first]
    actions = torch.randn(20, 2) * torch.tensor([1.5, 0.15])
    seen = observations(scenes.chosen(first), actions)
    reflected = observations(scenes.chosen(other), actions * torch.tensor([1.0, -1.0]))
    assert torch.allclose(mirrored(seen), reflected, atol=2e-3)
    assert not torch.allclose(seen, reflected, atol=0.1), "and these scenes are not symmetric themselves"
    assert torch.equal(mirrored(mirrored(seen)), seen)
