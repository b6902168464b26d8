"""Rows of the states of traffic methods, and noise that depends only on a scene's seed."""

from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import torch
from tensordict import TensorDictBase
from torch import Tensor

Value = TypeVar("Value")  # a tensor, a TensorDict, a (nested) dataclass of them, or None


def take_rows(value: Value, rows: Tensor) -> Value:
    """Rows of every tensor; None stays None."""
    return map_tensors(lambda tensor: tensor[rows], value)


def put_rows(value: Value, rows: Tensor, new: Value) -> Value:
    """`value` with `rows` of every tensor replaced by those of `new`, out of place."""

    def put(old: Any, fresh: Any) -> Any:
        out = old.clone()
        out[rows] = fresh
        return out

    return map_tensors(put, value, new)


def map_tensors(function: Callable, value: Any, *others: Any) -> Any:
    """Map function over every tensor or TensorDict of a value and its counterparts in others; the rest is kept."""
    if isinstance(value, Tensor | TensorDictBase):
        return function(value, *others)
    if not is_dataclass(value) or isinstance(value, type):
        return value
    names = [field.name for field in fields(value)]
    parts = {name: [getattr(each, name) for each in (value, *others)] for name in names}
    return replace(value, **{name: map_tensors(function, *part) for name, part in parts.items()})


def noise_of(seed: Tensor, draw: Tensor, shape: tuple[int, ...], uniform: bool = False) -> Tensor:
    """Random numbers [B, *shape] that depend only on each scene's seed [B] and draw number [B], not on the
    batch: standard normal, or uniform in [0, 1)."""
    rows = []
    for value, number in torch.stack([seed, draw], -1).tolist():
        generator = torch.Generator().manual_seed((value * 1_000_003 + number) % (2**63))
        rows.append((torch.rand if uniform else torch.randn)(shape, generator=generator))
    return torch.stack(rows).to(seed.device)
