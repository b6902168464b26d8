"""Field look-up: exact on linear fields, far outside the grid, consistent with the synthetic road."""

import torch

from e2rl.scenes.drivable_area import FAR, off_road
from tests.synthetic import LANE_WIDTH, make_scenes


def test_bilinear_is_exact_on_planes():
    cells = torch.arange(20.0)
    plane = 0.1 * cells[:, None] - 0.2 * cells[None] + 1.0
    origin = torch.tensor([[-5.0, 3.0], [2.0, -1.0]])
    points = origin[:, None] + 19 * torch.rand(2, 50, 2)
    local = points - origin[:, None]
    expected = 0.1 * local[..., 0] - 0.2 * local[..., 1] + 1.0
    assert torch.allclose(off_road(points, plane.repeat(2, 1, 1), origin), expected, atol=1e-5)


def test_outside_the_grid_is_far():
    points = torch.tensor([[[-0.1, 3.0], [3.0, 9.2], [9.0, 9.0]]])
    assert off_road(points, torch.zeros(1, 10, 10), torch.zeros(1, 2)).tolist() == [[FAR, FAR, 0.0]]


def test_synthetic_road():
    scene = make_scenes(1).scenes
    y = torch.tensor([0.0, LANE_WIDTH / 2, LANE_WIDTH, -LANE_WIDTH / 2 - 3.0, 2 * LANE_WIDTH + 1.0])
    points = torch.stack([torch.full_like(y, 30.0), y], -1)[None]
    value = off_road(points, scene["field"], scene["field_origin"])[0]
    assert (value[:3] < 0).all() and torch.allclose(value[3:], torch.tensor([2.0, 1.75]), atol=0.3)


def test_points_may_name_the_row_of_their_field():
    torch.manual_seed(0)
    field, origin, row = torch.randn(3, 12, 12).half(), torch.randn(3, 2), torch.tensor([2, 0, 2, 1])
    points = 12 * torch.rand(4, 7, 2)
    assert torch.equal(off_road(points, field, origin, row), off_road(points, field[row], origin[row]))
