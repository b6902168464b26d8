"""The grid of goals: cells and places are inverses, and accelerations lead where they say."""

import torch

from e2rl.planners.bits_network import CELLS, HORIZON, SIDES, cell_of, needed_acceleration, place, reach


def test_cells_and_places_are_inverses():
    generator = torch.Generator().manual_seed(0)
    speed = 20 * torch.rand(1000, generator=generator)
    way = 1.1 * reach(speed) * torch.rand(1000, generator=generator)
    side = 10 * torch.rand(1000, generator=generator) - 5
    cell, residual = cell_of(speed, way, side)
    again = place(speed, cell[:, None], residual[:, None])
    torch.testing.assert_close(again[0][:, 0], way, atol=1e-3, rtol=0)
    torch.testing.assert_close(again[1][:, 0], side, atol=1e-4, rtol=0)
    on_grid = (way < reach(speed)) & (side.abs() < SIDES / 2)
    assert (residual[on_grid].abs() <= 0.5001).all() and cell.min() >= 0 and cell.max() < CELLS


def test_the_needed_acceleration_drives_the_way():
    speed, way = torch.tensor([10.0, 10.0, 10.0, 0.0]), torch.tensor([50.0, 75.0, 20.0, 5.0])
    accel = needed_acceleration(speed, way)
    torch.testing.assert_close(accel, torch.tensor([0.0, 2.0, -2.5, 0.4]))
    time = torch.where(accel < 0, speed / -accel, HORIZON).clamp(max=HORIZON)  # to the halt
    torch.testing.assert_close(speed * time + accel * time**2 / 2, way)
