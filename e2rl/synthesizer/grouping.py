"""Scenes of like size together: half of a batch is padding, and of small groups most is overhead.

Vehicles and other agents fill their rows from the front, so that a group is cropped by slices of what is in use.
"""

from dataclasses import dataclass, fields, is_dataclass, replace

import torch
from tensordict import TensorDict
from torch import Tensor

from e2rl.prior.lane_relative import HORIZON, LaneState
from e2rl.prior.prior import Plan
from e2rl.sim.world import World

ROWS = 160, 1024  # vehicle rows from which a group may end, and at most
SHRUNK = 0.55  # share of its largest scene at which the next scene begins another group
OF_ALL = {"size", "start", "start_accel", "start_yaw_rate", "valid", "agent_type", "parked"}  # keys with all agents
OF_VEHICLES = {
    "past",
    "route_points",
    "route_length",
    "route_open",
    "route_valid",
    "route_limit",
    "route_light",
    "route_light_s",
    "route_log",
}
WHOLE = {
    "field",
    "field_origin",
    "light_state",
    "lane_points",
    "lane_index",
    "lane_exits",
    "lane_left",
    "lane_right",
    "scene_index",
}
UNCROPPED = {"seed", "eta", "replans", "light_state"}  # fields of an Episode without a vehicle axis
PAIRS = {"conflict", "conflict_s", "crossing"}


@dataclass(frozen=True)
class Group:
    """Scenes rows [G] int64 of a batch, of which the first `vehicles` rows and the first `others` rows of the rest are
    in use."""

    rows: Tensor
    vehicles: int
    others: int


def group_scenes(world: World) -> list[Group]:
    """The scenes of a batch in groups by vehicles in use (see ROWS and SHRUNK; one scene at least)."""
    width = world.route.shape[1]
    used = world.valid | world.scene["valid"]
    place = torch.arange(1, used.shape[1] + 1, device=used.device)
    vehicles = (used[:, :width] * place[:width]).amax(1).clamp(min=1)
    others = (used[:, width:] * place[: used.shape[1] - width]).amax(1) if used.shape[1] > width else vehicles * 0
    order = vehicles.argsort(descending=True, stable=True)
    sizes, begin, groups = vehicles[order].tolist(), 0, []
    for end in range(1, len(sizes) + 1):
        size, filled = sizes[begin], sizes[begin] * (end - begin)
        if end < len(sizes) and filled + size <= ROWS[1] and (filled < ROWS[0] or sizes[end] > SHRUNK * size):
            continue
        rows = order[begin:end]
        groups.append(Group(rows, size, int(others[rows].max())))
        begin = end
    return groups


def crop_world(world: World, group: Group) -> World:
    """The group's Worlds [G], with the scene keys that synthesis reads."""
    width, rows = world.route.shape[1], group.rows
    agents = torch.cat([torch.arange(group.vehicles), width + torch.arange(group.others)]).to(rows.device)
    scene = {}
    for key in world.scene.keys():  # noqa: SIM118 - not a dict
        if key in OF_ALL:
            scene[key] = world.scene[key][rows][:, agents]
        elif key in OF_VEHICLES:
            scene[key] = world.scene[key][rows, : group.vehicles]
        elif key in WHOLE:
            scene[key] = world.scene[key][rows]
    return World(
        TensorDict(scene, batch_size=[len(rows)]),
        world.step[rows],
        world.states[rows][:, agents],
        world.valid[rows][:, agents],
        world.accel[rows][:, agents],
        world.route[rows, : group.vehicles],
    )


def crop_episode(value, group: Group, width: int, name: str = ""):
    """The group's part of an Episode (or of a dataclass in it) whose scenes have `width` vehicle rows."""
    if is_dataclass(value):
        return type(value)(*(crop_episode(getattr(value, f.name), group, width, f.name) for f in fields(value)))
    value = value[group.rows]
    if name in UNCROPPED:
        return value
    if name in PAIRS:
        return value[:, : group.vehicles, : group.vehicles]
    if name == "size":
        return torch.cat([value[:, : group.vehicles], value[:, width : width + group.others]], 1)
    return value[:, : group.vehicles]


def write_episode(full, part, group: Group, name: str = "") -> None:
    """Write the group's part back, in place; sizes and lights never change."""
    if is_dataclass(full):
        for field in fields(full):
            write_episode(getattr(full, field.name), getattr(part, field.name), group, field.name)
    elif name in PAIRS:
        full[group.rows[:, None, None], torch.arange(group.vehicles)[:, None], torch.arange(group.vehicles)] = part
    elif name in UNCROPPED:
        full[group.rows] = part
    elif name != "size":
        full[group.rows, : group.vehicles] = part


def gather_plans(plans: list[tuple[Group, Plan]], batch: int, width: int) -> Plan:
    """The Plan of a batch whose scenes have `width` vehicle rows; unused rows are zeros and off the map."""
    first = plans[0][1]
    zero = first.motion.s.new_zeros(batch, width, HORIZON)
    motion = LaneState(*(zero.clone() for _ in fields(LaneState)))
    whole = Plan(motion, torch.zeros_like(zero, dtype=torch.bool))
    for group, plan in plans:
        for field in fields(LaneState):
            getattr(motion, field.name)[group.rows, : group.vehicles] = getattr(plan.motion, field.name)
        whole.on_map[group.rows, : group.vehicles] = plan.on_map
    return whole


def clone(value):
    """A nested dataclass with every tensor copied."""
    return (
        replace(value, **{f.name: clone(getattr(value, f.name)) for f in fields(value)})
        if is_dataclass(value)
        else value.clone()
    )
