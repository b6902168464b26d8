"""Pickles of plain data: containers, numbers, text and numpy arrays. A class or
function that a file names is none but those of NAMES, so that no code of a file runs.

numpy's own types are not handed the states that a file has for them, which could make
elements of any address: an array's type is one of a plain element, by its name.
"""

import pickle
import pickletools
import re
from functools import lru_cache
from io import BytesIO
from typing import Any

import numpy as np

ELEMENT = re.compile(r"[?]|[biufc](1|2|4|8|16)|[SU][1-9]\d{0,4}|O[48]?")


class Element:
    """A numpy type as a pickle describes it."""

    def __init__(self, name: str, *_: Any) -> None:
        self.name = name
        self.order: Any = "="

    def __setstate__(self, state: tuple) -> None:
        self.order = "=" if state[1] == "|" else state[1]

    def dtype(self) -> np.dtype:
        """Returns the type; raises ValueError for one of no plain element."""
        return _plain_dtype(self.name, self.order)


@lru_cache(256)  # a file has thousands of arrays of few types
def _plain_dtype(name: str, order: str) -> np.dtype:
    if not ELEMENT.fullmatch(name):
        raise ValueError(
            f"holds arrays of other elements than numbers and text ({name})"
        )
    return np.dtype(name).newbyteorder(order)  # type: ignore[arg-type]


class Array(np.ndarray):
    """An array of plain elements."""

    def __setstate__(self, state: tuple) -> None:
        version, shape, element, fortran, data = state
        super().__setstate__((version, shape, element.dtype(), fortran, data))


def array_of(data: bytes, element: Element, shape: tuple, *order: Any) -> np.ndarray:
    """Returns the array in the bytes of a pickle of protocol 5; order: "C" or "F", or
    "K" and the order of its axes."""
    flat = np.frombuffer(data, element.dtype())
    if order[0] == "K":
        return flat.reshape(shape).transpose(order[1])
    return flat.reshape(shape, order=order[0])


PLAIN = (set, frozenset, list, dict, tuple, int, float, bool, str, bytes, bytearray)
NAMES: dict[str, Any] = {
    **{f"builtins.{kind.__name__}": kind for kind in (*PLAIN, complex)},
    "collections.defaultdict": lambda *_: {},
    "_codecs.encode": str.encode,  # bytes in protocols 0 to 2
    "numpy.ndarray": Array,
    "numpy.dtype": Element,
    "numpy._core.multiarray._reconstruct": lambda *_: np.ndarray.__new__(Array, 0),
    "numpy._core.multiarray.scalar": lambda element, data: array_of(
        data, element, (), "C"
    )[()],
    "numpy._core.numeric._frombuffer": array_of,
}


class PlainUnpickler(pickle.Unpickler):
    """Reads a pickle of plain data; raises ValueError for a name outside of NAMES."""

    def find_class(self, module: str, name: str) -> Any:
        path = f"{module}.{name}"
        for old, new in (
            ("__builtin__.", "builtins."),
            ("numpy.core.", "numpy._core."),
        ):
            path = new + path.removeprefix(old) if path.startswith(old) else path
        if path not in NAMES:
            raise ValueError(f"names the forbidden class {path[:200]}")
        return NAMES[path]


MOST_TUPLES = 100_000  # a log of 1.5 MB has 10,000
TUPLE_CODES = (b"t", b"\x85", b"\x86", b"\x87")


def load_plain(content: bytes) -> Any:
    """Returns the plain data in a pickle; raises ValueError, or what damaged bytes make
    the standard library raise.

    Python hashes tuples in tuples without a bound on their depth, which is at most
    their number.
    """
    if sum(map(content.count, TUPLE_CODES)) > MOST_TUPLES:
        names = (code.name for code, _, _ in pickletools.genops(content))
        if sum(name.startswith("TUPLE") for name in names) > MOST_TUPLES:
            raise ValueError(f"holds more than {MOST_TUPLES:,} tuples")
    return PlainUnpickler(BytesIO(content), encoding="latin-1").load()
