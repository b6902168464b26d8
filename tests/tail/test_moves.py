"""Moves keep the standard normal law, and change what their block holds."""

import pytest
import torch

from e2rl.tail.moves import ACCEPTED, KINDS, LEAST, Moves

VEHICLES = 3
NUMBERS = 9  # of a vehicle: the route's, and two of each of four replans
REPLAN = torch.tensor([0, 0, 0, 1, 1, 2, 2, 3, 3])


def moves(weight=(0.0, 1.0, 3.0), seed=0):
    return Moves(torch.tensor(weight), REPLAN, torch.Generator().manual_seed(seed))


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


def test_vehicles_alone_are_drawn_by_their_weights():
    x = torch.zeros(20_000, VEHICLES, NUMBERS)
    proposal = moves().propose(x)
    alone = proposal.normals[proposal.kind == 1] != 0
    shares = alone.any(2).double().mean(0)
    torch.testing.assert_close(
        shares, torch.tensor([0.0, 0.25, 0.75]).double(), atol=0.03, rtol=0
    )


def test_step_sizes_follow_the_accepted_fraction():
    learner = moves()
    kind = torch.arange(KINDS).repeat(100)
    before = learner.size.clone()
    learner.learn(kind, torch.zeros(len(kind), dtype=torch.bool))
    assert (learner.size < before).all()
    for _ in range(50):
        learner.learn(kind, torch.zeros(len(kind), dtype=torch.bool))
    assert (learner.size == LEAST).all()
    for _ in range(50):
        learner.learn(kind, torch.ones(len(kind), dtype=torch.bool))
    assert (learner.size == 1).all()


def test_the_accepted_fraction_aimed_at_leaves_them_as_they_are():
    learner = moves()
    before = learner.size.clone()
    accepted = torch.arange(1000) < 1000 * ACCEPTED
    learner.learn(torch.zeros(1000, dtype=torch.int64), accepted)
    torch.testing.assert_close(learner.size, before)
