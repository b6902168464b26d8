"""Sparse control: whom pulls move, at which steps, and raw proposals."""

import pytest
import torch

from e2rl.prior.lane_relative import ACCEL_SCALE, KNOTS, SIZE
from e2rl.run.errors import InputError
from e2rl.traffic.e2.control import ControlSettings, SparseControl
from e2rl.traffic.e2.pull import Pull
from tests.traffic.e2.replan_case import MEMBER, OTHERS, Case


def pulled(case, eta=1.0, strength=8.0, k=2, vehicles=None):
    """x0 after less x0 before control, with the anchor's pull alone."""
    eta = case.eta(eta)
    level = torch.tensor(0.5)
    lateral = torch.full((*case.knots.shape[:2], SIZE - KNOTS), torch.nan)
    goal = torch.cat([case.knots / ACCEL_SCALE, lateral], -1)
    vehicles = case.coalition if vehicles is None else vehicles
    control = SparseControl(eta > 0, [Pull(goal, vehicles, strength * eta)])
    _, before, after = control(case.denoising(case.noise(), level, k))
    return after - before


def test_a_pull_moves_the_coalition_alone():
    assert (pulled(Case())[:, OTHERS] == 0).all()


def test_a_pull_moves_what_its_goal_names_alone():
    shift = pulled(Case())[:, MEMBER]
    assert (shift[:, :KNOTS] != 0).any()
    assert (shift[:, KNOTS:].abs() < 1e-5).all()


def test_a_pull_acts_at_every_step_but_the_last_which_has_no_price():
    case = Case()
    steps = range(1, case.prior.sampler.steps + 1)
    acts = [bool((pulled(case, k=k) != 0).any()) for k in steps]
    assert acts == [k > 1 for k in steps]


def test_a_pull_goes_to_nothing_with_the_intensity():
    sizes = [float(pulled(Case(), eta=eta).norm()) for eta in (1e-3, 1e-2, 0.1, 1.0)]
    assert sizes == sorted(sizes)
    assert sizes[0] < 0.02 * sizes[-1]


def test_who_has_no_proposal_is_not_pulled():
    case = Case()
    assert (pulled(case, vehicles=case.coalition & False) == 0).all()


def test_scenes_without_intensity_are_the_prior_s_in_a_mixed_batch():
    shift = pulled(Case(), eta=[0.0, 1.0, 0.0, 2.0])
    assert (shift[[0, 2]] == 0).all()
    assert (shift[1] != 0).any()
    assert (shift[3] != 0).any()


def test_raw_proposals_take_the_sample_s_place_in_the_last_step():
    case = Case()
    level = torch.tensor(0.1)
    raw = torch.where(case.coalition[..., None], case.knots, torch.nan)
    control = SparseControl(case.eta(1.0) > 0, [], raw=raw)
    for k in (2, 1):
        _, x0, driven = control(case.denoising(case.noise(), level, k))
        assert torch.equal(driven[:, OTHERS], x0[:, OTHERS])
        if k == 2:
            assert torch.equal(driven, x0)
    accel = driven[:, MEMBER, :KNOTS] * ACCEL_SCALE
    torch.testing.assert_close(accel, case.knots[:, MEMBER])


def test_raw_proposals_have_no_budget():
    with pytest.raises(InputError, match="transport_budget"):
        ControlSettings(anchoring="raw", transport_budget=10.0)
