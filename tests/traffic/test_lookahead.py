import torch
from e2rl.synthesizer.grouping import group_scenes
from e2rl.synthesizer.lookahead import Lookahead

from e2rl.ego.idm import IDMEgo
from e2rl.prior.lane_relative import HORIZON
from e2rl.scene.recording import DT
from e2rl.synthesizer.control import ControlSettings
from e2rl.synthesizer.motion import constant_speed_states
from tests.synthesizer.test_synthesizer import EGO, begin, world_of
from tests.synthesizer.traffic_scenes import scenes, synthesizer

TIMES = DT * torch.arange(1, HORIZON + 1)


def test_one_period_as_long_as_the_horizon_is_the_ego_s_plan():
    world = world_of(scenes(3).scenes)
    look, (group,) = Lookahead(EGO, world, HORIZON), group_scenes(world)
    planned = constant_speed_states(world.scene, world, TIMES)[group.rows]
    torch.testing.assert_close(look(group, planned), EGO.plan(world)[group.rows])


def test_the_ego_reacts_to_what_the_others_plan():
    world = world_of(scenes(2).scenes)
    look, (group,) = Lookahead(IDMEgo(), world, 5), group_scenes(world)
    onward = constant_speed_states(world.scene, world, TIMES)[group.rows]
    halted = onward.clone()
    halted[:, 1] = world.states[group.rows, 1, None]  # the vehicle ahead stands still from now on
    halted[:, 1, :, 3] = 0.0
    gone = lambda planned: (look(group, planned)[:, -1, :2] - world.states[group.rows, 0, :2]).norm(dim=-1)  # noqa: E731
    assert (gone(halted) < gone(onward) - 5.0).all()
    gap = world.states[group.rows, 1, 0] - world.states[group.rows, 0, 0]
    assert (gone(halted) < gap).all()  # it does not drive through


def test_lookahead_changes_the_attack_but_nothing_at_zero_intensity():
    scene = scenes(3).scenes
    world = world_of(scene)
    plan = EGO.plan(world)
    plain, ahead = synthesizer(), synthesizer(control=ControlSettings(lookahead=2))

    def driven(on, eta, ego):
        return on.replan(begin(on, scene, eta), world, plan, ego)[1].states()

    assert torch.equal(driven(plain, 0.0, None), driven(ahead, 0.0, EGO))
    assert torch.equal(driven(plain, 2.0, EGO), driven(plain, 2.0, None))
    assert not torch.equal(driven(ahead, 2.0, EGO), driven(plain, 2.0, EGO))
