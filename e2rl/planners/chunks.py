"""Batches of scenes in parts that fit a processor's cache, with no more than is read."""

from collections.abc import Iterator

from torch import Tensor

from e2rl.sim.world import AGENT_KEYS, World

PLANNER_KEYS = (
    "size",
    "agent_type",
    "route_log",
    "route_points",
    "route_length",
    "route_open",
    "route_limit",
    "route_light",
    "route_light_s",
    "light_state",
    "field",
    "field_origin",
)  # of a scene, that paths and scores read


def take(
    world: World,
    rows: Tensor | slice,
    keys: tuple[str, ...] = PLANNER_KEYS,
) -> World:
    """Scenes rows [b] of a World with these keys of the scene, without plans and
    routes; of a slice without a copy."""
    agents = {key: getattr(world, key)[rows] for key in AGENT_KEYS}
    place = None if world.mission_s is None else world.mission_s[rows]
    scene = world.scene.select(*keys)[rows]
    return World(
        scene,
        world.step[rows],
        **agents,
        mission_s=place,
    )


def chunks(
    world: World,
    size: int,
    keys: tuple[str, ...] = PLANNER_KEYS,
) -> Iterator[World]:
    """A World in parts of `size` scenes by `take`."""
    for first in range(0, len(world.step), size):
        yield take(world, slice(first, first + size), keys=keys)
