"""Pickles of plain data, read without running them: containers, numbers, text and numpy
arrays.

A pickle is a program for a stack machine, whose opcodes the standard library's
`pickletools` documents. The machine here is the standard library's own in Python, with
the opcodes that plain data needs and no others. A class or function that a file names
is a name and no more: the few that arrays and sets are made of are carried out by
plain_objects.py, with checked arguments, and all others are refused. The standard
library's fast machine would not do: it hashes, calls and allocates what a file says
before anybody can look.

What the file may cost is bounded, too: depth, opcodes, and the items that a reader
meets who follows every reference. A container is complete when it is referred to a
second time, so that nothing holds itself.
"""

import pickle
from collections.abc import Callable
from io import BytesIO
from typing import Any

import numpy as np

from e2rl.scenes.plain_objects import (
    MAX_ITEMS,
    NAMES,
    Name,
    Unbuilt,
    array_of,
    as_keys,
    called,
    dtype_of,
)

MAX_OPCODES = 5_000_000  # the longest genuine log known has 150,000
MAX_CONTAINERS = 500_000  # and 80,000
MAX_DEPTH = 64
MAX_BITS = 64  # of a whole number
# types that hold or stand for others
HOLDING = frozenset([tuple, list, dict, set, frozenset, np.ndarray, Unbuilt])
LIBRARY: Any = pickle._Unpickler
# modules under their old names
MOVED = {"__builtin__": "builtins", "numpy.core": "numpy._core"}


def load_plain(content: bytes) -> Any:
    """Returns the plain data in a pickle. Raises ValueError, or what damaged bytes make
    the standard library raise.

    defaultdicts become dicts and bytearrays bytes. Arrays have this machine's byte
    order; where it is the pickle's, they are not writeable.
    """
    machine = _Machine(BytesIO(content), encoding="latin-1")
    data = machine.run()
    if machine.stack or machine.metastack:
        raise ValueError("is not one object")
    machine.measure(data, 0)
    return data


class _Machine(LIBRARY):
    """The standard library's machine; handlers that hash, call, grow or share objects
    are replaced."""

    def __init__(self, file: BytesIO, *, encoding: str) -> None:
        super().__init__(file, encoding=encoding)
        self.read = file.read
        self.readline = file.readline
        self.metastack: list[list] = []
        self.stack: list[Any] = []
        self.append = self.stack.append
        self.containers = 0
        # by id: a container that is complete, its depth and items
        self.shared: dict[int, tuple[Any, int, int]] = {}

    def run(self) -> Any:
        """Returns what the program leaves at its end."""
        read = self.read
        try:
            for _ in range(MAX_OPCODES):
                HANDLERS[read(1)](self)
        except pickle._Stop as end:  # type: ignore[attr-defined]
            return end.value
        except KeyError as error:
            raise ValueError(
                f"uses {error}, which is none of its objects and no opcode of plain data"
            ) from error
        raise ValueError(f"has more than {MAX_OPCODES} opcodes")

    def fetch(self, index: int) -> None:
        """Push an object of the memo; if it is a container, it is complete from now on."""
        value = self.memo[index]
        if type(value) in HOLDING:
            value = value.value if type(value) is Unbuilt else value
            if type(value) in HOLDING and id(value) not in self.shared:
                self.shared[id(value)] = (value, *self.measure(value, 0))
        self.append(value)

    def measure(self, value: Any, level: int) -> tuple[int, int]:
        """Returns (depth, items) of an object at `level` of another one: how deep it
        nests, and how many items it holds if all references are followed. What is
        shared was measured before, so the walk is over a tree."""
        kind = type(value)
        if id(value) in self.shared:
            _, depth, items = self.shared[id(value)]
        elif kind not in HOLDING:
            return 0, 1
        elif level >= MAX_DEPTH:
            raise ValueError(f"nests deeper than {MAX_DEPTH} levels")
        else:
            depth = 1
            items = 1 + (value.size if kind is np.ndarray else len(value))
            if kind is dict:
                items = items + len(value)
                value = value.values()
            elif kind is np.ndarray:
                value = value.ravel().tolist() if value.dtype.kind == "O" else ()
            for part in () if HOLDING.isdisjoint(map(type, value)) else value:
                if type(part) in HOLDING:
                    part_depth, part_items = self.measure(part, level + 1)
                    depth = max(depth, part_depth + 1)
                    items = items + part_items - 1
        if level + depth > MAX_DEPTH:
            raise ValueError(f"nests deeper than {MAX_DEPTH} levels")
        if items > MAX_ITEMS:
            raise ValueError(f"stands for more than {MAX_ITEMS} items")
        return depth, items

    def counted(self) -> None:
        """One more container, or mark of one."""
        self.containers += 1
        if self.containers > MAX_CONTAINERS:
            raise ValueError(f"has more than {MAX_CONTAINERS} containers")

    def bounded(self) -> None:
        """A whole number was pushed."""
        if self.stack[-1].bit_length() > MAX_BITS:
            raise ValueError(f"holds a whole number of more than {MAX_BITS} bits")

    def growing(self, kind: type) -> Any:
        """Returns the container on the top of the stack, which is about to take more."""
        target = self.stack[-1]
        if type(target) is not kind:
            raise ValueError(
                f"adds items of a {kind.__name__} to a {type(target).__name__}"
            )
        if id(target) in self.shared:
            raise ValueError("adds to a container that is in use already")
        return target

    def set_items(self, parts: list[Any]) -> None:
        if len(parts) % 2:
            raise ValueError("sets an item without a value")
        keys = as_keys(parts[::2])
        self.growing(dict).update(zip(keys, parts[1::2], strict=True))

    def append_item(self) -> None:
        part = self.stack.pop()
        self.growing(list).append(part)

    def append_items(self) -> None:
        parts = self.pop_mark()
        self.growing(list).extend(parts)

    def set_item(self) -> None:
        value = self.stack.pop()
        key = self.stack.pop()
        self.set_items([key, value])

    def set_marked_items(self) -> None:
        self.set_items(self.pop_mark())

    def add_items(self) -> None:
        parts = self.pop_mark()
        self.growing(set).update(as_keys(parts))

    def make_dict(self) -> None:
        parts = self.pop_mark()
        self.append({})
        self.set_items(parts)

    def make_frozenset(self) -> None:
        parts = self.pop_mark()
        self.append(frozenset(as_keys(parts)))

    def find_class(self, module: str, name: str) -> Name:
        """Returns a name for a class or function, which is not imported."""
        old = next((old for old in MOVED if f"{module}.".startswith(f"{old}.")), "")
        path = f"{MOVED.get(old, '')}{module[len(old) :]}.{name}"
        if path not in NAMES:
            raise ValueError(f"names the forbidden class {path[:200]}")
        return Name(path)

    def call(self) -> None:
        arguments = self.stack.pop()
        function = self.stack.pop()
        if not isinstance(function, Name) or type(arguments) is not tuple:
            raise ValueError("calls what is no name")
        self.counted()
        self.append(called(function.path, arguments))

    def build(self) -> None:
        state = self.stack.pop()
        target = self.stack.pop()
        if not isinstance(target, Unbuilt) or target.value is not None:
            raise ValueError("gives a state to what has none")
        if target.dtype is not None:
            target.value = dtype_of(target.dtype, state)
        else:
            _, shape, dtype, fortran, data = state
            target.value = array_of(
                data,
                dtype,
                shape=shape,
                order="F" if fortran else "C",
            )
        self.append(target.value)


Handler = Callable[[_Machine], Any]


def _handler(
    name: str,
    before: Handler | None = None,
    after: Handler | None = None,
) -> Handler:
    """Returns the standard library's handler of an opcode, with a check before or after
    it."""
    handler = LIBRARY.dispatch[getattr(pickle, name)[0]]

    def handle(machine: _Machine) -> None:
        if before is not None:
            before(machine)
        handler(machine)
        if after is not None:
            after(machine)

    return handler if before is after is None else handle


AS_THEY_ARE = (
    "PROTO STOP NONE NEWTRUE NEWFALSE BININT BININT1 BININT2 FLOAT BINFLOAT STRING "
    "BINSTRING SHORT_BINSTRING UNICODE BINUNICODE SHORT_BINUNICODE BINUNICODE8 "
    "BINBYTES SHORT_BINBYTES BINBYTES8 PUT BINPUT LONG_BINPUT MEMOIZE GLOBAL "
    "STACK_GLOBAL"
)
CONTAINERS = (
    "MARK EMPTY_LIST EMPTY_DICT EMPTY_SET EMPTY_TUPLE TUPLE1 TUPLE2 TUPLE3 TUPLE LIST"
)
BY_NAME: dict[str, Handler] = {
    **{name: _handler(name) for name in AS_THEY_ARE.split()},
    **{name: _handler(name, before=_Machine.counted) for name in CONTAINERS.split()},
    **{
        name: _handler(name, after=_Machine.bounded)
        for name in ("INT", "LONG", "LONG1", "LONG4")
    },
    "GET": lambda machine: machine.fetch(int(machine.readline())),
    "BINGET": lambda machine: machine.fetch(machine.read(1)[0]),
    "LONG_BINGET": lambda machine: machine.fetch(
        int.from_bytes(machine.read(4), "little")
    ),
    "FRAME": lambda machine: machine.read(8),  # of use to those who read from streams
    "BYTEARRAY8": _handler("BINBYTES8"),  # the other allocates what it only announces
    "APPEND": _Machine.append_item,
    "APPENDS": _Machine.append_items,
    "SETITEM": _Machine.set_item,
    "SETITEMS": _Machine.set_marked_items,
    "ADDITEMS": _Machine.add_items,
    "DICT": _Machine.make_dict,
    "FROZENSET": _Machine.make_frozenset,
    "REDUCE": _Machine.call,
    "BUILD": _Machine.build,
}
HANDLERS = {getattr(pickle, name): handler for name, handler in BY_NAME.items()}
