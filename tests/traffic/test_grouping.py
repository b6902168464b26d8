"""Rows and groups of nested states, and noise that depends on a scene's seed alone."""

from itertools import chain, combinations, pairwise

import pytest
import torch
from tensordict import TensorDict

from e2rl.prior.lane_relative import LaneState
from e2rl.sim.world import World
from e2rl.traffic.grouping import (
    MOST_ROWS,
    OVERHEAD,
    clone,
    crop_state,
    group_ends,
    group_scenes,
    noise_of,
    put_rows,
    take_rows,
    write_state,
)
from tests.traffic.e2.traffic_scenes import begin, scenes, synthesizer

WIDTH = 32
AGENTS = 40


def sized(counts, others=0):
    """A World whose scenes have so many vehicles, and so many other agents."""
    valid = torch.arange(AGENTS) < torch.tensor(counts)[:, None]
    valid[:, WIDTH : WIDTH + others] = True
    empty = torch.zeros(len(counts), AGENTS)
    route = torch.zeros(len(counts), WIDTH, dtype=torch.long)
    scene = TensorDict({"valid": valid, "route_log": route}, batch_size=[len(counts)])
    return World(
        scene,
        empty[:, 0].long(),
        states=empty[..., None].expand(-1, -1, 4),
        valid=valid,
        accel=empty,
        turn_rate=empty,
    )


def test_every_scene_is_in_one_group_that_holds_its_vehicles():
    counts = torch.randint(
        1, WIDTH + 1, (200,), generator=torch.Generator().manual_seed(0)
    ).tolist()
    groups = group_scenes(sized(counts, others=3))
    assert sorted(torch.cat([group.rows for group in groups]).tolist()) == list(
        range(200)
    )
    for group in groups:
        here = [counts[row] for row in group.rows.tolist()]
        rows = group.vehicles * len(here)
        assert group.vehicles == max(here)
        assert group.others == 3
        assert rows <= MOST_ROWS


def seconds(sizes, ends):
    """Of groups that end so."""
    return sum(
        OVERHEAD + sizes[begin] * (end - begin) for begin, end in pairwise([0, *ends])
    )


@pytest.mark.parametrize("seed", range(20))
def test_no_other_groups_take_less_time(seed):
    generator = torch.Generator().manual_seed(seed)
    sizes = torch.randint(1, 60, (9,), generator=generator).sort(descending=True)[0]
    sizes = sizes.tolist()
    cuts = chain.from_iterable(combinations(range(1, 9), count) for count in range(9))
    least = min(seconds(sizes, [*inner, 9]) for inner in cuts)
    assert seconds(sizes, group_ends(sizes)) == least


def test_what_changes_in_a_crop_arrives_where_it_belongs_and_nothing_else_changes():
    on = synthesizer()
    scene = scenes(3).scenes
    state, (group,) = begin(on, scene, eta=1.0), group_scenes(World.at_start(scene))
    part = crop_state(state, group, width=state.routed.route.shape[1])
    whole = clone(state)
    part.routed.conflict_s[0, 1, 2] += 7.0
    part.path_kl[1, 3] += 1.0
    write_state(whole, part, group=group)
    rows = group.rows.tolist()
    changed = whole.routed.conflict_s != state.routed.conflict_s
    assert changed.nonzero().tolist() == [[rows[0], 1, 2]]
    assert whole.path_kl.nonzero().tolist() == [[rows[1], 3]]
    assert group.vehicles < changed.shape[1]
    assert torch.equal(whole.lane.s, state.lane.s), "there is padding to crop"


def test_noise_is_standard_and_depends_on_seed_and_draw_only():
    seed = torch.tensor([3, 4, 3])
    draw = torch.tensor([1, 1, 2])
    noise = noise_of(seed, draw, shape=(5000,))
    assert noise.mean(1).abs().max() < 0.06
    assert (noise.std(1) - 1).abs().max() < 0.04
    assert torch.equal(noise[2:], noise_of(seed[2:], draw[2:], shape=(5000,)))
    assert not torch.equal(noise[0], noise[1])
    assert not torch.equal(noise[0], noise[2])
    uniform = noise_of(seed, draw, shape=(5000,), uniform=True)
    assert uniform.min() >= 0
    assert uniform.max() < 1


def test_rows_are_taken_and_put_in_nested_states_without_touching_the_original():
    state = LaneState(*torch.arange(40.0).reshape(10, 4))
    rows = torch.tensor([2, 0])
    part = take_rows(state, rows)
    assert part.v.tolist() == [18.0, 16.0]
    back = put_rows(state, rows, new=part.map(lambda value: value + 100))
    assert back.v.tolist() == [116.0, 17.0, 118.0, 19.0]
    assert state.v.tolist() == [
        16.0,
        17.0,
        18.0,
        19.0,
    ]
