"""Damage for the fuzzer: of bytes, of nested values, and pickles that a stranger might write."""

import copy
import hashlib
import io
import json
import pickle
import pickletools
import random
import re
import struct
import zipfile
from typing import Any

import numpy as np

from e2rl.run.parts import HASHED

ODD = [
    *(None, True, -1, 0, 2**63, 1e9, 1e300, float("nan"), float("inf"), "", "x" * 300, b"\0", [], {}, (), [[]], [None]),
    *(np.zeros(0), np.zeros((0, 3)), np.zeros((91, 1)), np.full((91, 3), np.nan), np.full(91, 1e9), np.array("x")),
    *(np.array([None, 1], object), np.arange(91)[::-1], np.ones((91, 3), bool), np.array(["a", "b"]), {"a": {"b": []}}),
]
PLAIN = [odd for odd in ODD if isinstance(odd, None | bool | int | float | str | list | dict)]
ARRAYS = [odd for odd in ODD if isinstance(odd, float | str | np.ndarray) and np.asarray(odd).dtype.kind != "O"]


def damaged(content: bytes, draw: random.Random) -> bytes:
    """Bytes with some flipped, removed, repeated, or cut off."""
    changed = bytearray(content)
    for _ in range(draw.randint(1, 6)):
        where = draw.randrange(max(1, len(changed)))
        if draw.random() < 0.7 and changed:
            changed[where] = draw.randrange(256)
        elif draw.random() < 0.5:
            del changed[where : where + draw.randint(1, 64)]
        else:
            changed[where:where] = changed[where : where + draw.randint(1, 64)]
    return bytes(changed[: draw.randint(1, max(1, len(changed)))] if draw.random() < 0.2 else changed)


def mutated(data: Any, draw: random.Random, odd: list | None = None) -> Any:
    """A copy of nested containers with one to three parts removed, replaced by odd ones, or with a changed number."""
    data, odd = copy.deepcopy(data), ODD if odd is None else odd
    for _ in range(draw.randint(1, 3)):
        place, key = data, None
        while isinstance(place, dict | list) and place:
            parent, key = place, draw.choice(list(place) if isinstance(place, dict) else range(len(place)))
            place = parent[key]
            if draw.random() < 0.15:
                break
        if key is None:
            continue
        if (
            isinstance(place, np.ndarray)
            and place.ndim
            and place.size
            and place.dtype.kind == "f"
            and draw.random() < 0.6
        ):
            changed = place.copy()
            changed.flat[draw.randrange(place.size)] = draw.choice([np.nan, np.inf, 1e9, -1e300, 1e6, 0.0])
            parent[key] = draw.choice([changed, place[: len(place) // 2], place * 1e3, place[..., None], -place])
        elif draw.random() < 0.3 and isinstance(parent, dict):
            del parent[key]
        else:
            parent[key] = copy.deepcopy(draw.choice(odd))
    return data


class Calls:
    """Pickled, a call of something that a log must not call; `mark` is written by it."""

    def __init__(self, draw: random.Random, mark: str) -> None:
        code = f"open({mark!r}, 'w').close()"
        self.call = draw.choice(
            [
                (exec, (code,)),
                (eval, (f"open({mark!r}, 'w')",)),
                (__import__("os").system, (f"touch {mark}",)),
                (__import__("subprocess").check_call, (["touch", mark],)),
                (np.load, (mark,)),
                (getattr, ([], "append")),
                (open, (mark, "w")),
                (np.memmap, (mark, "uint8", "w+", 0, (8,))),
                (bytearray, (1 << 40,)),
                (list, (range(1 << 40),)),
                (np.zeros, ((1 << 40,),)),
            ]
        )

    def __reduce__(self) -> tuple:
        return self.call


def hostile_pickle(draw: random.Random, mark: str) -> bytes:
    """A pickle that runs code, claims much, nests deep, or is a program of random opcodes."""
    makers = [_running, _claiming, _nesting, _forged, *[_random_program] * 4]
    return draw.choice(makers)(draw, mark)


def _running(draw: random.Random, mark: str) -> bytes:
    inside = draw.choice([Calls(draw, mark), {"tracks": Calls(draw, mark)}, {"a": [Calls(draw, mark), 1]}])
    return pickle.dumps(inside, draw.randrange(6))


def _claiming(draw: random.Random, mark: str) -> bytes:
    size = draw.choice([2**20, 2**31 - 1, 2**32 - 1, 2**40, 2**62, 2**64 - 1])
    name = draw.choice(["BINBYTES8", "BINUNICODE8", "BYTEARRAY8", "FRAME", "LONG4", "BINBYTES", "BINUNICODE"])
    code = getattr(pickle, name)
    width = "<Q" if name.endswith("8") or name == "FRAME" else "<I"
    return b"\x80\x05" + code + struct.pack(width, size % 2 ** (64 if width == "<Q" else 32)) + b"x" * 20 + b"."


def _nesting(draw: random.Random, mark: str) -> bytes:
    depth = draw.choice([10, 1000, 200_000])
    return draw.choice(
        [
            b"]" + b"\x85" * depth + b".",  # tuples
            b"]" * depth + b"a" * (depth - 1) + b".",
            b"}" + b"(K\x01" * depth + b"d" * depth + b".",
            b"(" * depth + b"t" * depth + b".",
            b"}K\x01" + b")" + b"\x85" * depth + b"s" + b"K\x02s.",  # a deep key
            pickle.dumps(LAUGH, draw.choice([2, 4])),
            b"]q\x00h\x00a.",  # itself
        ]
    )


LAUGH: list = []  # twice as many items each time
for _ in range(60):
    LAUGH = [LAUGH, LAUGH]


def _forged(draw: random.Random, mark: str) -> bytes:
    """An array whose type, shape or data are not what they say."""
    content = bytearray(pickle.dumps(draw.choice(FORGED), draw.choice([2, 4])))
    kinds = [b"f8", b"O8", b"V8", b"U4", b"b1", b"i8", b"M8", b"S3"]
    for old in kinds[:1] + kinds[5:6]:
        at = bytes(content).find(old)
        if at > 0:
            content[at : at + 2] = draw.choice(kinds)
    for _ in range(draw.randint(0, 3)):
        content[draw.randrange(len(content))] = draw.randrange(256)
    return bytes(content)


FORGED = [np.arange(6.0), np.arange(6).reshape(2, 3), np.array(["ab", "c"]), np.array([None, {}], object)]


def _random_program(draw: random.Random, mark: str) -> bytes:
    """Opcodes in any order, with arguments of their kinds."""
    names = ["__builtin__ list", "numpy dtype", "numpy.core.multiarray _reconstruct", "numpy ndarray", "os system"]
    parts = [b"\x80\x04"] * (draw.random() < 0.5)
    for _ in range(draw.randint(2, 40)):
        opcode = draw.choice(pickletools.opcodes)
        parts.append(opcode.code.encode("latin-1"))
        if opcode.arg is None:
            continue
        kind, small = opcode.arg.name, draw.choice([0, 1, 2, 3, 8, 255])
        if kind == "stringnl_noescape_pair":
            parts.append(draw.choice(names).replace(" ", "\n").encode() + b"\n")
        elif kind.endswith("nl") or "nl_" in kind or kind.startswith(("decimalnl", "floatnl")):
            parts.append(draw.choice([b"1\n", b"-7\n", b"1e9\n", b"'x'\n", b"99999999999\n", b"I\n"]))
        elif opcode.arg.n >= 0:
            parts.append(small.to_bytes(opcode.arg.n, "little"))
        else:
            width = {"1": 1, "4": 4, "8": 8}.get(kind[-1], 4)
            parts.append(small.to_bytes(width, "little") + bytes(draw.randrange(256) for _ in range(small % 16)))
    return b"".join([*parts, b"."])


def with_other_number(content: bytes, draw: random.Random) -> bytes:
    """Text in which one to three numbers are others."""
    places = [found.span() for found in re.finditer(rb"-?\d+\.?\d*", content)]
    for begin, end in sorted(draw.sample(places, min(len(places), draw.randint(1, 3))), reverse=True):
        other = draw.choice([b"nan", b"1e9", b"-1", b"0", b"1e400", b"inf", b"99999999999", b"", b"3.5"])
        content = content[:begin] + other + content[end:]
    return content


def torch_file(content: bytes, draw: random.Random, mark: str) -> bytes:
    """A file of torch.save, perhaps after a hash of it: damaged, or with another pickle inside and its own hash."""
    if draw.random() < 0.6:
        return damaged(content, draw)
    if content.startswith(HASHED):
        other = torch_file(content[len(HASHED) + 32 :], draw, mark)
        return HASHED + hashlib.sha256(other).digest() + other
    result = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(result, "w") as new:
        for name in old.namelist():
            other = hostile_pickle(draw, mark) if name.endswith("data.pkl") else old.read(name)
            new.writestr(name, other)
    return result.getvalue()


def sealed(content: bytes) -> bool:
    """Whether a file of `torch_file` begins with the hash of the rest."""
    begin = len(HASHED) + 32
    return content[len(HASHED) : begin] == hashlib.sha256(content[begin:]).digest()


def with_header(content: bytes, length: int, draw: random.Random) -> bytes:
    """A safetensors file with another header."""
    header = json.loads(content[8 : 8 + length])
    about = header.get("__metadata__", {})
    for key in [key for key in about if about[key].startswith("{")][:1]:
        if draw.random() < 0.7:
            odd = [*PLAIN, 2**31, 10**6, -5, 0.5]
            about[key] = json.dumps(mutated(json.loads(about[key]), draw, odd))
            about.pop("sha256", None)  # as a stranger would
    changed = mutated(header, draw, PLAIN) if draw.random() < 0.4 else header
    text = json.dumps(changed).encode()
    text += b" " * (-len(text) % 8)
    return struct.pack("<Q", len(text)) + text + content[8 + length :]
