import math
from dataclasses import replace

import pytest
import shapely
import torch

from e2rl.scenes.boxes import corners
from e2rl.traffic import potentials
from e2rl.traffic.motion import constant_speed_states
from e2rl.traffic.potentials import (
    SAMPLED_STEPS,
    PotentialContext,
    PotentialSettings,
    box_gap,
)
from tests.traffic.e2.crossing import make_world

UP = math.pi / 2
EGO = (0.0, 0.0, 0.0, 10.0)
SETTINGS = PotentialSettings()


def feasibility_potential(states, context, settings):
    return potentials.feasibility_potential(
        states[:, :, SAMPLED_STEPS], context, settings=settings
    )


def adversarial_potential(states, context, settings, *temperature):
    return potentials.adversarial_potential(
        states[:, :, SAMPLED_STEPS], context, settings, *temperature
    )


POTENTIALS = [feasibility_potential, adversarial_potential]


def situation(*vehicles, targets=()):
    """Cruising states [B, 8, 50, 4] in float64, and their context; targets: (vehicle,
    target) pairs."""
    world = make_world([EGO, *vehicles])
    states = constant_speed_states(
        world.scene, world, times=0.1 * torch.arange(1, 51)
    ).double()
    scene = world.scene.apply(lambda x: x.double() if x.dtype == torch.float32 else x)
    target = torch.full((1, 8), -1)
    for vehicle, aim in targets:
        target[:, vehicle] = aim
    current = scene["start"][:, :8], scene["start_accel"][:, :8], world.valid[:, :8]
    path = scene["route_points"][:, :, 0], scene["route_valid"].any(-1)
    return states, PotentialContext(
        scene, *current, *path, states[:, 0].clone(), target
    )


def busy():
    """Perturbed plans of a crowd off the road, so that every term is at work."""
    crowd = [
        (12.0, 2.0, 0.1, 9.0),
        (20.0, -8.0, UP, 6.0),
        (22.0, -12.0, UP, 7.0),
        (15.0, 3.0, 0.0, 10.0),
    ]
    states, context = situation(*crowd, targets=[(1, 0), (2, 1)])
    field = torch.linspace(-4, 4, context.scene["field"].shape[-1]).half()
    context.scene["field"] = field.expand_as(context.scene["field"]).contiguous()
    scale = torch.tensor([1.0, 1.0, 0.3, 1.5], dtype=torch.float64)
    noise = torch.randn(
        states.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    return states + scale * noise, context


@pytest.mark.parametrize("potential", POTENTIALS)
def test_a_vehicle_s_term_moves_that_vehicle_alone_and_never_the_ego(potential):
    states, context = busy()
    states.requires_grad_()
    context = replace(context, ego_plan=context.ego_plan.requires_grad_())
    value = potential(states, context, SETTINGS)
    assert value[0, 0] == 0
    for vehicle in (1, 2):
        gradient, plan = torch.autograd.grad(
            value[0, vehicle],
            (states, context.ego_plan),
            retain_graph=True,
            allow_unused=True,
        )
        moved = gradient.abs().sum((0, 2, 3))
        assert moved[vehicle] > 0
        assert moved.sum() == moved[vehicle]
        assert plan is None


def test_gradients_are_finite_for_coincident_and_standing_vehicles():
    states, context = situation(
        (0.0, 0.0, 0.0, 0.0),
        (0.0, 0.0, 0.0, 0.0),
        (5.0, 0.0, 0.0, 0.0),
        targets=[(1, 0), (2, 1), (3, 0)],
    )
    for plans in (states, torch.zeros_like(states), 1e3 * torch.ones_like(states)):
        plans = plans.clone().requires_grad_()
        held = replace(context, ego_plan=plans[:, 0].detach())
        for potential in POTENTIALS:
            value = potential(plans, held, SETTINGS)
            assert value.isfinite().all()
            assert torch.autograd.grad(value.sum(), plans)[0].isfinite().all()


def test_only_the_coalition_has_v_adv_and_it_acts_on_its_own_target():
    states, context = busy()
    value = adversarial_potential(states, context, settings=SETTINGS)
    assert (value[0, 3:] == 0).all()
    assert (value[0, 1:3] != 0).all()
    far = replace(context, ego_plan=context.ego_plan + 500)
    changed = adversarial_potential(states, far, settings=SETTINGS)
    assert changed[0, 2] == value[0, 2]
    assert changed[0, 1] > value[0, 1] + 100


def test_adversary_and_target_do_not_repel_each_other():
    start = (8.0, 0.0, 0.0, 2.0)
    free, context = situation(start, (8.0, 6.0, 0.0, 2.0))
    assert feasibility_potential(free, context, settings=SETTINGS)[0, 1] > 0.1
    _, hunting = situation(start, (8.0, 6.0, 0.0, 2.0), targets=[(1, 0)])
    assert feasibility_potential(free, hunting, settings=SETTINGS)[0, 1] == 0
    _, between = situation(start, (8.0, 6.0, 0.0, 2.0), targets=[(2, 1), (1, 0)])
    states = free.clone()
    states[:, 2, 20:] = states[:, 1, 20:]
    for vehicle in (1, 2):
        calm = replace(SETTINGS, accel=0.0, jerk=0.0, lateral=0.0)
        assert feasibility_potential(states, between, settings=calm)[0, vehicle] == 0
        assert feasibility_potential(states, context, settings=calm)[0, vehicle] > 0.1


def only(**weights):
    """Settings in which these terms alone have a weight."""
    names = (
        "off_road",
        "lateral",
        "pair",
        "accel",
        "jerk",
        "wrong_way",
        "distance",
        "ttc",
        "impact_speed",
    )
    return replace(SETTINGS, **(dict.fromkeys(names, 0.0) | weights))


def test_each_term_of_v_feas_has_its_closed_form_and_cruising_alone_is_free():
    """Ten states, one every 0.5 s; the vehicle drives at 10 m/s, 60 m ahead of the ego
    in the next lane."""
    states, context = situation((60.0, 3.5, 0.0, 10.0))
    assert feasibility_potential(states, context, settings=SETTINGS)[0, 1] == 0

    def cost(change, **weights):
        plan = states.clone()
        change(plan[0, 1])
        return feasibility_potential(plan, context, settings=only(**weights))[
            0, 1
        ].item()

    def aside(plan):
        plan[25:, 1] -= 3.0  # five of the ten, 2 m beyond the bound of 1 m

    def faster(plan):
        plan[:, 3] += 0.3 * torch.arange(
            1, 51
        )  # 3 m/s^2, 1 beyond the bound; jerk of 6 - 2 m/s^3 at first

    def slower(plan):
        plan[:, 3] -= 0.45 * torch.arange(
            1, 51
        )  # -4.5 m/s^2, 1 beyond the bound; jerk of 9 - 2 m/s^3 at first

    def turning(plan):
        plan[:, 2] += 0.05 * torch.arange(
            1, 51
        )  # 0.5 rad/s at 10 m/s: 5 m/s^2 to the side, 1 beyond the bound

    def turned(plan):
        plan[:, 2] += math.pi - 1.0

    assert cost(aside, lateral=0.1) == pytest.approx(0.1 * 2.0**2 / 2)
    assert cost(faster, accel=0.5) == pytest.approx(0.5)
    assert cost(slower, accel=0.5) == pytest.approx(0.5)
    assert cost(turning, accel=0.5) == pytest.approx(0.5, rel=1e-5)
    assert cost(faster, jerk=2.0) == pytest.approx(2.0 * 4.0**2 / 10)
    assert cost(slower, jerk=2.0) == pytest.approx(2.0 * 7.0**2 / 10)
    assert cost(turned, wrong_way=0.1) == pytest.approx(0.1 * 10.0 * math.cos(1.0))
    assert cost(turning, wrong_way=0.1) == pytest.approx(
        0.1 * 10 * sum(max(0, -math.cos(t / 4)) for t in range(1, 11)) / 10
    )
    context.scene["field"].fill_(
        1.2
    )  # everywhere 1.2 m off the road, where it starts 0.3 m inside of it
    context.__dict__["start_off_road"] = torch.full((1, 8), -0.5, dtype=torch.float64)
    assert cost(lambda plan: None, off_road=2.0) == pytest.approx(
        2.0 * 1.5**2, rel=1e-3
    )


def test_the_pair_term_is_the_squared_shortfall_of_the_gap_that_is_wanted():
    """Vehicle 2 stays 2.1 m beside vehicle 1, both 2 m wide; 0.3 m are wanted, less
    where it began nearer."""
    size = 2.0
    for began, wanted in ((3.5, 0.3), (2.2, 0.2)):
        states, context = situation((30.0, 0.0, 0.0, 10.0), (30.0, began, 0.0, 10.0))
        context.scene["size"][:, 1:3] = torch.tensor([4.5, size])
        states[0, 2, :, 1] = size + 0.1
        result = feasibility_potential(states, context, settings=only(pair=3.0))[0]
        assert result[1].item() == pytest.approx(3.0 * (wanted - 0.1) ** 2, rel=2e-2)
        assert result[1] == result[2]


def test_v_adv_has_its_closed_form_at_a_constant_distance():
    """Distance d for all the time, no closing: d / 2 m, and a TTC cost of exp(-d^2 /
    2)."""
    states, context = situation((1.5, 2.0, 0.0, 10.0), targets=[(1, 0)])
    value = adversarial_potential(states, context, only(distance=1.5), 0.7)[0, 1]
    assert value.item() == pytest.approx(1.5 * 2.5 / 2, abs=2e-3)
    value = adversarial_potential(states, context, settings=only(ttc=0.5))[0, 1]
    assert value.item() == pytest.approx(0.5 * (1 - math.exp(-(2.5**2) / 2)), rel=1e-3)


@pytest.mark.parametrize(("speed", "closing"), [(2.0, 12.0), (-6.0, 4.0), (14.0, 24.0)])
def test_the_closing_speed_at_the_nearest_moment_is_rewarded_up_to_a_bound(
    speed, closing
):
    """Head-on and held at a distance of 20 m: closing at both speeds, counted in 10 m/s
    and up to 20 m/s."""
    states, context = situation((20.0, 0.0, math.pi, 1.0), targets=[(1, 0)])
    states[0, 1, :, 0], states[0, 1, :, 3] = context.ego_plan[0, :, 0] + 20.0, speed
    value = adversarial_potential(states, context, settings=only(impact_speed=0.3))[
        0, 1
    ].item()
    assert value == pytest.approx(-0.3 * min(closing * 20 / 20.1, 20) / 10, rel=1e-3)


def test_who_starts_off_the_road_or_beside_its_route_is_only_kept_from_worse():
    states, context = situation((60.0, 3.5, 0.0, 10.0))
    context.scene["field"].fill_(3.0)
    context.start[:, 1, 1] += 2.5
    states[:, 1, :, 1] += 2.5
    assert feasibility_potential(states, context, settings=SETTINGS)[0, 1] == 0


def test_the_gap_of_disks_is_near_that_of_the_boxes():
    generator = torch.Generator().manual_seed(0)
    pose = torch.rand(
        400, 2, 4, generator=generator, dtype=torch.float64
    ) * torch.tensor([16.0, 16, 6.28, 1])
    size = torch.tensor([[4.8, 2.0], [9.0, 2.5]], dtype=torch.float64).expand(400, 2, 2)
    gap = box_gap(
        pose[:, 0], size[:, 0], other=pose[:, 1], other_size=size[:, 1], disks=9
    )
    exact = torch.from_numpy(
        shapely.distance(*shapely.polygons(corners(pose, size).numpy()).T)
    )
    apart = exact > 0
    assert (gap - exact)[apart].min() > -2e-3  # disks lie inside the box
    assert (gap - exact)[apart].max() < (
        math.sqrt(2) - 1
    ) * 1.0 + 1e-2  # and miss its corners at most
    assert (gap[~apart] < 0.45).all()
