"""What traffic knows of the ego: by default nothing that a planner could lie about."""

import math

import pytest
import torch

from e2rl.planners.ego import Ego, track
from e2rl.run.errors import InputError
from e2rl.scenes.recording import DT
from e2rl.sim.world import World
from e2rl.traffic.nominal import PREDICTIONS, NominalTraffic, along_mission, turn_rate_and_acceleration
from tests.traffic.e2.traffic_scenes import EGO, begin, drive, replanned, scenes, synthesizer


class Liar(Ego):
    """Drives as EGO does, and announces a plan 50 m beside its own."""

    def plan(self, world):
        announced = EGO.plan(world).clone()
        announced[..., 1] += 50.0
        return announced

    def act(self, world, observation, plan):
        honest = EGO.plan(world)
        return track(world.states[:, 0], world.states[:, 0], honest[:, 0])


class Honest(Liar):
    def plan(self, world):
        return EGO.plan(world)


def driven(ego, eta=2.0, **settings):
    method = NominalTraffic(synthesizer().prior, **settings) if eta == 0 else synthesizer(**settings)
    return drive(scenes(3), method, eta, ego=ego)["states"]


@pytest.mark.parametrize("prediction", PREDICTIONS)
@pytest.mark.parametrize("eta", [0.0, 2.0])
def test_nonsense_in_the_announced_plan_changes_nothing(prediction, eta):
    assert torch.equal(*(driven(ego(1), eta, prediction=prediction) for ego in (Honest, Liar)))


@pytest.mark.parametrize("eta", [0.0, 2.0])
def test_who_is_told_the_plan_believes_it(eta):
    assert not torch.equal(*(driven(ego(1), eta, knowledge="plan") for ego in (Honest, Liar)))


@pytest.mark.parametrize("prediction", PREDICTIONS)
def test_predictions_begin_at_the_ego_and_know_only_its_world(prediction):
    on, scene = NominalTraffic(synthesizer().prior, prediction=prediction), scenes(3).scenes
    world, state = World.at_start(scene), begin(synthesizer(), scene)
    found = on.predicted_ego(state, world)
    assert found.shape == (3, 50, 4) and found.isfinite().all()
    first = world.states[:, 0, 3] * DT
    way = (found[:, 0, :2] - world.states[:, 0, :2]).norm(dim=-1)
    torch.testing.assert_close(way, first, rtol=0.1, atol=0.05)


def test_constant_turn_rate_and_acceleration_is_the_closed_form():
    world = World.at_start(scenes(1).scenes)
    world.accel = torch.full_like(world.accel, 0.5)
    world.turn_rate = torch.full_like(world.accel, 0.1)
    v0, heading = world.states[0, 0, 3], world.states[0, 0, 2]
    time = DT * torch.arange(1, 51)
    found = turn_rate_and_acceleration(world)[0]
    torch.testing.assert_close(found[:, 3], v0 + 0.5 * time)
    torch.testing.assert_close(found[:, 2], heading + 0.1 * time)
    radius = v0 / 0.1  # at constant speed, the first second's arc
    assert (found[9, 1] - world.states[0, 0, 1]).item() == pytest.approx(radius.item() * (1 - math.cos(0.1)), rel=0.1)


def test_along_the_mission_the_acceleration_fades():
    world = World.at_start(scenes(1).scenes)
    world.accel = torch.full_like(world.accel, -2.0)
    speed = along_mission(world)[0, :, 3]
    assert (speed.diff() <= 0).all()
    assert (world.states[0, 0, 3] - speed[-1]).item() == pytest.approx(2.0 * 0.5, abs=1e-3)


def test_choices_that_are_none_are_refused():
    for settings in ({"knowledge": "all"}, {"prediction": "guess"}):
        with pytest.raises(InputError, match=next(iter(settings))):
            replanned(synthesizer(**settings), scenes(1).scenes)
