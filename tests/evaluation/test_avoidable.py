"""Evasions that a rollout's file keeps: from the ego's own start, and clear of everybody."""

import torch

from e2rl.metrics.evasion import add_avoidable, spliced
from e2rl.scenes.boxes import separation
from e2rl.sim.env import SimSettings
from tests.synthetic import make_scenes

SLOW_AHEAD = [(0, 0, 12.0), (40, 0, 3.0), (-40, 1, 5.0)]


def test_a_collision_has_an_evasion_that_touches_nobody_and_a_clean_rollout_has_none():
    scene_set = make_scenes(2, vehicles=SLOW_AHEAD, num_vrus=0, steps=60, max_vehicles=8, max_agents=10)
    scene = scene_set.scenes
    rollouts = {"states": scene["logged"], "valid": scene["logged_valid"]}
    rows = [{"cfr": 1, "contact_step": 40.0}, {"cfr": 0, "contact_step": float("nan")}]
    evasions = add_avoidable(rows, rollouts, scene, SimSettings())
    assert rows[0]["avoidable"] == 1 and "avoidable" not in rows[1]
    assert evasions.shape == (2, 61, 4) and evasions[1].isnan().all()
    torch.testing.assert_close(evasions[0, 0], scene["logged"][0, 0, 0])
    size = scene["size"][0]
    gap = separation(evasions[0][:, None], size[:1], scene["logged"][0, :, 1:], size[1:])
    assert (gap[scene["logged_valid"][0, :, 1:]] > 0).all()
    driven = separation(scene["logged"][0, :, :1], size[:1], scene["logged"][0, :, 1:2], size[1:2])
    assert (driven < 0).any(), "the ego as driven has the collision"


def test_an_evasion_from_a_moment_on_follows_what_was_driven_until_then():
    driven, after = torch.zeros(3, 11, 4), torch.arange(1, 11.0)[None, :, None].expand(3, -1, 4)
    found = spliced(driven, after, torch.tensor([0, 4, 10]))[..., 0]
    assert found[0].tolist() == list(range(11))
    assert found[1].tolist() == [0] * 5 + [1, 2, 3, 4, 5, 6] and found[2].tolist() == [0] * 11
