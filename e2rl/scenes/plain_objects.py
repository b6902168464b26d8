"""What the names in a pickle of plain data stand for: numpy arrays, their types, and a
few builtins.

A name is never imported or called. The few in NAMES are carried out here, with checked
arguments.
"""

import re
from collections.abc import (
    Hashable,
    Iterable,
    Sequence,
)
from dataclasses import dataclass
from math import prod
from typing import (
    Any,
    Literal,
)

import numpy as np

# of an array, and of all that a reader meets who follows every reference
MAX_ITEMS = 20_000_000
DTYPE = re.compile(r"[?]|[biufc](1|2|4|8|16)|[SU][1-9]\d{0,4}|O[48]?")
TEXTS = frozenset([str])
# types that are hashed without recursion
KEYS = (str, int, float, bytes, type(None), np.str_, np.integer, np.floating)
RECONSTRUCT = "numpy._core.multiarray._reconstruct"
PLAIN = "set frozenset list dict tuple int float bool str bytes bytearray complex"
NAMES = {f"builtins.{name}" for name in PLAIN.split()} | {
    "collections.defaultdict",
    "_codecs.encode",  # bytes in protocols 0 to 2
    "numpy.ndarray",
    "numpy.dtype",
    "numpy._core.multiarray.scalar",
    "numpy._core.numeric._frombuffer",
    RECONSTRUCT,
}


@dataclass(frozen=True)
class Name:
    """A class or function that a pickle names; it is never imported."""

    path: str


@dataclass
class Unbuilt:
    """An array (dtype None) or a numpy type of which the pickle has yet to give the
    state."""

    dtype: str | None = None
    value: Any = None


def as_keys(values: Sequence[Any]) -> Iterable[Hashable]:
    """Keys of a dict or items of a set; refuses what could be hashed recursively or
    collide at will."""
    return values if TEXTS.issuperset(map(type, values)) else map(_as_key, values)


def _as_key(value: Any) -> Hashable:
    if not isinstance(value, KEYS):
        raise ValueError(f"has a {type(value).__name__} as key")
    return value


def called(path: str, arguments: tuple) -> Any:
    """What a pickle gets for calling one of NAMES."""
    match path.rpartition(".")[2], arguments:
        case "_reconstruct", [Name("numpy.ndarray"), (0,), _]:
            return Unbuilt()
        case "dtype", [str(name), *_] if DTYPE.fullmatch(name):
            return Unbuilt(name)
        case "scalar", [np.dtype(kind=kind) as dtype, bytes() | str() as data] if (
            kind != "O"
        ):
            return array_of(
                data,
                dtype,
                shape=(),
                order="C",
            )[()]
        case "_frombuffer", [
            bytes() | bytearray() as data,
            np.dtype() as dtype,
            tuple(shape),
            "C" | "F" as order,
        ]:
            return array_of(
                data,
                dtype,
                shape=shape,
                order=order,
            )
        case "_frombuffer", [
            bytes() | bytearray() as data,
            np.dtype() as dtype,
            tuple(shape),
            "K",
            tuple(axes),
        ]:
            return array_of(
                data,
                dtype,
                shape=shape,
                order="C",
            ).transpose(axes)
        case "encode", [str(text), "latin1" | "latin-1"]:
            return text.encode("latin-1")
        case "bytes" | "bytearray", []:
            return b""
        case "bytearray", [bytes(data)]:
            return data
        case "bytearray", [str(text), "latin-1"]:
            return text.encode("latin-1")
        case "set", [list(items)]:
            return set(as_keys(items))
        case "frozenset", [list(items)]:
            return frozenset(as_keys(items))
        case "complex", [float(real), float(imaginary)]:
            return complex(real, imaginary)
        case "defaultdict", [] | [Name() | None]:
            return {}
    raise ValueError(f"calls {path} with other arguments than plain data has")


def dtype_of(name: str, state: Any) -> np.dtype:
    """A numpy type of plain elements; state: version, byte order, no parts and no
    fields, sizes, flags."""
    version, order, *parts = state
    plain = version == 3 and parts[:3] == [None, None, None]
    if not plain or order not in ("<", ">", "|", "="):
        raise ValueError(
            f"holds arrays of other elements than numbers and text ({name})"
        )
    return np.dtype(name) if order in "|=" else np.dtype(name).newbyteorder(order)


def array_of(
    data: Any,
    dtype: np.dtype,
    shape: tuple,
    order: Literal["C", "F"],
) -> np.ndarray:
    """Returns an array of exactly what the pickle holds for it.

    Args:
        data: its bytes or, of objects, a list of them.
        dtype: of its elements.
        shape: of the array.
        order: in which the bytes lie.

    Raises:
        ValueError: where these do not fit each other.
    """
    if not isinstance(dtype, np.dtype) or type(shape) is not tuple or len(shape) > 8:
        raise ValueError("holds an array without type or shape")
    if not all(type(size) is int and 0 <= size <= MAX_ITEMS for size in shape):
        raise ValueError(f"holds an array of the impossible shape {shape}")
    count = prod(shape)
    if dtype.kind == "O":
        if type(data) is not list or len(data) != count:
            raise ValueError(f"holds an array of shape {shape} without its objects")
        objects = np.empty(count, object)
        for index, value in enumerate(data):
            objects[index] = value
        return objects.reshape(shape)  # numpy lists them in C order always
    if isinstance(data, str):  # written by Python 2
        data = data.encode("latin-1")
    if not isinstance(data, bytes | bytearray) or len(data) != count * dtype.itemsize:
        raise ValueError(
            f"holds an array of shape {shape} and type {dtype} without its data"
        )
    if not count:
        return np.zeros(shape, dtype.newbyteorder("="))
    if dtype.kind == "b":  # a byte that is neither 0 nor 1 would miscount
        return (np.frombuffer(data, np.uint8) != 0).reshape(shape, order=order)
    flat = np.frombuffer(data, dtype)
    if dtype.kind == "U":
        characters = flat.view(np.dtype("u4").newbyteorder(dtype.byteorder))
        if characters.max() > 0x10FFFF:
            raise ValueError("holds text that is no Unicode")
    if not dtype.isnative:
        flat = flat.astype(dtype.newbyteorder("="))
    return flat.reshape(shape, order=order)
