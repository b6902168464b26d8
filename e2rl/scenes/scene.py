"""The Scene: a TensorDict of one situation, padded and masked, and the SceneSet that
holds many.

Shapes (leading batch omitted): N agents = V vehicles (the ego first; those that are not
`valid` appear later, and only a replay shows them) + others; T simulated steps; R route
candidates of P vertices; S lights; M, D map points; L lanes. Positions are relative to
the scene's origin, in m; angles in rad.

| key | shape | |
| --- | --- | --- |
| start, start_accel, start_yaw_rate | [N, 4], [N], [N] | x, y, heading, speed; m/s^2; rad/s |
| past | [V, 10, 3] | poses 0.1 s, 0.2 s, ... before the start: m ahead, m left, rad |
| valid, parked | [N] bool | present at the start frame; standing off the lanes |
| size, agent_type | [N, 2], [N] int64 | length and width; index into AGENT_TYPES |
| logged, logged_valid | [T+1, N, 4], [T+1, N] | smoothed recording; row 0 is the start frame |
| route_points, route_length, route_valid | [V, R, P, 2], [V, R], [V, R] | candidates; usable m |
| route_open | [V, R] bool | the map ends where the route does |
| route_recorded | [V, R] bool | the ego's recorded path, where no lane fits it |
| route_limit | [V, R, P] | speed limit m/s, 0 unknown |
| route_light, route_light_s | [V, R, 2] | next lights (-1 none); arc lengths of stop lines |
| route_log | [V] int64 | candidate nearest to the recorded future, -1 none; [0]: the mission |
| light_state, light_points | [T+1, S] int64, [S, 2] | LIGHT_*; where their lanes begin |
| lane_points, lane_index, lane_width | [M, 2], [M], [L] | lane_index -1 is padding |
| lane_exits, lane_left, lane_right | [L, 6], [L], [L] | lane indices, -1 none |
| drivable_points, drivable_index | [D, 2], [D] | polygons |
| field, field_origin | [G, G] float16, [2] | m beyond the drivable border, 1 m cells |
| left_out | [] int64 | vehicles near the ego's path that no traffic drives |
| scene_index | [] int64 | index in its SceneSet |
"""

import hashlib
from collections.abc import (
    Iterator,
    Mapping,
    Sequence,
)
from dataclasses import (
    dataclass,
    field,
    replace,
)
from typing import Any

import numpy as np
import torch
from tensordict import (
    TensorDict,
    TensorDictBase,
)
from torch import Tensor

from e2rl.run.errors import InputError

KEYS_BY_DIMS = {  # number of dims of one scene: keys
    0: "left_out",
    1: "start_accel start_yaw_rate valid parked agent_type route_log field_origin "
    "lane_index lane_width lane_left lane_right drivable_index",
    2: "start size logged_valid route_length route_open route_valid route_recorded field "
    "light_state light_points lane_points lane_exits drivable_points",
    3: "past logged route_limit route_light route_light_s",
    4: "route_points",
}
KEYS = {key: dims for dims, keys in KEYS_BY_DIMS.items() for key in keys.split()}
PART = 64  # scenes at once, where all of a set are gone through
LARGE = 4096  # numbers of a tensor above which `copy_into` copies scene by scene
RAGGED = {  # keys whose first dims differ between scenes: the value that pads them
    "light_state": 0,
    "light_points": 0,
    "lane_points": 0,
    "lane_width": 0,
    "drivable_points": 0,
    "lane_index": -1,
    "lane_exits": -1,
    "lane_left": -1,
    "lane_right": -1,
    "drivable_index": -1,
}


def validate(scene: TensorDictBase, name: str) -> None:
    """Raises InputError naming the scene and the key that is not finite or of other
    dims."""
    for key, dims in KEYS.items():
        value = scene[key]
        finite = not value.is_floating_point() or torch.isfinite(value).all()
        if value.ndim != dims or not finite:
            raise InputError(
                f"scene {name!r}: {key} has not {dims} dims, "
                "or holds NaN or infinite values"
            )
    if not scene["valid"][0] or scene["route_log"][0] < 0:
        raise InputError(f"scene {name!r}: the ego is absent or has no route")


def content_hash(scene: Mapping[str, np.ndarray]) -> str:
    """Returns the SHA-256 of the arrays of a scene; the size to which ragged ones are
    padded does not matter."""
    digest = hashlib.sha256()
    for key in sorted(scene):
        value = unpadded(scene[key], RAGGED[key]) if key in RAGGED else scene[key]
        digest.update(f"{key} {value.dtype} {value.shape}".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    return digest.hexdigest()


def unpadded(value: np.ndarray, fill: float) -> np.ndarray:
    """Returns an array without the rows at the end of each axis that hold nothing but
    `fill`."""
    for axis in range(value.ndim):
        others = tuple(other for other in range(value.ndim) if other != axis)
        used = np.flatnonzero((value != fill).any(axis=others))
        value = value.take(np.arange(used[-1] + 1 if len(used) else 0), axis)
    return value


@dataclass
class SceneSet:
    """Scenes of one data set and split, with their names.

    scenes [S]: in memory, or mapped from the cache, in which case only what is used of
    them is read; dropped: counts recordings left out, by reason; number: of each
    scene's noise, by default its position; files: SHA-256 of the data's files, "" where
    unknown.
    """

    scenes: TensorDict
    scene_id: list[str]
    location: list[str]
    dataset: str
    split: str
    dropped: dict[str, int]
    number: list[int] = field(default_factory=list)
    files: str = ""

    def __post_init__(self) -> None:
        self.number = self.number or list(range(len(self.scene_id)))

    def __getstate__(self) -> dict[str, Any]:
        """Returns what another process gets: these scenes alone, not the file or the
        tensors that they are part of."""
        return vars(self) | {"scenes": self.scenes.clone()}

    def __len__(self) -> int:
        return len(self.scene_id)

    @property
    def steps(self) -> int:
        """Simulated steps T."""
        return self.scenes["logged"].shape[1] - 1

    def hashes(self) -> list[str]:
        """Returns the `content_hash` of each scene, of what is used: what a file says
        of itself may be forged."""
        columns = {key: value.cpu().numpy() for key, value in self.scenes.items()}
        columns.pop("scene_index", None)
        return [
            content_hash({key: value[row] for key, value in columns.items()})
            for row in range(len(self))
        ]

    def batch(self, indices: Sequence[int] | Tensor) -> TensorDict:
        """Returns the scenes [B] at `indices`, as a copy."""
        return self.scenes[torch.as_tensor(indices)]

    def parts(self, size: int = PART) -> Iterator[TensorDict]:
        """Yields all scenes in their order, at most `size` at a time."""
        return (self.batch(index) for index in torch.arange(len(self)).split(size))

    def index(self, which: int | str) -> int:
        """Returns the index of a scene given by index or id; raises InputError where
        there is none."""
        if isinstance(which, int) and 0 <= which < len(self):
            return which
        if which in self.scene_id:
            return self.scene_id.index(which)
        raise InputError(
            f"scene={which}: expected an index below {len(self)} or the id of a scene, "
            f"such as {self.scene_id[0]}"
        )

    def copy_into(
        self,
        batch: TensorDict,
        rows: Tensor,
        indices: Tensor,
    ) -> None:
        """Overwrites rows [b] (ascending) of a batch of scenes by the scenes at
        `indices` [b], in place."""
        whole = len(rows) == len(batch)
        for key, source in self.scenes.items():
            target = batch[key]
            indices = indices.to(source.device)
            near = source.device == target.device
            large = source[0].numel() > LARGE and not source.is_cuda
            if whole and near:  # a second copy would cost more pages than the first
                torch.index_select(
                    source,
                    0,
                    indices,
                    out=target,
                )
            elif near and large:  # scene by scene, without a copy between
                for row, index in zip(rows.tolist(), indices.tolist(), strict=True):
                    target[row].copy_(source[index])
            else:
                values = source.index_select(0, indices).to(target.device)
                target.index_copy_(0, rows, values)

    def first(self, count: int | None) -> "SceneSet":
        """Returns the first `count` scenes (all for None)."""
        return self if count is None else self.chosen(range(min(count, len(self))))

    def chosen(self, indices: Sequence[int]) -> "SceneSet":
        """Returns the scenes at `indices`, which keep their noise; the first ones are
        not copied."""
        rows = list(indices)
        count = len(rows)
        if rows == list(range(len(self))):
            return self
        is_first = rows == list(range(count))
        scenes = self.scenes[:count] if is_first else self.batch(rows)
        scenes["scene_index"] = torch.arange(count, device=scenes["scene_index"].device)
        return replace(
            self,
            scenes=scenes,
            scene_id=[self.scene_id[row] for row in rows],
            location=[self.location[row] for row in rows],
            number=[self.number[row] for row in rows],
        )

    def to(self, device: torch.device | str) -> "SceneSet":
        """Returns the same scenes on a device."""
        return replace(self, scenes=self.scenes.to(device))
