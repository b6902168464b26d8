"""Vehicles on other lines: whoever is rerouted has what it would have had from the
start, nobody else changes."""

from dataclasses import fields

import pytest
import torch

from e2rl.prior.routes import candidate_features, reroute, route_scene, start_of
from tests.prior.small import arc
from tests.synthetic import make_scenes
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
    add_route(
        world,
        1,
        candidate=2,
        heading=0.5,
    )
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
    assert torch.equal(left.points[:, 2], ways[:, 2])
    assert torch.equal(left.points[:, 3], before.points[:, 3])
    assert not before.conflict[:, 0, 2].any()
    assert left.conflict[:, 0, 2].all()
    assert left.conflict[:, 2, 0].all()
    assert (left.light[:, 2] < 0).all()
    assert not left.open[:, 2].any()
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


def conflict_of(other):
    """Whether the route along +x from -20 m is in conflict with another one, and after
    how many metres."""
    scene = make_scenes(1, vehicles=[(0.0, 0, 8.0), (0.0, 1, 8.0)]).scenes
    scene["route_points"][:, 0] = arc(
        0.0,
        0.0,
        heading=0.0,
        curvature=0.0,
    )
    scene["route_points"][:, 1] = other
    routed = route_scene(scene, scene["route_log"].clamp(min=0))
    return bool(routed.conflict[0, 0, 1]), routed.conflict_s[0, 0, 1].item()


def crossing(distance):
    """A route that crosses +x at a right angle, `distance` m after -20 m."""
    return arc(
        distance - 20.0,
        0.0,
        heading=UP,
        curvature=0.0,
    )


@pytest.mark.parametrize(("aside", "meets"), [(2.4, True), (2.6, False)])
def test_routes_nearer_than_two_and_a_half_metres_are_in_conflict(aside, meets):
    assert (
        conflict_of(
            arc(
                0.0,
                aside,
                heading=0.0,
                curvature=0.0,
            )
        )[0]
        == meets
    )


@pytest.mark.parametrize(("distance", "meets"), [(156.0, True), (164.0, False)])
def test_conflicts_are_looked_for_within_160_metres(distance, meets):
    assert conflict_of(crossing(distance))[0] == meets


def test_conflicts_are_looked_for_every_four_metres():
    assert conflict_of(crossing(52.0)) == (True, 52.0)
    assert conflict_of(crossing(50.0)) == (True, 48.0)


def test_candidates_are_seen_by_their_turns_10_to_80_metres_ahead():
    scene = make_scenes(1, num_vehicles=1).scenes
    scene["route_points"][:, 0, 0] = arc(
        0.0,
        0.0,
        heading=0.0,
        curvature=0.01,
    )
    features = candidate_features(scene, start_of(scene))[0, 0, 0]
    expected = torch.tensor([0.1, 0.2, 0.35, 0.55, 0.8])
    torch.testing.assert_close(
        features[3:8],
        expected,
        rtol=0,
        atol=2e-3,
    )
