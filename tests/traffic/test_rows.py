"""Rows of nested states, and noise that depends on a scene's seed alone."""

import torch

from e2rl.prior.lane_relative import LaneState
from e2rl.sim.world import World
from e2rl.traffic.grouping import noise_of, put_rows, take_rows
from tests.traffic.e2.traffic_scenes import scenes


def test_noise_is_standard_and_depends_on_seed_and_draw_only():
    seed, draw = torch.tensor([3, 4, 3]), torch.tensor([1, 1, 2])
    noise = noise_of(seed, draw, (5000,))
    assert noise.mean(1).abs().max() < 0.06 and (noise.std(1) - 1).abs().max() < 0.04
    assert torch.equal(noise[2:], noise_of(seed[2:], draw[2:], (5000,)))
    assert not torch.equal(noise[0], noise[1]) and not torch.equal(noise[0], noise[2])
    uniform = noise_of(seed, draw, (5000,), uniform=True)
    assert uniform.min() >= 0 and uniform.max() < 1


def test_rows_are_taken_and_put_in_nested_states_without_touching_the_original():
    state = LaneState(*torch.arange(40.0).reshape(10, 4))
    rows = torch.tensor([2, 0])
    part = take_rows(state, rows)
    assert part.v.tolist() == [18.0, 16.0]
    back = put_rows(state, rows, part.map(lambda value: value + 100))
    assert back.v.tolist() == [116.0, 17.0, 118.0, 19.0] and state.v.tolist() == [16.0, 17.0, 18.0, 19.0]


def test_states_may_be_worlds_tensors_tensordicts_or_nothing():
    world, row = World.at_start(scenes(2).scenes), torch.tensor([1])
    one = take_rows(world, row)
    assert len(one.scene) == 1 and one.plan is None
    assert put_rows(world.step, row, torch.tensor([7])).tolist() == [0, 7] and world.step.tolist() == [0, 0]
    assert (put_rows(world.scene, row, world.scene[:1])["scene_index"] == 0).all()
    assert take_rows(None, row) is None and put_rows(None, row, None) is None
