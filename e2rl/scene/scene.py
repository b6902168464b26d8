"""The Scene: a TensorDict of one situation, padded and masked, and the SceneSet that holds many.

Shapes (leading batch omitted): N agents = V vehicles (the ego first) + others; T simulated steps; R route candidates of
P vertices; S lights; M, D map points; L lanes. Positions are relative to the scene's origin, in m; angles in rad.

| key | shape | |
| --- | --- | --- |
| start, start_accel, start_yaw_rate | [N, 4], [N], [N] | causal estimate at the start frame |
| past | [V, 10, 3] | 0.1 s, 0.2 s, ... before the start frame: m ahead and left, turn, as seen from there |
| valid, parked | [N] bool | present at the start frame; standing off the lanes |
| size, agent_type | [N, 2], [N] int64 | length and width; index into AGENT_TYPES |
| logged, logged_valid | [T+1, N, 4], [T+1, N] | smoothed recording, row 0 the start frame |
| route_points, route_length, route_valid | [V, R, P, 2], [V, R], [V, R] | candidates and their usable length |
| route_open | [V, R] bool | the map ends where the route does |
| route_limit | [V, R, P] | speed limit, 0 unknown |
| route_light, route_light_s | [V, R, 2] | next lights (-1 none) and the arc length of their stop lines |
| route_log | [V] int64 | candidate nearest to the recorded future, -1 none; route_log[0] is the ego's mission |
| light_state, light_points | [T+1, S] int64, [S, 2] | |
| lane_points, lane_index, lane_width | [M, 2], [M], [L] | lane_index -1 is padding |
| lane_exits, lane_left, lane_right | [L, 6], [L], [L] | lane indices, -1 none |
| drivable_points, drivable_index | [D, 2], [D] | polygons |
| field, field_origin | [G, G] float16, [2] | m beyond the drivable border (< 0 inside) at 1 m cells |
| scene_index | [] int64 | position in its SceneSet |
"""

from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase

from e2rl.errors import InputError

RAGGED = {  # key: value of its padding; these first dims differ between scenes
    "light_state": 0,
    "light_points": 0.0,
    "lane_points": 0.0,
    "lane_index": -1,
    "lane_width": 0.0,
    "lane_exits": -1,
    "lane_left": -1,
    "lane_right": -1,
    "drivable_points": 0.0,
    "drivable_index": -1,
}
KEYS = {  # key: number of dims of one scene
    "start": 2,
    "start_accel": 1,
    "start_yaw_rate": 1,
    "past": 3,
    "valid": 1,
    "parked": 1,
    "size": 2,
    "agent_type": 1,
    "logged": 3,
    "logged_valid": 2,
    "route_points": 4,
    "route_length": 2,
    "route_open": 2,
    "route_valid": 2,
    "route_limit": 3,
    "route_light": 3,
    "route_light_s": 3,
    "route_log": 1,
    "light_state": 2,
    "light_points": 2,
    "lane_points": 2,
    "lane_index": 1,
    "lane_width": 1,
    "lane_exits": 2,
    "lane_left": 1,
    "lane_right": 1,
    "drivable_points": 2,
    "drivable_index": 1,
    "field": 2,
    "field_origin": 1,
}


def validate(scene: TensorDictBase, name: str) -> None:
    """Raise InputError naming the scene and the key that breaks the schema or is not finite."""
    keys = set(scene.keys())
    for key, dims in KEYS.items():
        if key not in keys:
            raise InputError(f"scene {name!r}: key {key!r} is missing; rebuild its cache")
        value = scene[key]
        if value.ndim != dims:
            raise InputError(f"scene {name!r}: {key} has {value.ndim} dims, expected {dims}")
        if value.is_floating_point() and not torch.isfinite(value).all():
            raise InputError(f"scene {name!r}: {key} holds NaN or infinite values")
    if not scene["valid"][0] or scene["route_log"][0] < 0:
        raise InputError(f"scene {name!r}: the ego is absent or has no route")


def _padded(value: torch.Tensor, shape: list[int], fill: float) -> torch.Tensor:
    if list(value.shape) == shape:
        return value
    out = value.new_full(shape, fill)
    out[tuple(slice(0, size) for size in value.shape)] = value
    return out


def stack(scenes: list[TensorDictBase]) -> TensorDict:
    """One TensorDict [S] of scenes, the ragged keys padded to the largest."""
    columns = {}
    for key in KEYS:
        values = [scene[key] for scene in scenes]
        shape = [max(sizes) for sizes in zip(*(value.shape for value in values), strict=True)]
        if key not in RAGGED and any(list(value.shape) != shape for value in values):
            raise InputError(f"scenes of different {key} shapes cannot be one set; build them with the same settings")
        columns[key] = torch.stack([_padded(value, shape, RAGGED.get(key, 0)) for value in values])
    columns["scene_index"] = torch.arange(len(scenes))
    return TensorDict(columns, batch_size=[len(scenes)])


@dataclass
class SceneSet:
    """Scenes [S] of one data set and split, with their names; `dropped` counts recordings left out, by reason."""

    scenes: TensorDict
    scene_id: list[str]
    location: list[str]
    dataset: str
    split: str
    dropped: dict[str, int]

    def __len__(self) -> int:
        return len(self.scene_id)

    def batch(self, indices) -> TensorDict:
        """Scenes [B] at `indices` (a sequence or tensor of positions)."""
        return self.scenes[torch.as_tensor(indices)]

    def place(self, which: int | str) -> int:
        """The position of a scene named by position or id; InputError where there is none."""
        if isinstance(which, int) and 0 <= which < len(self):
            return which
        if which in self.scene_id:
            return self.scene_id.index(which)
        raise InputError(
            f"scene={which}: expected a position below {len(self)} or the id of a scene, such as {self.scene_id[0]}"
        )

    def copy_into(self, batch: TensorDictBase, rows: torch.Tensor, indices: torch.Tensor) -> None:
        """Overwrite rows [b] (ascending) of a batch of scenes by the scenes at `indices` [b], in place."""
        whole = len(rows) == len(batch)
        for key in self.scenes.keys():  # noqa: SIM118 - not a dict
            source, target = self.scenes[key], batch[key]
            if whole and source.device == target.device:  # without a second copy, whose pages cost more than the first
                torch.index_select(source, 0, indices, out=target)
            else:
                target[rows] = source[indices].to(target.device)

    def first(self, count: int | None) -> "SceneSet":
        """The first `count` scenes (all for None)."""
        if count is None or count >= len(self):
            return self
        return SceneSet(
            self.scenes[:count], self.scene_id[:count], self.location[:count], self.dataset, self.split, self.dropped
        )

    def to(self, device) -> "SceneSet":
        """The same scenes on a device."""
        return SceneSet(self.scenes.to(device), self.scene_id, self.location, self.dataset, self.split, self.dropped)
