"""Pickles of plain data, read without running them: containers, numbers, text and numpy arrays.

A pickle is a program for a stack machine, whose opcodes the standard library's `pickletools` documents and decodes. The
machine here has the opcodes that plain data needs, of every protocol, and no others. A class or function that a file
names is a name and no more: the few that arrays and sets are made of are carried out here, with checked arguments, and
all others are refused. What the file may cost is bounded, too: depth, opcodes, and the items that a reader meets who
follows every reference. A container is complete before another one holds it, so that nothing holds itself.
"""

import pickletools
import re
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass
from math import prod
from typing import Any, Literal

import numpy as np

MAX_OPCODES, MAX_CONTAINERS = 5_000_000, 500_000  # the longest genuine log known has 150,000 and 40,000
MAX_DEPTH, MAX_ITEMS = 64, 20_000_000
MAX_BITS = 64  # of a whole number
DTYPE = re.compile(r"[?]|[biufc](1|2|4|8|16)|[SU][1-9]\d{0,4}|O[48]?")
KEYS = (str, int, float, bytes, type(None), np.str_, np.integer, np.floating)  # hashed without recursion
PLAIN = ("set", "frozenset", "list", "dict", "tuple", "int", "float", "bool", "str", "bytes", "bytearray", "complex")
NAMES = {f"builtins.{name}" for name in PLAIN} | {
    "collections.defaultdict",
    "_codecs.encode",  # bytes in protocols 0 to 2
    "numpy.ndarray",
    "numpy.dtype",
    "numpy._core.multiarray._reconstruct",
    "numpy._core.multiarray.scalar",
    "numpy._core.numeric._frombuffer",
}


@dataclass(frozen=True)
class _Name:
    """A class or function that a pickle names; it is never imported."""

    path: str


@dataclass
class _Unbuilt:
    """An array (dtype None) or a numpy type of which the pickle has yet to give the state."""

    dtype: str | None = None
    value: Any = None


@dataclass(slots=True)
class _Extent:
    """Of a container: how deep it nests and how many items it holds if all references are followed; held: by another
    container, hence complete."""

    container: object
    depth: int
    items: int
    held: bool = False


def load_plain(content: bytes) -> Any:
    """The plain data in a pickle. Raises ValueError, or what damaged bytes make pickletools and numpy raise.

    defaultdicts become dicts. Arrays have this machine's byte order; where it is the pickle's, they are not writeable.
    """
    return _Machine().run(content)


class _Machine:
    def __init__(self) -> None:
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}
        self.extents: dict[int, _Extent] = {}  # by id; they keep their containers, so an id stays one container's

    def run(self, content: bytes) -> Any:
        for count, (opcode, argument, _) in enumerate(pickletools.genops(content)):
            if count >= MAX_OPCODES:
                raise ValueError(f"has more than {MAX_OPCODES} opcodes")
            act = ACTIONS.get(opcode.name)
            if act is None:
                raise ValueError(f"holds more than plain data (opcode {opcode.name})")
            act(self, argument)
        if len(self.stack) != 1 or self.marks:
            raise ValueError("is not one object")
        return self.stack[0]

    # --- stack and memo

    def push_value(self, value: Any) -> None:
        if type(value) is int and value.bit_length() > MAX_BITS:
            raise ValueError(f"holds a whole number of more than {MAX_BITS} bits")
        self.stack.append(value)

    def pop(self, count: int) -> list[Any]:
        """The last `count` objects after the last mark, removed."""
        if len(self.stack) - (self.marks[-1] if self.marks else 0) < count:
            raise ValueError("takes more from its stack than there is")
        taken = self.stack[len(self.stack) - count :]
        del self.stack[len(self.stack) - count :]
        return taken

    def pop_mark(self) -> list[Any]:
        """The objects since the last mark, removed with it."""
        begin = self.marks.pop()
        taken = self.stack[begin:]
        del self.stack[begin:]
        return taken

    def mark(self, _: None) -> None:
        self.marks.append(len(self.stack))

    def put(self, key: int | None) -> None:
        self.memo[len(self.memo) if key is None else key] = self.stack[-1]

    def get(self, key: int) -> None:
        value = self.memo[key]
        self.stack.append(value.value if isinstance(value, _Unbuilt) else value)

    # --- containers

    def hold(self, parts: Iterable[Any]) -> tuple[int, int]:
        """(depth, items) of objects that a container is about to hold; containers among them are complete from now."""
        depth = items = 0
        for part in parts:
            extent = self.extents.get(id(part))
            if extent is None:
                items += 1
            else:
                extent.held, depth, items = True, max(depth, extent.depth), items + extent.items
        return depth, items

    def push(self, container: Any, depth: int = 0, items: int = 0) -> None:
        """Push a new container that holds objects of these `hold`."""
        if len(self.extents) >= MAX_CONTAINERS:
            raise ValueError(f"has more than {MAX_CONTAINERS} containers")
        self.extents[id(container)] = _Extent(container, 0, 1)
        self.stack.append(container)
        self.grow(container, depth, items)

    def grow(self, container: Any, depth: int, items: int) -> None:
        extent = self.extents[id(container)]
        if extent.held:
            raise ValueError("adds to a container that is in use already")
        extent.depth, extent.items = max(extent.depth, 1 + depth), extent.items + items
        if extent.depth > MAX_DEPTH:
            raise ValueError(f"nests deeper than {MAX_DEPTH} levels")
        if extent.items > MAX_ITEMS:
            raise ValueError(f"stands for more than {MAX_ITEMS} items")

    def make_tuple(self, parts: list[Any]) -> None:
        extent = self.hold(parts)
        self.push(tuple(parts), *extent)

    def append(self, parts: list[Any]) -> None:
        target, extent = self.stack[-1], self.hold(parts)
        if type(target) is not list:
            raise ValueError(f"appends to a {type(target).__name__}")
        self.grow(target, *extent)
        target += parts

    def add(self, parts: list[Any]) -> None:
        target = self.stack[-1]
        if type(target) is not set:
            raise ValueError(f"adds items to a {type(target).__name__}")
        self.grow(target, *self.hold(parts))
        target.update(map(_key, parts))

    def set_items(self, parts: list[Any]) -> None:
        target, extent = self.stack[-1], self.hold(parts)
        if type(target) is not dict or len(parts) % 2:
            raise ValueError(f"sets items of a {type(target).__name__}")
        self.grow(target, *extent)
        target.update(zip(map(_key, parts[::2]), parts[1::2], strict=True))

    def make_list(self, parts: list[Any]) -> None:
        self.push([])
        self.append(parts)

    def make_dict(self, parts: list[Any]) -> None:
        self.push({})
        self.set_items(parts)

    def make_frozenset(self, parts: list[Any]) -> None:
        made = frozenset(map(_key, parts))
        self.push(made, 0, len(made))

    # --- names and what they stand for

    def name(self, path: str) -> None:
        path = path.replace("__builtin__.", "builtins.", 1) if path.startswith("__builtin__.") else path
        path = path.replace("numpy.core.", "numpy._core.", 1) if path.startswith("numpy.core.") else path
        if path not in NAMES:
            raise ValueError(f"names the forbidden class {path[:200]}")
        self.stack.append(_Name(path))

    def stack_global(self, _: None) -> None:
        module, name = self.pop(2)
        if type(module) is not str or type(name) is not str:
            raise ValueError("names a class that is no text")
        self.name(f"{module}.{name}")

    def reduce(self, _: None) -> None:
        function, arguments = self.pop(2)
        if not isinstance(function, _Name) or type(arguments) is not tuple:
            raise ValueError("calls what is no name")
        made = _called(function.path, arguments)
        if isinstance(made, dict | set | frozenset):
            self.push(made, 0, len(made))
        elif isinstance(made, np.ndarray):
            self.push(made, 0, made.size)
        else:
            self.stack.append(made)

    def build(self, _: None) -> None:
        target, state = self.pop(2)
        if not isinstance(target, _Unbuilt) or target.value is not None:
            raise ValueError("gives a state to what has none")
        if target.dtype is not None:
            target.value = _dtype(target.dtype, state)
            self.stack.append(target.value)
            return
        _, shape, dtype, fortran, data = state
        depth, items = self.hold([data]) if type(data) is list else (0, 0)
        target.value = _array(data, dtype, shape, "F" if fortran else "C")
        self.push(target.value, depth, max(items, target.value.size))


VALUES = (
    *("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT"),
    *("STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8"),
    *("BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8"),
)
ACTIONS: dict[str, Callable[[_Machine, Any], None]] = {
    **dict.fromkeys(VALUES, _Machine.push_value),
    "NONE": lambda machine, _: machine.push_value(None),
    "NEWTRUE": lambda machine, _: machine.push_value(True),
    "NEWFALSE": lambda machine, _: machine.push_value(False),
    **dict.fromkeys(("PROTO", "FRAME", "STOP"), lambda machine, _: None),
    **dict.fromkeys(("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"), _Machine.put),
    **dict.fromkeys(("GET", "BINGET", "LONG_BINGET"), _Machine.get),
    "MARK": _Machine.mark,
    "EMPTY_LIST": lambda machine, _: machine.push([]),
    "EMPTY_DICT": lambda machine, _: machine.push({}),
    "EMPTY_SET": lambda machine, _: machine.push(set()),
    "EMPTY_TUPLE": lambda machine, _: machine.make_tuple([]),
    "TUPLE1": lambda machine, _: machine.make_tuple(machine.pop(1)),
    "TUPLE2": lambda machine, _: machine.make_tuple(machine.pop(2)),
    "TUPLE3": lambda machine, _: machine.make_tuple(machine.pop(3)),
    "TUPLE": lambda machine, _: machine.make_tuple(machine.pop_mark()),
    "LIST": lambda machine, _: machine.make_list(machine.pop_mark()),
    "DICT": lambda machine, _: machine.make_dict(machine.pop_mark()),
    "FROZENSET": lambda machine, _: machine.make_frozenset(machine.pop_mark()),
    "APPEND": lambda machine, _: machine.append(machine.pop(1)),
    "APPENDS": lambda machine, _: machine.append(machine.pop_mark()),
    "SETITEM": lambda machine, _: machine.set_items(machine.pop(2)),
    "SETITEMS": lambda machine, _: machine.set_items(machine.pop_mark()),
    "ADDITEMS": lambda machine, _: machine.add(machine.pop_mark()),
    "GLOBAL": lambda machine, path: machine.name(path.replace(" ", ".", 1)),
    "STACK_GLOBAL": _Machine.stack_global,
    "REDUCE": _Machine.reduce,
    "BUILD": _Machine.build,
}


def _key(value: Any) -> Hashable:
    """A key of a dict or an item of a set; refuses what could be hashed recursively or collide at will."""
    if not isinstance(value, KEYS):
        raise ValueError(f"has a {type(value).__name__} as key")
    return value


def _called(path: str, arguments: tuple) -> Any:
    """What a pickle gets for calling one of NAMES."""
    match path.rpartition(".")[2], arguments:
        case "_reconstruct", [_Name("numpy.ndarray"), (0,), _]:
            return _Unbuilt()
        case "dtype", [str(name), *_] if DTYPE.fullmatch(name):
            return _Unbuilt(name)
        case "scalar", [np.dtype(kind=kind) as dtype, bytes() | str() as data] if kind != "O":
            return _array(data, dtype, (), "C")[()]
        case "_frombuffer", [bytes() | bytearray() as data, np.dtype() as dtype, tuple(shape), "C" | "F" as order]:
            return _array(data, dtype, shape, order)
        case "_frombuffer", [bytes() | bytearray() as data, np.dtype() as dtype, tuple(shape), "K", tuple(axes)]:
            return _array(data, dtype, shape, "C").transpose(axes)
        case "encode", [str(text), "latin1" | "latin-1"]:
            return text.encode("latin-1")
        case "bytes" | "bytearray", []:
            return b""
        case "bytearray", [bytes(data)]:
            return data
        case "bytearray", [str(text), "latin-1"]:
            return text.encode("latin-1")
        case "set", [list(items)]:
            return set(map(_key, items))
        case "frozenset", [list(items)]:
            return frozenset(map(_key, items))
        case "complex", [float(real), float(imaginary)]:
            return complex(real, imaginary)
        case "defaultdict", [] | [_Name() | None]:
            return {}
    raise ValueError(f"calls {path} with other arguments than plain data has")


def _dtype(name: str, state: Any) -> np.dtype:
    """A numpy type of plain elements; state: version, byte order, no parts and no fields, sizes, flags."""
    version, order, *parts = state
    if version != 3 or order not in ("<", ">", "|", "=") or parts[:3] != [None, None, None]:
        raise ValueError(f"holds arrays of other elements than numbers and text ({name})")
    return np.dtype(name) if order in "|=" else np.dtype(name).newbyteorder(order)


def _array(data: Any, dtype: np.dtype, shape: tuple, order: Literal["C", "F"]) -> np.ndarray:
    """An array of exactly the bytes (or, of objects, the list) that the pickle holds for it."""
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
        raise ValueError(f"holds an array of shape {shape} and type {dtype} without its data")
    if not count:
        return np.zeros(shape, dtype.newbyteorder("="))
    if dtype.kind == "b":  # a byte that is neither 0 nor 1 would miscount
        return (np.frombuffer(data, np.uint8) != 0).reshape(shape, order=order)
    flat = np.frombuffer(data, dtype)
    if dtype.kind == "U" and flat.view(np.dtype("u4").newbyteorder(dtype.byteorder)).max() > 0x10FFFF:
        raise ValueError("holds text that is no Unicode")
    return flat.astype(dtype.newbyteorder("="), copy=False).reshape(shape, order=order)
