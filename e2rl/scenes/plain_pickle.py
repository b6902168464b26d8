"""Pickles of plain data, read without running them: containers, numbers, text and numpy arrays.

A pickle is a program for a stack machine, whose opcodes the standard library's `pickletools` documents. The machine
here has the opcodes that plain data needs, of every protocol, and no others. A class or function that a file
names is a name and no more: the few that arrays and sets are made of are carried out here, with checked arguments, and
all others are refused. What the file may cost is bounded, too: depth, opcodes, and the items that a reader meets who
follows every reference. A container is complete when it is referred to a second time, so that nothing holds itself.
"""

import pickle
import pickletools
import re
from collections.abc import Callable
from io import BytesIO
from struct import Struct
from typing import Any

import numpy as np

from e2rl.scenes.plain_objects import MAX_ITEMS, NAMES, RECONSTRUCT, Name, Unbuilt, array_of, as_keys, called, dtype_of

MAX_OPCODES, MAX_CONTAINERS = 5_000_000, 500_000  # the longest genuine log known has 150,000 and 40,000
MAX_DEPTH = 64
MAX_BITS = 64  # of a whole number
HOLDING = frozenset([tuple, list, dict, set, frozenset, np.ndarray, Unbuilt])  # types that hold or stand for others
NDARRAY = Name("numpy.ndarray")
ARRAY = re.compile(  # the program of an array of one or two dimensions, after RECONSTRUCT and before the array's bytes
    rb"h(.)K\x00\x85\x94h(.)\x87\x94R\x94\(K\x01(?:K(.)\x85|K(.)K(.)\x86)\x94h(.)\x89(?:C(.)|B(....))", re.DOTALL
)


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
        self.containers = 0
        self.shared: dict[int, tuple[Any, int, int]] = {}  # by id: a container that is complete, its depth and items

    def run(self, content: bytes) -> Any:
        """The object that a pickle makes. The opcodes that three quarters of a log consist of are carried out here."""
        stack, marks, memo, stream, position = self.stack, self.marks, self.memo, BytesIO(content), 0
        for _ in range(MAX_OPCODES):
            code = content[position]
            position += 1
            if code == 0x94:  # MEMOIZE
                memo[len(memo)] = stack[-1]
            elif code == 0x6A or code == 0x68:  # LONG_BINGET, BINGET
                end = position + (4 if code == 0x6A else 1)
                value = memo[int.from_bytes(content[position:end], "little")]
                if value.__class__ in HOLDING:
                    value = self.fetched(value)
                elif value.__class__ is Name:
                    value, end = self.array(content, end) if value.path == RECONSTRUCT else (value, end)
                stack.append(value)
                position = end
            elif code == 0x8C:  # SHORT_BINUNICODE, and a MEMOIZE that follows
                end = position + 1 + content[position]
                value = content[position + 1 : end].decode("utf-8", "surrogatepass")
                stack.append(value)
                position = end
                if content[end] == 0x94:
                    memo[len(memo)] = value
                    position += 1
            elif code == 0x4B:  # BININT1
                stack.append(content[position])
                position += 1
            elif code == 0x28:  # MARK
                marks.append(len(stack))
            elif code == STOP:
                break
            else:
                read, act = ACTS[code]
                argument = None
                if read is not None:
                    argument, position = read(content, position, stream)
                act(self, argument)
        else:
            raise ValueError(f"has more than {MAX_OPCODES} opcodes")
        if len(stack) != 1 or marks or position > len(content):
            raise ValueError("is not one object")
        self.measure(stack[0], 0)
        return stack[0]

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

    def put(self, key: int | None) -> None:
        self.memo[len(self.memo) if key is None else key] = self.stack[-1]

    def get(self, key: int) -> None:
        value = self.memo[key]
        self.stack.append(self.fetched(value) if type(value) in HOLDING else value)

    def fetched(self, value: Any) -> Any:
        """What a reference to an object of the memo stands for; if it is a container, it is complete from now on."""
        value = value.value if type(value) is Unbuilt else value
        if type(value) in HOLDING and id(value) not in self.shared:
            self.shared[id(value)] = (value, *self.measure(value, 0))
        return value

    # --- containers

    def measure(self, value: Any, level: int) -> tuple[int, int]:
        """(depth, items) of an object at `level` of another one: how deep it nests, and how many items it holds if all
        references are followed. What is shared was measured before, so the walk is over a tree."""
        kind, known = type(value), self.shared.get(id(value))
        if known is not None:
            depth, items = known[1:]
        elif kind not in HOLDING:
            return 0, 1
        elif level >= MAX_DEPTH:
            raise ValueError(f"nests deeper than {MAX_DEPTH} levels")
        else:
            depth, items = 1, 1 + (value.size if kind is np.ndarray else len(value))
            if kind is dict:
                items, value = items + len(value), value.values()
            elif kind is np.ndarray:
                value = value.ravel().tolist() if value.dtype.kind == "O" else ()
            for part in () if HOLDING.isdisjoint(map(type, value)) else value:
                if type(part) in HOLDING:
                    below, more = self.measure(part, level + 1)
                    depth, items = max(depth, below + 1), items + more - 1
        if level + depth > MAX_DEPTH:
            raise ValueError(f"nests deeper than {MAX_DEPTH} levels")
        if items > MAX_ITEMS:
            raise ValueError(f"stands for more than {MAX_ITEMS} items")
        return depth, items

    def count(self, containers: int) -> None:
        self.containers += containers
        if self.containers > MAX_CONTAINERS:
            raise ValueError(f"has more than {MAX_CONTAINERS} containers")

    def push(self, container: Any) -> None:
        """Push a new container."""
        self.count(1)
        self.stack.append(container)

    def growing(self, kind: type) -> Any:
        """The container on the top of the stack, which is about to take more."""
        target = self.stack[-1]
        if type(target) is not kind:
            raise ValueError(f"adds items of a {kind.__name__} to a {type(target).__name__}")
        if id(target) in self.shared:
            raise ValueError("adds to a container that is in use already")
        return target

    def make_tuple(self, parts: list[Any]) -> None:
        self.push(tuple(parts))

    def append(self, parts: list[Any]) -> None:
        self.growing(list).extend(parts)

    def add(self, parts: list[Any]) -> None:
        self.growing(set).update(as_keys(parts))

    def set_items(self, parts: list[Any]) -> None:
        if len(parts) % 2:
            raise ValueError("sets an item without a value")
        self.growing(dict).update(zip(as_keys(parts[::2]), parts[1::2], strict=True))

    def make_list(self, parts: list[Any]) -> None:
        self.push([])
        self.append(parts)

    def make_dict(self, parts: list[Any]) -> None:
        self.push({})
        self.set_items(parts)

    def make_frozenset(self, parts: list[Any]) -> None:
        self.push(frozenset(as_keys(parts)))

    # --- names and what they stand for

    def array(self, content: bytes, position: int) -> tuple[Any, int]:
        """What the name RECONSTRUCT, or the whole program of an array that begins with it, makes; and its end.

        Of a log's opcodes nearly half make arrays, always by the same program; it is carried out here at once, and
        leaves in the memo what it would opcode by opcode. Any other program is left to these.
        """
        found = ARRAY.match(content, position)
        if found is None:
            return Name(RECONSTRUCT), position
        kind, letter, one, first, second, dtype, short, long = found.groups()
        kind, letter = self.memo.get(kind[0]), self.memo.get(letter[0])
        dtype = self.memo.get(dtype[0])
        begin = found.end()
        end = begin + (short[0] if short else int.from_bytes(long, "little"))
        if kind != NDARRAY or not isinstance(dtype, Unbuilt) or content[end : end + 4] != b"\x94t\x94b":
            return Name(RECONSTRUCT), position
        shape, data = (one[0],) if one else (first[0], second[0]), content[begin:end]
        made = array_of(data, dtype.value, shape, "C")
        self.count(6)
        for each in ((0,), (kind, (0,), letter), made, shape, data, (1, shape, dtype.value, False, data)):
            self.memo[len(self.memo)] = each
        return made, end + 4

    def name(self, path: str) -> None:
        path = path.replace("__builtin__.", "builtins.", 1) if path.startswith("__builtin__.") else path
        path = path.replace("numpy.core.", "numpy._core.", 1) if path.startswith("numpy.core.") else path
        if path not in NAMES:
            raise ValueError(f"names the forbidden class {path[:200]}")
        self.stack.append(Name(path))

    def stack_global(self, _: None) -> None:
        module, name = self.pop(2)
        if type(module) is not str or type(name) is not str:
            raise ValueError("names a class that is no text")
        self.name(f"{module}.{name}")

    def reduce(self, _: None) -> None:
        function, arguments = self.pop(2)
        if not isinstance(function, Name) or type(arguments) is not tuple:
            raise ValueError("calls what is no name")
        made = called(function.path, arguments)
        if type(made) in HOLDING:
            self.push(made)
        else:
            self.stack.append(made)

    def build(self, _: None) -> None:
        target, state = self.pop(2)
        if not isinstance(target, Unbuilt) or target.value is not None:
            raise ValueError("gives a state to what has none")
        if target.dtype is not None:
            target.value = dtype_of(target.dtype, state)
            self.stack.append(target.value)
            return
        _, shape, dtype, fortran, data = state
        target.value = array_of(data, dtype, shape, "F" if fortran else "C")
        self.push(target.value)


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
    **dict.fromkeys(("PROTO", "FRAME"), lambda machine, _: None),
    **dict.fromkeys(("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"), _Machine.put),
    "GET": _Machine.get,
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


Read = Callable[[bytes, int, BytesIO], tuple[Any, int]]  # (pickle, position, the same as a stream) -> argument, its end


def _number(layout: str) -> Read:
    struct = Struct(layout)
    return lambda content, position, stream: (struct.unpack_from(content, position)[0], position + struct.size)


def _counted(layout: str) -> Read:
    """Bytes after their number."""
    struct = Struct(layout)

    def read(content: bytes, position: int, stream: BytesIO) -> tuple[bytes, int]:
        begin = position + struct.size
        end = begin + struct.unpack_from(content, position)[0]
        if end > len(content):
            raise ValueError(f"ends before the {end - begin} bytes that it announces")
        return content[begin:end], end

    return read


def _otherwise(opcode: pickletools.OpcodeInfo) -> Read:
    """By pickletools."""
    argument = opcode.arg
    assert argument is not None

    def read(content: bytes, position: int, stream: BytesIO) -> tuple[Any, int]:
        stream.seek(position)
        return argument.reader(stream), stream.tell()

    return read


def _refuse(name: str) -> Callable[[_Machine, Any], None]:
    def act(machine: _Machine, _: Any) -> None:
        raise ValueError(f"holds more than plain data ({name})")

    return act


READS: dict[str, Read] = {
    "BINFLOAT": _number(">d"),
    "BININT": _number("<i"),
    "BININT2": _number("<H"),
    "BINPUT": _number("<B"),
    "LONG_BINPUT": _number("<I"),
    "SHORT_BINBYTES": _counted("<B"),
    "BINBYTES": _counted("<I"),
    "BINBYTES8": _counted("<Q"),
}
ACTS: list[tuple[Read | None, Callable[[_Machine, Any], None]]] = [
    (None, _refuse(f"the unknown opcode {code}")) for code in range(256)
]  # by opcode
for _opcode in pickletools.opcodes:
    _read = READS.get(_opcode.name) or (_otherwise(_opcode) if _opcode.arg else None)
    ACTS[ord(_opcode.code)] = _read, ACTIONS.get(_opcode.name) or _refuse(f"opcode {_opcode.name}")
STOP = ord(pickle.STOP)
