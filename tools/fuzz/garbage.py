"""What no reader may return: code, data larger than their bytes can say, scenes that are none, other values."""

from typing import Any

import numpy as np
import torch

from e2rl.scenes.scene import SceneSet

CELLS = (int, float, bool, str, bytes, bytearray, complex, type(None), np.generic)
MOST = 1 << 26  # bytes that a small pickle may become


class Garbage(Exception):
    """An input was read as something that it is not."""


def require(true: bool, what: str) -> None:
    if not true:
        raise Garbage(what)


def require_plain(data: Any, most: int) -> None:
    """Garbage where data hold anything but containers, numbers, text and arrays, or are larger than `most` bytes."""
    size, waiting, seen = 0, [data], set()
    while waiting:
        value = waiting.pop()
        if id(value) in seen:
            continue
        seen.add(id(value))
        if isinstance(value, np.ndarray):
            size += value.nbytes
            waiting += list(value.flat) if value.dtype.kind == "O" else []
        elif isinstance(value, dict):
            waiting += [*value, *value.values()]
        elif isinstance(value, list | tuple | set | frozenset):
            waiting += value
        else:
            require(isinstance(value, CELLS), f"a {type(value).__name__}")
            size += len(value) if isinstance(value, str | bytes) else 8
        require(size <= most, "more than its bytes can say")


def require_plausible(scene: dict[str, torch.Tensor]) -> None:
    """Garbage where a scene is none, measured without e2rl.scenes.plausibility."""
    for name, value in scene.items():
        require(not value.is_floating_point() or bool(value.isfinite().all()), f"{name} is not finite")
    logged, known = scene["logged"].double(), scene["logged_valid"]
    states = torch.cat([logged[known], scene["start"].double()[scene["valid"]]])
    require(bool((states[:, :2].abs() < 11_000).all()), "an agent beyond 11 km")
    require(bool(((states[:, 3] >= 0) & (states[:, 3] <= 45)).all()), "a speed beyond 45 m/s")
    size = scene["size"][scene["valid"]]
    require(bool(((size > 0.01) & (size < 50)).all()), "a size beyond 50 m")
    cars = scene["agent_type"] == 0
    moved = logged[5:, :, :2] - logged[:-5, :, :2]
    way = moved.norm(dim=-1)
    there = known[5:] & known[:-5] & cars & (way > 1.5) & (way < 25)
    turned = torch.atan2(moved[..., 1], moved[..., 0]) - logged[2:-3, :, 2]
    turned = torch.atan2(turned.sin(), turned.cos()).abs()
    for car in (there.sum(0) >= 8).nonzero()[:, 0].tolist():
        angle = turned[there[:, car], car].median().item()
        require(min(angle, 3.1416 - angle) < 1.0, f"a vehicle that drives {angle:.1f} rad aside of its heading")


def require_driven(rollout: dict[str, Any]) -> None:
    """Garbage where a rollout is none, measured without e2rl.evaluation.rollout_reader."""
    known = rollout["valid"]
    require(known.shape == rollout["states"].shape[:2] and known.dtype == bool, "states of other agents")
    driven, size = rollout["states"][known], rollout["size"][known.any(0)]
    require(bool(np.isfinite(driven).all() and np.isfinite(size).all()), "a state or a size is not finite")
    require(bool((np.abs(driven) < 200_000).all() and (np.abs(driven[:, 3]) < 200).all()), "no place or speed")
    require(bool(((size > 0) & (size < 200)).all()), "no size of a vehicle")
    require(rollout["eta"] >= 0 and 0 < rollout["dt"] < 2, "no intensity or step")


def require_same_scenes(found: SceneSet, whole: SceneSet) -> None:
    require(found.scene_id == whole.scene_id and found.location == whole.location, "other scenes")
    require(all(torch.equal(value, whole.scenes[key]) for key, value in found.scenes.items()), "other scenes")


def same(one: Any, other: Any) -> bool:
    """Whether two nested values of plain types and tensors are equal, to the bit."""
    if isinstance(one, torch.Tensor):
        return isinstance(other, torch.Tensor) and one.dtype == other.dtype and torch.equal(one, other)
    if isinstance(one, dict):
        return isinstance(other, dict) and list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return type(one) is type(other) and len(one) == len(other) and all(map(same, one, other))
    return type(one) is type(other) and one == other
