import math
from dataclasses import replace

import pytest
import shapely
import torch

from e2rl.run.errors import InputError
from e2rl.scenes.boxes import corners
from e2rl.traffic.e2 import potentials
from e2rl.traffic.e2.motion import constant_speed_states
from e2rl.traffic.e2.potentials import (
    SAMPLED_STEPS,
    PotentialContext,
    PotentialSettings,
    annealed_temperature,
    box_gap,
    ttc_cost,
)
from tests.traffic.e2.crossing import make_world

UP = math.pi / 2
EGO = (0.0, 0.0, 0.0, 10.0)
SETTINGS = PotentialSettings()


def feasibility_potential(states, context, settings):
    return potentials.feasibility_potential(states[:, :, SAMPLED_STEPS], context, settings)


def adversarial_potential(states, context, settings, *temperature):
    return potentials.adversarial_potential(states[:, :, SAMPLED_STEPS], context, settings, *temperature)


POTENTIALS = [feasibility_potential, adversarial_potential]


def situation(*vehicles, targets=(), copies=1):
    """Cruising states [B, 8, 50, 4] in float64, and their context; targets: (vehicle, target) pairs."""
    world = make_world([EGO, *vehicles], copies)
    states = constant_speed_states(world.scene, world, 0.1 * torch.arange(1, 51)).double()
    scene = world.scene.apply(lambda x: x.double() if x.dtype == torch.float32 else x)
    target = torch.full((copies, 8), -1)
    for vehicle, aim in targets:
        target[:, vehicle] = aim
    return states, PotentialContext(
        scene,
        scene["start"][:, :8],
        scene["start_accel"][:, :8],
        world.valid[:, :8],
        scene["route_points"][:, :, 0],
        scene["route_valid"].any(-1),
        states[:, 0].clone(),
        target,
    )


def rough(states, seed=0):
    """Perturbed plans: every term is at work."""
    generator = torch.Generator().manual_seed(seed)
    scale = torch.tensor([1.0, 1.0, 0.3, 1.5], dtype=torch.float64)
    return states + scale * torch.randn(states.shape, generator=generator, dtype=torch.float64)


def busy(copies=1):
    states, context = situation(
        (12.0, 2.0, 0.1, 9.0),
        (20.0, -8.0, UP, 6.0),
        (22.0, -12.0, UP, 7.0),
        (15.0, 3.0, 0.0, 10.0),
        targets=[(1, 0), (2, 1)],
        copies=copies,
    )
    field = torch.linspace(-4, 4, context.scene["field"].shape[-1]).half()
    context.scene["field"] = field.expand_as(context.scene["field"]).contiguous()
    return rough(states), context


@pytest.mark.parametrize("potential", POTENTIALS)
def test_gradients_are_those_of_finite_differences(potential, monkeypatch):
    states, context = busy()
    # The impact term is left out: the moment of the impact is detached in it, by design.
    monkeypatch.setattr(potentials, "MAX_JERK", 0.5)
    monkeypatch.setattr(potentials, "MAX_LATERAL_ACCEL", 0.5)
    settings = replace(SETTINGS, impact_speed=0.0)
    states.requires_grad_()
    value = potential(states, context, settings)
    gradient = torch.autograd.grad(value.sum(), states)[0]
    assert gradient.abs().sum(-1)[0, 1:3].amax(-1).min() > 0
    generator = torch.Generator().manual_seed(1)
    step, checked = 1e-6, 0
    with torch.no_grad():
        for _ in range(60):
            i, h, c = (int(torch.randint(n, (), generator=generator)) for n in (5, 10, 4))
            shift = torch.zeros_like(states)
            shift[0, i, 5 * h + 4, c] = step
            up, down = (potential(states + way * shift, context, settings)[0, i] for way in (1, -1))
            moved = up - down
            assert moved / (2 * step) == pytest.approx(gradient[0, i, 5 * h + 4, c].item(), rel=1e-3, abs=1e-4)
            checked += abs(moved) > 0
    assert checked > 8


@pytest.mark.parametrize("potential", POTENTIALS)
def test_a_vehicle_s_term_moves_that_vehicle_alone_and_never_the_ego(potential):
    states, context = busy()
    states.requires_grad_()
    context = replace(context, ego_plan=context.ego_plan.requires_grad_())
    value = potential(states, context, SETTINGS)
    assert value[0, 0] == 0
    for vehicle in (1, 2):
        gradient, plan = torch.autograd.grad(
            value[0, vehicle], (states, context.ego_plan), retain_graph=True, allow_unused=True
        )
        moved = gradient.abs().sum((0, 2, 3))
        assert moved[vehicle] > 0 and moved.sum() == moved[vehicle] and plan is None


def test_gradients_are_finite_for_coincident_and_standing_vehicles():
    states, context = situation(
        (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), (5.0, 0.0, 0.0, 0.0), targets=[(1, 0), (2, 1), (3, 0)]
    )
    for plans in (states, torch.zeros_like(states), 1e3 * torch.ones_like(states)):
        plans = plans.clone().requires_grad_()
        held = replace(context, ego_plan=plans[:, 0].detach())
        for potential in POTENTIALS:
            value = potential(plans, held, SETTINGS)
            assert value.isfinite().all()
            assert torch.autograd.grad(value.sum(), plans)[0].isfinite().all()


def test_approaching_the_target_lowers_v_adv():
    values = []
    for late in (30.0, 20.0, 10.0, 5.0, 0.0):  # m by which the crossing vehicle misses the ego's arrival
        states, context = situation((30.0, -30.0 - late, UP, 10.0), targets=[(1, 0)])
        values.append(adversarial_potential(states, context, SETTINGS)[0, 1].item())
    assert values == sorted(values, reverse=True) and values[0] - values[-1] > 3


def test_descending_v_adv_reduces_it():
    states, context = situation((30.0, -40.0, UP, 10.0), targets=[(1, 0)])
    states.requires_grad_()
    before = adversarial_potential(states, context, SETTINGS, 2.0).sum()
    moved = states - 0.5 * torch.autograd.grad(before, states)[0]
    assert adversarial_potential(moved, context, SETTINGS, 2.0).sum() < before


def test_only_the_coalition_has_v_adv_and_it_acts_on_its_own_target():
    states, context = busy()
    value = adversarial_potential(states, context, SETTINGS)
    assert (value[0, 3:] == 0).all() and (value[0, 1:3] != 0).all()
    far = replace(context, ego_plan=context.ego_plan + 500)
    changed = adversarial_potential(states, far, SETTINGS)
    assert changed[0, 2] == value[0, 2] and changed[0, 1] > value[0, 1] + 100


def test_closing_fast_is_rewarded():
    slow, context = situation((20.0, 0.0, math.pi, 2.0), targets=[(1, 0)])
    fast = slow.clone()
    fast[..., 1, :, 3] = 6.0
    settings = replace(SETTINGS, ttc=0.0)
    assert adversarial_potential(fast, context, settings)[0, 1] < adversarial_potential(slow, context, settings)[0, 1]


def test_adversary_and_target_do_not_repel_each_other():
    start = (8.0, 0.0, 0.0, 2.0)
    free, context = situation(start, (8.0, 6.0, 0.0, 2.0))
    assert feasibility_potential(free, context, SETTINGS)[0, 1] > 0.1
    _, hunting = situation(start, (8.0, 6.0, 0.0, 2.0), targets=[(1, 0)])
    assert feasibility_potential(free, hunting, SETTINGS)[0, 1] == 0
    _, between = situation(start, (8.0, 6.0, 0.0, 2.0), targets=[(2, 1), (1, 0)])
    states = free.clone()
    states[:, 2, 20:] = states[:, 1, 20:]
    for vehicle in (1, 2):
        calm = replace(SETTINGS, accel=0.0, jerk=0.0, lateral=0.0)
        assert feasibility_potential(states, between, calm)[0, vehicle] == 0
        assert feasibility_potential(states, context, calm)[0, vehicle] > 0.1


def test_cruising_alone_is_free_and_each_fault_costs():
    states, context = situation((60.0, 3.5, 0.0, 10.0))
    assert feasibility_potential(states, context, SETTINGS)[0, 1] == 0
    faults = {
        "off_road": states.clone(),
        "lateral": states.clone(),
        "accel": states.clone(),
        "jerk": states.clone(),
        "wrong_way": states.clone(),
    }
    faults["lateral"][:, 1, 20:, 1] += 3
    faults["accel"][:, 1, :, 3] += torch.arange(50) * 0.6
    faults["jerk"][:, 1, 24:29, 3] += 4
    faults["wrong_way"][:, 1, :, 2] += math.pi
    field = torch.linspace(-8, 8, context.scene["field"].shape[-1]).half()
    edge = context.scene.clone()
    edge["field"] = field.expand_as(edge["field"]).contiguous()
    edge["field_origin"] = torch.tensor([[-50.0, -100.0]], dtype=torch.float64)
    faults["off_road"][:, 1, :, 1] += 180
    none = {name: 0.0 for name in ("off_road", "lateral", "accel", "jerk", "wrong_way", "pair")}
    for name, plan in faults.items():
        there = replace(context, scene=edge if name == "off_road" else context.scene)
        only = replace(SETTINGS, **(none | {name: 1.0}))
        assert feasibility_potential(plan, there, only)[0, 1] > 0.1, name
        assert feasibility_potential(plan, there, replace(SETTINGS, **none))[0, 1] == 0


def test_who_starts_off_the_road_or_beside_its_route_is_only_kept_from_worse():
    states, context = situation((60.0, 3.5, 0.0, 10.0))
    context.scene["field"].fill_(3.0)
    context.start[:, 1, 1] += 2.5
    states[:, 1, :, 1] += 2.5
    assert feasibility_potential(states, context, SETTINGS)[0, 1] == 0


@pytest.mark.parametrize(
    "offset, closing, cost",
    [
        ((10, 0), (-5, 0), 0.1353),
        ((10, 1), (-5, 0), 0.0821),
        ((5, 0), (-10, 0), 0.8825),
        ((10, 0), (5, 0), 0.0),
        ((40, 3), (0, 0), 0.0),
    ],
)
def test_ttc_cost_has_its_published_values(offset, closing, cost):
    value = ttc_cost(torch.tensor(offset, dtype=torch.float64), torch.tensor(closing, dtype=torch.float64))
    assert value == pytest.approx(cost, abs=2e-4)


def test_the_gap_of_disks_is_near_that_of_the_boxes():
    generator = torch.Generator().manual_seed(0)
    pose = torch.rand(400, 2, 4, generator=generator, dtype=torch.float64) * torch.tensor([16.0, 16, 6.28, 1])
    size = torch.tensor([[4.8, 2.0], [9.0, 2.5]], dtype=torch.float64).expand(400, 2, 2)
    gap = box_gap(pose[:, 0], size[:, 0], pose[:, 1], size[:, 1], 9)
    exact = torch.from_numpy(shapely.distance(*shapely.polygons(corners(pose, size).numpy()).T))
    apart = exact > 0
    assert (gap - exact)[apart].min() > -2e-3  # disks lie inside the box
    assert (gap - exact)[apart].max() < (math.sqrt(2) - 1) * 1.0 + 1e-2  # and miss its corners at most
    assert (gap[~apart] < 0.45).all()


def test_the_temperature_anneals_from_wide_to_narrow():
    levels = annealed_temperature(torch.linspace(0, 1, 5), SETTINGS)
    assert levels[0] == pytest.approx(SETTINGS.narrow) and levels[-1] == pytest.approx(SETTINGS.wide)
    assert (levels.diff() > 0).all()
    states, context = situation((30.0, -60.0, UP, 10.0), targets=[(1, 0)])
    states.requires_grad_()
    felt = []
    for temperature in (SETTINGS.narrow, SETTINGS.wide):
        value = adversarial_potential(states, context, SETTINGS, temperature).sum()
        felt.append((torch.autograd.grad(value, states)[0].norm(dim=-1) > 1e-3).sum())
    assert felt[1] > felt[0]


def test_bad_settings_are_refused():
    with pytest.raises(InputError, match="narrow"):
        PotentialSettings(narrow=0.0)
