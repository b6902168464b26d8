"""Vehicles on other lines: whoever is rerouted has what it would have had from the
start, nobody else changes."""

from dataclasses import fields

import torch

from e2rl.prior.routes import reroute, route_scene
from tests.traffic.e2.crossing import add_route, make_world, mask

UP = 1.5708
VEHICLES = [
    (0.0, 0.0, 0.0, 10.0),
    (40.0, -30.0, UP, 8.0),
    (20.0, 3.5, 0.0, 9.0),
    (-20.0, 0.0, 0.0, 9.0),
]


def same(one, other):
    for field in fields(one):
        torch.testing.assert_close(
            getattr(one, field.name), getattr(other, field.name), msg=field.name
        )


def test_rerouting_to_candidates_is_routing_anew():
    world = make_world(VEHICLES, copies=2)
    add_route(world, 1, candidate=2, heading=0.5)
    route = world.route.clone()
    route[0, 1] = 2
    before = route_scene(world.scene, world.route)
    who = mask(world, 1, 2)
    none = torch.zeros_like(who)
    same(
        reroute(
            before,
            world.scene,
            route=route,
            moved=who,
            off_lane=none,
            off_lane_path=before.points,
        ),
        route_scene(world.scene, route),
    )


def test_a_way_replaces_the_lane_of_those_that_leave_alone_and_the_way_back_is_exact():
    world = make_world(VEHICLES, copies=2)
    before = route_scene(world.scene, world.route)
    who = mask(world, 2)
    ways = before.points + torch.tensor(
        [0.0, -3.5]
    )  # vehicle 2 comes over to the ego's lane
    left = reroute(
        before,
        world.scene,
        route=world.route,
        moved=who,
        off_lane=who,
        off_lane_path=ways,
    )
    assert torch.equal(left.points[:, 2], ways[:, 2]) and torch.equal(
        left.points[:, 3], before.points[:, 3]
    )
    assert (
        not before.conflict[:, 0, 2].any()
        and left.conflict[:, 0, 2].all()
        and left.conflict[:, 2, 0].all()
    )
    assert (left.light[:, 2] < 0).all() and not left.open[:, 2].any()
    same(
        reroute(
            left,
            world.scene,
            route=world.route,
            moved=who,
            off_lane=torch.zeros_like(who),
            off_lane_path=ways,
        ),
        before,
    )
