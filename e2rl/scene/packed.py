"""Scenes as bytes, without loss and in a seventh of their size: for the cache, and for sets larger than the memory.

A record is a zlib stream of the arrays' names, types and shapes as JSON, and of the arrays one after another. Each is
taken as whole numbers of its type's size; stored are their differences along the longest axis, byte plane by byte
plane: the high bytes of smooth numbers, and padding, are zeros then.
"""

import json
import struct
import zlib
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from e2rl.scene.scene import content_hash

LEVEL = 3  # of zlib; 6 saves 3% and takes twice as long
LARGEST = 1 << 28  # bytes that a record is unpacked to at most
LENGTH = struct.Struct("<I")


class Packed(NamedTuple):
    """The record of a scene, its arrays' types and shapes, and its `content_hash`."""

    record: bytes
    layout: dict[str, tuple[str, tuple[int, ...]]]
    digest: str


def pack(scene: Mapping[str, np.ndarray]) -> Packed:
    """A scene's arrays as a record."""
    layout = {key: (value.dtype.str, value.shape) for key, value in scene.items()}
    head = json.dumps(layout).encode()
    content = b"".join([LENGTH.pack(len(head)), head, *map(_planes, scene.values())])
    return Packed(zlib.compress(content, LEVEL), layout, content_hash(scene))


def unpack(record: bytes | memoryview) -> dict[str, np.ndarray]:
    """The arrays of a record, bit for bit; raises ValueError where it is damaged."""
    try:
        content = _inflated(record)
        begin = LENGTH.size + LENGTH.unpack_from(content)[0]
        layout, scene = json.loads(content[LENGTH.size : begin]), {}
        for key, (name, shape) in layout.items():
            dtype = number_type(name)
            end = begin + int(np.prod(shape)) * dtype.itemsize
            scene[key] = _array(content[begin:end], dtype, shape)
            begin = end
    except (zlib.error, struct.error, TypeError, LookupError, AttributeError) as error:
        raise ValueError(f"a damaged scene ({error})") from error
    return scene


def number_type(name: str) -> np.dtype:
    """The type of numbers or truth values of this name; TypeError for objects and others."""
    dtype = np.dtype(name)
    if dtype.kind not in "biuf":
        raise TypeError(f"{name} is no type of numbers")
    return dtype


def _inflated(record: bytes | memoryview) -> bytes:
    stream = zlib.decompressobj()
    content = stream.decompress(record, LARGEST)
    if not stream.eof:
        raise ValueError("a scene that is cut short, or larger than any")
    return content


def _planes(value: np.ndarray) -> bytes:
    """An array's differences, byte plane by byte plane."""
    value = np.ascontiguousarray(value)
    numbers = value.view(f"u{value.dtype.itemsize}")
    if value.size:
        axis = int(np.argmax(value.shape))
        numbers = np.diff(numbers, axis=axis, prepend=np.zeros_like(numbers.take([0], axis)))
    return numbers.reshape(-1).view(np.uint8).reshape(-1, value.dtype.itemsize).T.tobytes()


def _array(planes: bytes, dtype: np.dtype, shape: list[int]) -> np.ndarray:
    """The array of `_planes`, of at least one dimension."""
    width = dtype.itemsize
    numbers = np.frombuffer(planes, np.uint8).reshape(width, -1).T.copy().view(f"u{width}").reshape(shape)
    if numbers.size:
        np.cumsum(numbers, axis=int(np.argmax(shape)), dtype=numbers.dtype, out=numbers)
    return numbers.view(dtype)
