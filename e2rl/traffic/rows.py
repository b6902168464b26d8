"""Rows of the states that traffic methods keep, and noise that depends on a scene's seed alone."""

from dataclasses import fields, is_dataclass, replace
from typing import TypeVar

import torch
from tensordict import TensorDictBase
from torch import Tensor

Value = TypeVar("Value")  # a tensor, a TensorDict, a (nested) dataclass of them, or None


def take_rows(value: Value, rows: Tensor) -> Value:
    """Rows of every tensor; None stays None."""
    if isinstance(value, Tensor | TensorDictBase):
        return value[rows]
    if not is_dataclass(value):
        return value
    return replace(value, **{field.name: take_rows(getattr(value, field.name), rows) for field in fields(value)})


def put_rows(value: Value, rows: Tensor, new: Value) -> Value:
    """`value` with `rows` of every tensor replaced by those of `new`, out of place."""
    if isinstance(value, Tensor | TensorDictBase):
        out = value.clone()
        out[rows] = new
        return out
    if not is_dataclass(value):
        return value
    changed = {field.name: (getattr(value, field.name), getattr(new, field.name)) for field in fields(value)}
    return replace(value, **{name: put_rows(old, rows, fresh) for name, (old, fresh) in changed.items()})


def noise_of(seed: Tensor, draw: Tensor, shape: tuple[int, ...], uniform: bool = False) -> Tensor:
    """Random numbers [B, *shape] that depend on each scene's seed [B] and number of the draw [B] only, not on the
    batch: standard normal, or uniform in [0, 1)."""
    rows = []
    for value, number in torch.stack([seed, draw], -1).tolist():
        generator = torch.Generator().manual_seed((value * 1_000_003 + number) % (2**63))
        rows.append((torch.rand if uniform else torch.randn)(shape, generator=generator))
    return torch.stack(rows).to(seed.device)
