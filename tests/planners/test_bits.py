"""The ego bits: cheapest candidate, bounds, symmetries, its files."""

import pytest
import torch

from e2rl.planners.bits import BitsEgo
from e2rl.planners.bits_network import (
    ACCELERATION,
    CELLS,
    PLAN_SECONDS,
    SIDES,
    TIME,
    BitsNetwork,
    between,
    cell_of,
    load_bits,
    needed_acceleration,
    place,
    reach,
    save_bits,
)
from e2rl.planners.ego import PLAN_STEPS
from e2rl.run.errors import InputError
from e2rl.sim import dynamics
from e2rl.sim.observation import OBSERVATION_SIZE
from tests.planners.planners import worlds
from tests.sim.test_observation import quarter_turn
from tests.synthetic import make_scenes


def wild_ego(**changes):
    """An ego with random weights, whose plans use the whole range of controls and of
    goals."""
    ego = BitsEgo(checkpoint=None, **changes)
    generator = torch.Generator().manual_seed(0)
    for layer in (ego.network.goal_head[-1], ego.network.policy[-1]):
        layer.weight.data = 0.5 * torch.randn(layer.weight.shape, generator=generator)
    return ego


def test_plans_the_cheapest_candidate():
    _, world = worlds(
        make_scenes(3, vehicles=[(0.0, 0, 10.0), (22.0, 0, 6.0), (10.0, 1, 10.0)])
    )
    ego = wild_ego()
    candidates = ego.candidates(world)
    plan = ego.plan(world)
    costs = ego.costs(world, candidates)
    assert candidates.states.shape == (3, 40, PLAN_STEPS, 4)
    assert costs.std(1).min() > 1
    for k in range(3):
        assert torch.equal(plan[k], candidates.states[k, costs[k].argmin()])


def test_a_moved_scene_gets_the_moved_candidates():
    make = {"num_scenes": 2, "num_vehicles": 9, "num_vrus": 3, "red_light_x": 70.0}
    shift = torch.tensor([40.0, -25.0])
    _, here = worlds(make_scenes(**make))
    _, position = worlds(quarter_turn(make_scenes(**make), shift))
    ego = wild_ego()
    first = ego.candidates(here)
    second = ego.candidates(position)
    x, y, heading, speed = first.states.unbind(-1)
    moved = torch.stack(
        [shift[0] - y, shift[1] + x, dynamics.wrap(heading + torch.pi / 2), speed], -1
    )
    torch.testing.assert_close(
        second.states[..., :2],
        moved[..., :2],
        atol=2e-2,
        rtol=0,
    )
    torch.testing.assert_close(
        second.states[..., 3],
        speed,
        atol=1e-2,
        rtol=0,
    )
    torch.testing.assert_close(
        ego.costs(position, second),
        ego.costs(here, first),
        atol=0.5,
        rtol=1e-2,
    )


def test_a_file_gives_the_network_back_and_another_is_refused(tmp_path):
    network = wild_ego().network
    observed = torch.randn(4, OBSERVATION_SIZE)
    save_bits(network, tmp_path / "bits.safetensors", origin={"data": "made"})
    again = load_bits(str(tmp_path))
    for first, other in zip(
        network.goals(network.encode(observed)),
        again.goals(again.encode(observed)),
        strict=True,
    ):
        assert torch.equal(first, other)
        assert not other.requires_grad
    network.architecture["cells"] = 9
    save_bits(network, tmp_path / "bits.safetensors", origin={})
    for where, why in (
        (tmp_path, "another architecture"),
        (tmp_path / "no", "no bits.safetensors there"),
    ):
        with pytest.raises(InputError, match=why):
            BitsEgo(checkpoint=str(where))


def test_cells_and_places_are_inverses():
    generator = torch.Generator().manual_seed(0)
    speed = 20 * torch.rand(1000, generator=generator)
    way = 1.1 * reach(speed) * torch.rand(1000, generator=generator)
    side = 10 * torch.rand(1000, generator=generator) - 5
    cell, residual = cell_of(speed, way, side=side)
    again = place(speed, cell[:, None], residual=residual[:, None])
    torch.testing.assert_close(
        again[0][:, 0],
        way,
        atol=1e-3,
        rtol=0,
    )
    torch.testing.assert_close(
        again[1][:, 0],
        side,
        atol=1e-4,
        rtol=0,
    )
    on_grid = (way < reach(speed)) & (side.abs() < SIDES / 2)
    assert (residual[on_grid].abs() <= 0.5001).all()
    assert cell.min() >= 0
    assert cell.max() < CELLS


def test_the_grid_ends_where_2_5_metres_a_square_second_lead_in_5_seconds():
    assert reach(torch.tensor(10.0)).item() == pytest.approx(50 + 2.5 * 25 / 2)


def test_untrained_a_plan_keeps_its_speed_and_comes_over_in_1_4_seconds():
    side = torch.tensor([[1.0]])
    controls = (
        BitsNetwork()
        .eval()
        .controls(
            torch.zeros(1, 64),
            speed=torch.tensor([10.0]),
            offset=torch.zeros(1),
            distance=torch.tensor([[50.0]]),
            side=side,
        )
    )
    assert controls.acceleration.abs().max() < 1e-5
    assert controls.time.item() == pytest.approx(1.4)
    assert torch.equal(controls.shift, side)


def test_controls_stay_within_the_simulator_s_bounds():
    extremes = torch.tensor([-100.0, 100.0])
    accelerations = between(extremes, ACCELERATION, start=0.0)
    torch.testing.assert_close(accelerations, torch.tensor([-8.0, 5.0]))
    times = between(extremes, TIME, start=1.4)
    torch.testing.assert_close(times, torch.tensor([0.5, 4.0]))


def test_the_needed_acceleration_drives_the_distance():
    speed = torch.tensor([10.0, 10.0, 10.0, 0.0])
    way = torch.tensor([50.0, 75.0, 20.0, 5.0])
    accel = needed_acceleration(speed, way)
    torch.testing.assert_close(accel, torch.tensor([0.0, 2.0, -2.5, 0.4]))
    time = torch.where(accel < 0, speed / -accel, PLAN_SECONDS).clamp(
        max=PLAN_SECONDS
    )  # to the halt
    torch.testing.assert_close(speed * time + accel * time**2 / 2, way)
