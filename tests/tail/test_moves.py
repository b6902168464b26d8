"""Moves keep the standard normal law, and change what their block holds."""

import pytest
import torch

from e2rl.tail.moves import ACCEPTED, KINDS, LEAST, Moves, Proposal

VEHICLES = 3
NUMBERS = 9  # of a vehicle: the route's, and two of each of four replans
REPLAN = torch.tensor([0, 0, 0, 1, 1, 2, 2, 3, 3])


def moves(effect=(0.0, 0.25, 0.75), seed=0):
    return Moves(torch.tensor(effect), REPLAN, torch.Generator().manual_seed(seed))


def test_normals_stay_standard_normal_and_uncorrelated():
    generator = torch.Generator().manual_seed(1)
    x = torch.randn(40_000, VEHICLES, NUMBERS, generator=generator)
    moved = moves().propose(x).normals.flatten(1)
    covariance = moved.T @ moved / len(moved)
    torch.testing.assert_close(
        covariance, torch.eye(VEHICLES * NUMBERS), atol=0.03, rtol=0
    )


@pytest.mark.parametrize("alone", [False, True])
@pytest.mark.parametrize("later", [False, True])
def test_a_kind_changes_its_block_alone(alone, later):
    x = torch.zeros(4000, VEHICLES, NUMBERS)
    proposal = moves().propose(x)
    changed = proposal.normals[proposal.kind == alone + 2 * later] != 0
    vehicles = changed.any(2).sum(1)
    assert set(vehicles.tolist()) == ({1} if alone else {VEHICLES})
    begins = {tuple(row) for row in changed.any(1).int().tolist()}
    expected = {tuple((begin <= REPLAN).int().tolist()) for begin in range(4)}
    assert begins == (expected if later else {(1,) * NUMBERS})


def test_vehicles_alone_are_drawn_by_their_effects():
    x = torch.zeros(20_000, VEHICLES, NUMBERS)
    proposal = moves().propose(x)
    alone = proposal.normals[proposal.kind == 1] != 0
    shares = alone.any(2).double().mean(0)
    torch.testing.assert_close(
        shares, torch.tensor([0.0, 0.25, 0.75]).double(), atol=0.03, rtol=0
    )


def made(count, kind=0, vehicle=-1, begin=0):
    """Moves of one kind of block."""
    same = torch.ones(count, dtype=torch.int64)
    return Proposal(
        torch.zeros(count, VEHICLES, NUMBERS), kind * same, vehicle * same, begin * same
    )


def learned(learner, accepted, effect=1.0, **block):
    count = len(accepted)
    effects = torch.full((count,), effect, dtype=torch.float64)
    learner.learn(made(count, **block), accepted, effects)


@pytest.mark.parametrize("kind", range(KINDS))
def test_step_sizes_follow_the_accepted_fraction(kind):
    learner = moves()
    before = learner.size.clone()
    learned(learner, torch.zeros(100, dtype=torch.bool), kind=kind)
    assert learner.size[kind] < before[kind]
    for _ in range(50):
        learned(learner, torch.zeros(100, dtype=torch.bool), kind=kind)
    assert learner.size[kind] == LEAST
    for _ in range(50):
        learned(learner, torch.ones(100, dtype=torch.bool), kind=kind)
    assert learner.size[kind] == 1
    others = torch.arange(KINDS) != kind
    torch.testing.assert_close(learner.size[others], before[others])


def test_the_accepted_fraction_aimed_at_leaves_them_as_they_are():
    learner = moves()
    before = learner.size.clone()
    learned(learner, torch.arange(1000) < 1000 * ACCEPTED)
    torch.testing.assert_close(learner.size, before)


def test_moves_without_an_effect_say_nothing_of_the_step_size():
    learner = moves()
    before = learner.size.clone()
    learned(learner, torch.ones(100, dtype=torch.bool), effect=0.0)
    torch.testing.assert_close(learner.size, before)


def test_the_step_size_follows_moves_by_their_effects():
    """Of 100 moves 35 with an effect are refused, the others count as little as it."""
    learner = moves()
    before = learner.size.clone()
    accepted = torch.arange(100) >= 35
    effect = torch.where(accepted, 0.01, 1.0).double()
    learner.learn(made(100), accepted, effect)
    assert learner.size[0] < before[0]


def test_vehicles_without_an_effect_are_moved_less_often():
    """98 moves of the third vehicle do nothing: 0.75 * 2 / 100 beside 0.25."""
    learner = moves()
    block = {"kind": 1, "vehicle": 2}
    learned(learner, torch.ones(98, dtype=torch.bool), effect=0.0, **block)
    proposal = learner.propose(torch.zeros(20_000, VEHICLES, NUMBERS))
    alone = proposal.vehicle[proposal.kind % 2 == 1]
    share = (alone == 2).double().mean()
    torch.testing.assert_close(float(share), 0.015 / 0.265, atol=0.01, rtol=0)


def test_vehicles_without_an_effect_are_drawn_anew_in_moves_of_all():
    """The second one's step is that of all, the third's almost 1, and the first's, whose
    effect is not learned, that of all."""
    learner = moves()
    block = {"kind": 1, "vehicle": 2}
    learned(learner, torch.ones(998, dtype=torch.bool), effect=0.0, **block)
    proposal = learner.propose(torch.zeros(20_000, VEHICLES, NUMBERS))
    size = proposal.normals[proposal.kind == 0].std((0, 2))
    everyone = float(learner.size[0])
    torch.testing.assert_close(
        size, torch.tensor([everyone, everyone, 1.0]), atol=0.01, rtol=0
    )


def test_replans_without_an_effect_begin_fewer_blocks():
    learner = moves()
    block = {"kind": 2, "begin": 3}
    learned(learner, torch.ones(98, dtype=torch.bool), effect=0.0, **block)
    proposal = learner.propose(torch.zeros(20_000, VEHICLES, NUMBERS))
    begins = proposal.begin[proposal.kind >= 2]
    share = (begins == 3).double().mean()
    torch.testing.assert_close(float(share), 0.02 / 3.02, atol=0.005, rtol=0)
