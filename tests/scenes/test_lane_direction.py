"""Driving against the lanes, on a two-lane road of opposite directions."""

import math

import torch

from e2rl.scenes.lane_graph import against_lanes

X = torch.arange(0.0, 40.0, 2.0)
ROAD = torch.cat([torch.stack([X, 0 * X], -1), torch.stack([X.flip(0), 0 * X + 3.5], -1)])[None]
LANE = torch.arange(2).repeat_interleave(len(X))[None]
AHEAD = torch.tensor([[[0.0, math.pi, math.pi / 2]]])


def against(y):
    return against_lanes(ROAD, LANE, torch.tensor([[[20.0, y]]]), AHEAD)[0, 0].tolist()


def test_a_vehicle_is_against_the_lanes_where_none_runs_with_it():
    assert against(0.0) == [False, True, False]
    assert against(3.5) == [True, False, False]


def test_between_two_lanes_or_off_them_nobody_is():
    assert against(1.75) == [False, False, False]
    assert against(-9.0) == [False, False, False]


def test_the_gap_between_two_lanes_in_the_list_is_no_lane():
    far = ROAD.clone()
    far[:, len(X) :, 1] = 100.0  # the list jumps from (38, 0) to (38, 100)
    middle = against_lanes(far, LANE, torch.tensor([[[38.0, 50.0]]]), torch.tensor([[[-math.pi / 2]]]))
    assert not middle.any()
