"""Closed-loop rollouts: seeds decide, what a method plans is driven, figures are of the
whole rollout."""

import inspect
import textwrap

import pytest
import torch

from e2rl.planners.log_replay import ReplayEgo
from e2rl.prior.lane_relative import HORIZON
from e2rl.scenes.recording import DT
from e2rl.sim.settings import SimSettings
from e2rl.traffic import traffic
from e2rl.traffic.nominal import NominalTraffic
from e2rl.traffic.rollout import synthesize_traffic
from e2rl.traffic.traffic import Traffic, TrafficPlan, keep_velocity
from tests.traffic.e2.traffic_scenes import (
    EGO,
    ROWS,
    VEHICLES,
    drive,
    scenes,
    synthesizer,
)


def test_the_method_of_a_few_lines_in_the_documentation_drives_everybody_as_it_says():
    """Each vehicle brakes to a halt at 2 m/s^2 from its start, whatever the seed."""
    source = inspect.getdoc(traffic).partition("    class Halt")[1:]
    names = {
        "torch": torch,
        "DT": DT,
        "HORIZON": HORIZON,
        "Traffic": Traffic,
        "TrafficPlan": TrafficPlan,
    }
    exec(textwrap.dedent("".join(source)), names)
    scene_set = scenes(2, steps=80)
    out = drive(scene_set, names["Halt"](), 1.0, seeds=[3, 4])
    place = slice(1, len(VEHICLES))
    start = scene_set.scenes["start"][:, None, place]
    time = torch.minimum(DT * torch.arange(81)[:, None], start[..., 3] / 2.0)
    track = out.states[:, :, place]
    torch.testing.assert_close(
        track[..., 3], start[..., 3] - 2.0 * time, rtol=0, atol=1e-3
    )
    torch.testing.assert_close(
        track[..., 0], start[..., 0] + start[..., 3] * time - time**2, rtol=0, atol=1e-2
    )
    assert torch.equal(track[..., 1:3], start[..., 1:3].expand_as(track[..., 1:3]))
    assert out.valid[:, :, place].all()
    assert not out.adversaries.any()
    assert (out.transport_others == 0).all()


def test_zero_intensity_is_the_nominal_rollout_more_of_it_is_not_and_seeds_decide():
    scene_set = scenes(2, steps=10)
    on = synthesizer()
    nominal = drive(scene_set, NominalTraffic(on.prior), 0.0)
    zero = drive(scene_set, on, 0.0)
    pushed = drive(scene_set, on, 2.0)
    again = drive(scene_set, synthesizer(), 2.0)
    other = drive(scene_set, on, 2.0, seeds=[10, 11])
    assert torch.equal(pushed.states, again.states)
    assert not torch.equal(pushed.states[:, :, 1:5], other.states[:, :, 1:5])
    assert torch.equal(nominal.states, zero.states)
    assert not zero.adversaries.any()
    assert (pushed.adversaries.any(1)).all()
    assert not pushed.adversaries[:, 0].any()
    assert (zero.transport_adversary == 0).all()
    assert (pushed.transport_adversary > 0).all()
    assert (zero.transport_anchor == 0).all()
    assert (nominal.transport_anchor == 0).all()


def test_the_start_is_the_scene_s_and_parked_vehicles_stay():
    scene_set = scenes(2, steps=10)
    out = drive(scene_set, synthesizer(), 2.0)
    assert out.states.shape == (2, 11, ROWS + 2, 4)
    torch.testing.assert_close(out.states[:, 0], scene_set.scenes["start"])
    assert torch.equal(out.valid[:, 0], scene_set.scenes["valid"])
    parked = len(VEHICLES) - 1
    torch.testing.assert_close(
        out.states[:, :, parked], out.states[:, :1, parked].expand(-1, 11, -1)
    )
    assert out.simulated[:, : len(VEHICLES)].all()
    assert not out.simulated[:, len(VEHICLES) :].any()
    assert out.states.isfinite().all()


@pytest.mark.parametrize("replay_ego", [False, True])
def test_traffic_drives_on_as_planned_after_the_ego_has_left(replay_ego):
    """The recording would put everybody back by hundreds of metres once a plan of 50
    steps is used up. An ego that plans by the log is replayed, also where the
    simulator's settings do not say so."""
    scene_set = scenes(2, steps=80)
    scene_set.scenes["logged_valid"][:, 4:, 0] = False
    scene_set.scenes["logged"][:, 50:, 1:ROWS, :2] += 500.0
    out = drive(scene_set, synthesizer(), 0.0, ego=ReplayEgo(), replay_ego=replay_ego)
    assert not out.valid[:, 5:, 0].any()
    assert not out.simulated[:, 0].any()
    place = out.valid[:, 1:, 1:5] & out.valid[:, :-1, 1:5]
    jump = (out.states[:, 1:, 1:5, :2] - out.states[:, :-1, 1:5, :2]).norm(dim=-1)
    assert place.any()
    assert jump[place].max() < 4.0


class Turns(Traffic):
    """Vehicle 1 is the adversary of the first half second, vehicle 2 of the rest; each
    costs a nat in all."""

    def reset(self, scenes, seed, eta):
        return torch.zeros_like(eta)

    def replan(self, state, world, ego_plan):
        states = keep_velocity(world.states[:, :ROWS])
        acting = torch.zeros(len(state), ROWS, dtype=torch.bool)
        cost = torch.zeros(len(state), ROWS)
        acting[:, 1], acting[:, 2] = state == 0, state > 0
        cost[:, 1], cost[:, 2], cost[:, 3] = 1.0, (state > 0).float(), 0.25
        present = world.valid[:, :ROWS, None].expand(states.shape[:-1])
        return state + 1, TrafficPlan(states, present, adversary=acting, path_kl=cost)


def test_adversaries_are_whoever_was_one_at_any_time_and_the_transport_is_shared_out():
    out = drive(scenes(2, steps=12), Turns(), 1.0)
    assert out.adversaries.nonzero()[:, 1].tolist() == [1, 2, 1, 2]
    assert out.transport_adversary.tolist() == [
        2.0,
        2.0,
    ]
    assert out.transport_others.tolist() == [0.25, 0.25]
    assert torch.equal(out.routes, scenes(2).scenes["route_log"].clamp(min=0)), (
        "nobody said otherwise"
    )


def test_the_traffic_of_a_round_is_the_rollouts_and_its_seeds_are_the_scenes_own():
    scene_set = scenes(4, steps=10)
    rows = torch.tensor([3, 1, 0])
    synthesize = synthesize_traffic(
        scene_set, synthesizer(), sim=SimSettings(), batch=2
    )
    result = synthesize(EGO, rows, 2.0, 5)
    assert torch.equal(result["scene_index"], rows)
    assert result["states"].shape[:2] == (
        3,
        11,
    )
    assert result["adversaries"].any(1).all()
    assert result["contact"].shape == (3,)
    alone = synthesize(EGO, rows[1:2], 2.0, 5)
    torch.testing.assert_close(
        alone["states"][0], result["states"][1], rtol=0, atol=2e-2
    )
    assert not torch.equal(synthesize(EGO, rows, 2.0, 6)["states"], result["states"])
