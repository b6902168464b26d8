"""Who is left alone by CCDiff and CAT drives its recording."""

import pytest
import torch

from e2rl.sim.world import World
from e2rl.traffic.rule_based import Replay
from tests.traffic.baselines.attacks import rival
from tests.traffic.e2.traffic_scenes import EGO, begin, executed, scenes


@pytest.mark.parametrize("name", ["ccdiff", "cat"])
def test_others_replay_and_the_prior_sees_where_they_are(name):
    on, scene = rival(name), scenes(3).scenes
    state, world = begin(on, scene, 2.0), World.at_start(scene)
    for _ in range(2):
        plan = EGO.plan(world)
        state, traffic = on.replan(state, world, plan)
        logged = Replay().replan(None, world, plan)[1]
        driven = state.top if name == "ccdiff" else state.held
        assert torch.equal(traffic.states[~driven], logged.states[~driven])
        assert torch.equal(traffic.present[~driven], logged.present[~driven])
        world = executed(world, traffic, plan)
        here = scene["valid"][:, :8] & ~driven
        torch.testing.assert_close(state.lane.states()[here][:, :3], logged.states[here][:, 4, :3])
    assert traffic.adversary.any() and not (traffic.adversary & ~driven).any()
