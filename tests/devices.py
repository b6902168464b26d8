"""A device that is not there: tensors of it lie in the CPU's memory and carry a mark,
and must not meet unmarked ones.

What torch refuses on a GPU is refused here: operations on tensors of two devices, an
index on another device, numpy's view. Tensors without dimensions pass, as those of the
CPU do there.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves

CPU = torch.device("cpu")
PRETENDED = torch.device("cuda", 0)
MARK = "pretended"
TAKEN = {
    "tensor",
    "as_tensor",
    "asarray",
}  # whose result lies where what they are given lies
CREATED = TAKEN | {
    "zeros",
    "ones",
    "full",
    "arange",
    "tensor",
    "empty",
    "rand",
    "randn",
    "linspace",
    "eye",
    "randint",
    "randperm",
}
LIKE = ("_like", "new_")
MOVED = {
    "copy_",
    "__set__",
    "_has_compatible_shallow_copy_type",
    "equal",
}  # between devices, as they are meant


def device_of(tensor: Tensor) -> torch.device:
    """Where the tensor pretends to lie."""
    return PRETENDED if getattr(tensor, MARK, False) else CPU


def on(found: Any, device: torch.device, given: list[Tensor]) -> Any:
    """Mark the tensors of a result, besides those that were given."""
    for item in tree_leaves(found):
        if isinstance(item, Tensor) and not any(item is single for single in given):
            setattr(item, MARK, device.type == "cuda")
    return found


class Pretended(TorchFunctionMode):
    """Between enter and exit there is a device `cuda`."""

    def __torch_function__(
        self, function: Callable, types, args=(), kwargs=None
    ) -> Any:
        kwargs = dict(kwargs or {})
        name = getattr(function, "__name__", "")
        inputs = [
            item for item in tree_leaves((args, kwargs)) if isinstance(item, Tensor)
        ]
        if function == Tensor.device.__get__:
            return device_of(args[0])
        if function == Tensor.is_cuda.__get__:
            return device_of(args[0]) == PRETENDED
        if name in ("to", "cpu", "cuda"):
            return self.moved(function, name, args=args, kwargs=kwargs)
        requests = kwargs.pop("device", None)
        if requests is not None:
            requests = torch.device(requests)
        if function == Tensor.data.__set__:
            function(*args)
            return on(args[0], device_of(args[1]), given=[])
        if name in CREATED or any(part in name for part in LIKE):
            ours = (
                device_of(inputs[0])
                if inputs and (name in TAKEN or name not in CREATED)
                else CPU
            )
            return on(function(*args, **kwargs), requests or ours, given=[])
        if name in ("numpy", "__array__"):
            assert device_of(args[0]) == CPU, f"{name} of a tensor on {PRETENDED}"
        device = self.checked(name, args, given=inputs)
        return on(function(*args, **kwargs), device, given=inputs)

    @staticmethod
    def moved(function: Callable, name: str, args: tuple, kwargs: dict) -> Any:
        """The result of Tensor.to and its like."""
        places = [
            x
            for x in (*args[1:], *kwargs.values())
            if isinstance(x, str | torch.device | Tensor)
        ]
        target = {"cpu": CPU, "cuda": PRETENDED}.get(name, device_of(args[0]))
        for place in places:
            target = (
                device_of(place) if isinstance(place, Tensor) else torch.device(place)
            )
        ours = [CPU if isinstance(x, str | torch.device) else x for x in args]
        own_kwargs = {
            key: CPU if isinstance(x, str | torch.device) else x
            for key, x in kwargs.items()
        }
        outcome = ours[0] if name != "to" else function(*ours, **own_kwargs)
        if outcome is args[0] and target != device_of(args[0]):
            outcome = outcome.clone()
        return on(outcome, target, given=[args[0]])

    @staticmethod
    def checked(name: str, args: tuple, given: list[Tensor]) -> torch.device:
        """The device of an operation's result."""
        if name in ("__getitem__", "__setitem__"):
            ours = device_of(args[0])
            index = [x for x in tree_leaves(args[1]) if isinstance(x, Tensor)]
            assert ours == PRETENDED or all(device_of(x) == CPU for x in index), (
                f"{name}: index on {PRETENDED}"
            )
            value = [x for x in args[2:] if isinstance(x, Tensor) and x.ndim]
            assert all(device_of(x) == ours for x in value), (
                f"{name}: a value on another device"
            )
            return ours
        places = {device_of(x) for x in given if x.ndim} or {
            device_of(x) for x in given
        }
        mixed = len(places) > 1 or (
            places == {CPU} and any(device_of(x) == PRETENDED for x in given)
        )
        assert not mixed or name in MOVED, (
            f"{name}: tensors of shapes {[list(x.shape) for x in given]} on two devices"
        )
        return PRETENDED if PRETENDED in places else CPU


@contextmanager
def pretended_device() -> Iterator[None]:
    """A device `cuda`, of which torch's own modules are told."""
    here = {
        "is_available": lambda: True,
        "current_device": lambda: 0,
        "synchronize": lambda *given: None,
    }
    with mock.patch.multiple(torch.cuda, **here), Pretended():
        yield
