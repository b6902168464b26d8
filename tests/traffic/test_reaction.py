"""The lookahead asks the real ego how it would drive against a plan."""

import torch

from e2rl.prior.lane_relative import HORIZON
from e2rl.scenes.recording import DT
from e2rl.sim.world import World
from e2rl.traffic.lookahead import Lookahead
from e2rl.traffic.motion import constant_speed_states
from tests.traffic.e2.traffic_scenes import EGO, scenes

TIMES = DT * torch.arange(1, HORIZON + 1)


def onward(world):
    return constant_speed_states(world.scene, world, times=TIMES)


def test_one_period_as_long_as_the_horizon_is_the_ego_s_plan():
    world = World.at_start(scenes(3).scenes)
    for rows in (torch.tensor([2, 0]), torch.arange(3)):
        result = Lookahead(EGO, world, period=HORIZON)(rows, onward(world)[rows])
        torch.testing.assert_close(result, EGO.plan(world)[rows])


def test_the_ego_reacts_to_what_the_others_plan():
    world = World.at_start(scenes(2).scenes)
    look = Lookahead(EGO, world, period=5)
    rows = torch.arange(2)
    halted = onward(world)
    halted[:, 1] = world.states[
        :, 1, None
    ]  # the vehicle ahead stands still from now on
    halted[:, 1, :, 3] = 0.0

    def gone(planned):
        return (look(rows, planned)[:, -1, :2] - world.states[:, 0, :2]).norm(dim=-1)  # noqa: E731

    assert (gone(halted) < gone(onward(world)) - 5.0).all()
    assert (gone(halted) < world.states[:, 1, 0] - world.states[:, 0, 0]).all(), (
        "it does not drive through"
    )


def test_scenes_may_be_asked_about_in_any_order():
    world = World.at_start(scenes(3).scenes)
    look = Lookahead(EGO, world)
    planned = onward(world)
    rows = torch.tensor([2, 0, 1])
    torch.testing.assert_close(
        look(rows, planned[rows]), look(torch.arange(3), planned)[rows]
    )
