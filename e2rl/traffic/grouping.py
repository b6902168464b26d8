"""Rows of the states of traffic methods, groups of scenes of similar size, and noise
that depends on a seed alone.

Half of a batch is padding, and small groups are mostly overhead: so scenes of similar
size are planned together. Vehicles and other agents fill their rows from the front, so
a group is cropped by slicing.
"""

from collections.abc import Callable, Sequence
from dataclasses import Field, dataclass, field, fields, is_dataclass, replace
from itertools import pairwise
from typing import Any, TypeVar, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.prior.prior import Context
from e2rl.sim.world import World

# A tensor, a TensorDict, a (nested) dataclass of them, or None.
Value = TypeVar("Value")
PRIME = 1_000_003  # between the seeds of two scenes' generators


def take_rows(value: Value, rows: Tensor) -> Value:
    """Rows of every tensor; None stays None. `SceneRows` are not read for it."""
    return map_tensors(lambda tensor: tensor[rows], value)


def put_rows(value: Value, rows: Tensor, new: Value) -> Value:
    """`value` with `rows` of every tensor replaced by those of `new`, out of place."""

    def put(old: Any, fresh: Any) -> Any:
        out = old.clone()
        out[rows] = fresh
        return out

    return map_tensors(put, value, new)


def map_tensors(function: Callable, value: Any, *others: Any) -> Any:
    """Map function over every tensor or TensorDict of a value and its counterparts in
    others; the rest is kept."""
    if isinstance(value, Tensor | TensorDictBase | SceneRows):
        return function(value, *others)
    values = (value, *others)
    if isinstance(value, tuple):  # a named tuple
        parts = (
            map_tensors(function, *(whole[index] for whole in values))
            for index in range(len(value))
        )
        return type(value)(*parts)
    if not is_dataclass(value) or isinstance(value, type):
        return value
    changes = {
        name: map_tensors(function, *(getattr(whole, name) for whole in values))
        for name in (part.name for part in fields(value))
    }
    return replace(value, **changes)


def of_scenes(context: Context, rows: Tensor) -> Context:
    """The Context of scenes rows [G] of those of a Context."""
    return mapped(context, lambda value: value[rows])


def mapped(context: Context, function: Callable[[Tensor], Tensor]) -> Context:
    """A Context with `function` applied to every tensor."""
    return replace(
        map_tensors(function, context), encoding=context.encoding.map(function)
    )


def noise_of(
    seed: Tensor,
    draw: Tensor,
    shape: tuple[int, ...],
    uniform: bool = False,
) -> Tensor:
    """Returns random numbers [B, *shape] that do not depend on the batch.

    Args:
        seed: [B] int64, of each scene.
        draw: [B] int64, number of the draw.
        shape: of a scene's numbers.
        uniform: in [0, 1), else standard normal.
    """
    sample = torch.rand if uniform else torch.randn
    rows = [torch.empty((0, *shape))]
    for value, number in torch.stack([seed, draw], -1).tolist():
        generator = torch.Generator().manual_seed((value * PRIME + number) % (2**63))
        rows.append(sample((1, *shape), generator=generator))
    return torch.cat(rows).to(seed.device)


OVERHEAD = 100  # vehicle rows that take as long as what a group takes besides its rows
MOST_ROWS = 1024  # vehicle rows of a group of several scenes
# Keys of a scene with a row for each agent.
OF_ALL = {
    "size",
    "start",
    "start_accel",
    "start_yaw_rate",
    "valid",
    "agent_type",
    "parked",
}
# Keys of a scene with a row for each vehicle.
OF_VEHICLES = {
    "past",
    "route_points",
    "route_length",
    "route_open",
    "route_valid",
    "route_recorded",
    "route_limit",
    "route_light",
    "route_light_s",
    "route_log",
}


def no_vehicles() -> Any:
    """Returns a dataclass field of a state whose tensor [B, ...] has no vehicle axis;
    others are [B, V, ...].

    Metadata `vehicle_axes` says so: 0 here, 2 for pairs [B, V, V], None for a tensor of
    all agents that never changes.
    """
    return field(metadata={"vehicle_axes": 0})


@dataclass(frozen=True)
class Group:
    """Scenes rows [G] int64 of a batch, and their numbers of vehicle rows and other
    agents' rows in use."""

    rows: Tensor
    vehicles: int
    others: int

    def agents(self, width: int) -> Tensor:
        """Their rows int64 in scenes of `width` vehicle rows."""
        others = width + torch.arange(self.others)
        return torch.cat([torch.arange(self.vehicles), others]).to(self.rows.device)


def group_scenes(world: World) -> list[Group]:
    """The scenes of a batch in groups by vehicles in use."""
    width = world.scene["route_log"].shape[1]
    used = world.valid | world.scene["valid"]
    position = torch.arange(1, used.shape[1] + 1, device=used.device)
    vehicles = (used[:, :width] * position[:width]).amax(1).clamp(min=1)
    others = vehicles * 0
    if used.shape[1] > width:
        others = (used[:, width:] * position[: used.shape[1] - width]).amax(1)
    order = vehicles.argsort(descending=True, stable=True)
    sizes = vehicles[order].tolist()
    ends = group_ends(sizes)
    return [
        Group(
            order[begin:end], sizes[begin], others=int(others[order[begin:end]].max())
        )
        for begin, end in pairwise([0, *ends])
    ]


def group_ends(sizes: Sequence[int]) -> list[int]:
    """Returns where groups of consecutive scenes end, such that together they take the
    least time: each OVERHEAD, and its rows, those of padding included.

    Args:
        sizes: vehicles of each scene, the largest first.
    """
    least = [0]  # time of the first scenes
    begins = [0]  # of the last group of these
    for end in range(1, len(sizes) + 1):
        times = dict[int, int]()
        for begin in reversed(range(end)):
            rows = sizes[begin] * (end - begin)
            if times and rows > MOST_ROWS:
                break
            times[begin] = least[begin] + OVERHEAD + rows
        begin = min(times, key=times.__getitem__)
        least.append(times[begin])
        begins.append(begin)
    ends = []
    end = len(sizes)
    while end:
        ends.append(end)
        end = begins[end]
    return ends[::-1]


class SceneRows:
    """Rows of scenes with the vehicles and others in use, read by key as a TensorDict
    is.

    A tensor is taken when it is read first: maps are large, and most of them are not
    read in most replans.
    """

    def __init__(self, scene: TensorDictBase, group: Group) -> None:
        self._scene = scene
        self._group = group
        self._taken = dict[str, Tensor]()

    def __getitem__(self, key: Any) -> Any:
        """The tensor of a name, or what rows hold, as SceneRows."""
        if not isinstance(key, str):
            return SceneRows(
                self._scene, replace(self._group, rows=self._group.rows[key])
            )
        if key not in self._taken:
            self._taken[key] = self._take(key)
        return self._taken[key]

    def _take(self, key: str) -> Tensor:
        rows = self._group.rows
        vehicles = self._group.vehicles
        if key in OF_ALL:
            agents = self._group.agents(self._scene["route_log"].shape[1])
            return self._scene[key][rows][:, agents]
        if key in OF_VEHICLES:
            return self._scene[key][rows, :vehicles]
        return self._scene[key][rows]


def crop_world(world: World, group: Group) -> World:
    """The group's World [G]."""
    rows = group.rows
    agents = group.agents(world.scene["route_log"].shape[1])
    return World(
        cast(TensorDictBase, SceneRows(world.scene, group)),
        world.step[rows],
        states=world.states[rows][:, agents],
        valid=world.valid[rows][:, agents],
        accel=world.accel[rows][:, agents],
        turn_rate=world.turn_rate[rows][:, agents],
        mission_s=None if world.mission_s is None else world.mission_s[rows],
    )


def crop_state(value: Any, group: Group, width: int, axes: int | None = 1) -> Any:
    """Returns the group's part of a state.

    Args:
        value: a tensor, or a nested dataclass of tensors.
        group: scenes.
        width: vehicle rows of the scenes.
        axes: vehicle axes of a tensor, see `no_vehicles`.
    """
    if is_dataclass(value) and not isinstance(value, type):
        parts = {
            part.name: crop_state(
                getattr(value, part.name),
                group,
                width=width,
                axes=axes_of(part),
            )
            for part in fields(value)
        }
        return replace(value, **parts)
    value = value[group.rows]
    if axes is None:
        return value[:, group.agents(width)]
    return value[(slice(None), *[slice(group.vehicles)] * axes)]


def write_state(full: Any, part: Any, group: Group, axes: int | None = 1) -> None:
    """Writes the group's part of a state back, in place.

    Args:
        full: a tensor, or a nested dataclass of tensors, of all scenes.
        part: of the group's scenes.
        group: scenes.
        axes: vehicle axes of a tensor, see `no_vehicles`.
    """
    if is_dataclass(full):
        for part_of in fields(full):
            write_state(
                getattr(full, part_of.name),
                getattr(part, part_of.name),
                group=group,
                axes=axes_of(part_of),
            )
    elif axes == 2:
        index = torch.arange(group.vehicles)
        full[group.rows[:, None, None], index[:, None], index] = part
    elif axes is not None:
        full[(group.rows, *[slice(group.vehicles)] * axes)] = part


def axes_of(declared: Field) -> int | None:
    """Returns how many vehicle axes a field of a state has, 1 by default."""
    return declared.metadata.get("vehicle_axes", 1)


def clone(value: Value) -> Value:
    """A nested dataclass with every tensor copied."""
    return map_tensors(lambda tensor: tensor.clone(), value)
