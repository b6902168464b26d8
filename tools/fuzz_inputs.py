"""Inputs that strangers may have written, as strategies: damaged ones, and what a
hostile author writes."""

import copy
import hashlib
import io
import os
import pickle
import pickletools
import subprocess
import zipfile
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from tests.scenes.descriptions import Malicious


class Garbage(Exception):
    """An input was read as something that it is not."""


def require(true: bool, what: str) -> None:
    if not true:
        raise Garbage(what)


LEAVES = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=20)
    | st.just("x" * 300)
)
PLAIN = st.recursive(
    LEAVES,
    lambda parts: (
        st.lists(parts, max_size=3)
        | st.dictionaries(st.text(max_size=8), parts, max_size=3)
    ),
    max_leaves=5,
)
ARRAYS = arrays.arrays(
    st.sampled_from([np.float64, np.float32, np.int64, np.bool_, np.dtype("U3")]),
    arrays.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4),
)
HOSTILE = st.sampled_from(
    [
        "os.system",
        "builtins.exec",
        "subprocess.Popen",
        "hydra.utils.call",
        "${oc.env:HOME}",
    ]
)


def damaged(content: bytes) -> st.SearchStrategy[bytes]:
    """Copies with one to six places flipped, removed, repeated or cut off."""
    place = st.integers(0, max(len(content) - 1, 0))
    kind = st.sampled_from(["flip", "flip", "flip", "remove", "repeat", "cut"])
    return st.lists(
        st.tuples(kind, place, st.integers(1, 255)), min_size=1, max_size=6
    ).map(partial(edited, content))


def edited(content: bytes, edits: list[tuple[str, int, int]]) -> bytes:
    changed = bytearray(content)
    for kind, place, number in edits:
        if kind == "flip" and place < len(changed):
            changed[place] ^= number
        elif kind == "remove":
            del changed[place : place + number]
        elif kind == "repeat":
            changed[place:place] = changed[place : place + number]
        elif kind == "cut":
            del changed[place:]
    return bytes(changed)


@st.composite
def mutated(draw: Callable, data: Any, odd: st.SearchStrategy = PLAIN) -> Any:
    """Copies of nested containers with one to three parts removed, replaced, or with
    one number changed."""
    data = copy.deepcopy(data)
    for _ in range(draw(st.integers(1, 3))):
        place = data
        parent = None
        key = None
        while (
            isinstance(place, dict | list)
            and place
            and (parent is None or draw(st.integers(0, 6)))
        ):
            parent = place
            key = draw(
                st.sampled_from(
                    sorted(place) if isinstance(place, dict) else range(len(place))
                )
            )
            place = parent[key]
        if parent is None:
            continue
        numbers = (
            isinstance(place, np.ndarray)
            and place.ndim
            and place.size
            and place.dtype.kind == "f"
        )
        if numbers and draw(st.booleans()):
            changed = place.copy()
            changed.flat[draw(st.integers(0, place.size - 1))] = draw(st.floats())
            parent[key] = draw(
                st.sampled_from(
                    [changed, place[: len(place) // 2], place * 1e3, place[..., None]]
                )
            )
        elif isinstance(parent, dict) and not draw(st.integers(0, 3)):
            del parent[key]
        else:
            parent[key] = copy.deepcopy(draw(odd))
    return data


def opcodes() -> st.SearchStrategy[bytes]:
    """Programs of random opcodes of pickle with arguments of their kinds."""
    lines = st.sampled_from(
        [
            b"1\n",
            b"-7\n",
            b"1e9\n",
            b"'x'\n",
            b"99999999999\n",
            b"os\nsystem\n",
            b"numpy\ndtype\n",
        ]
    )
    counted = st.tuples(st.sampled_from([1, 4, 8]), st.binary(max_size=16))
    counted = counted.map(
        lambda given: len(given[1]).to_bytes(given[0], "little") + given[1]
    )
    one = st.sampled_from(pickletools.opcodes).flatmap(
        lambda code: st.tuples(
            st.just(code.code.encode("latin-1")),
            st.just(b"")
            if code.arg is None
            else lines
            if code.arg.n == -1
            else counted | st.binary(max_size=8),
        ).map(b"".join)
    )
    return st.lists(one, min_size=2, max_size=40).map(
        lambda parts: b"\x80\x04" + b"".join(parts) + b"."
    )


def hostile(mark: str) -> st.SearchStrategy[bytes]:
    """Pickles that run code, claim terabytes, nest deep, or are random programs; code
    would write the file `mark`."""
    code = f"open({mark!r}, 'w').close()"
    laugh = []
    for _ in range(60):
        laugh = [laugh, laugh]
    calls = [
        (exec, code),
        (os.system, f"touch {mark}"),
        (subprocess.check_call, ["touch", mark]),
    ]
    calls += [
        (open, mark, "w"),
        (np.load, mark),
        (bytearray, 1 << 40),
        (np.zeros, (1 << 40,)),
    ]
    parts = [Malicious(*call) for call in calls]
    parts += [held for call in parts for held in ({"tracks": call}, {"a": [call, 1]})]
    running = [pickle.dumps(part, protocol) for part in parts for protocol in (0, 2, 4)]
    claiming = [
        b"\x80\x05" + name + b"\xff" * width + b"x" * 20 + b"."
        for name, width in ((b"\x8e", 8), (b"B", 4))
    ]
    nesting = [
        b"]" + b"\x85" * 200_000 + b".",
        b"(" * 200_000 + b"t" * 200_000 + b".",
        b"]q\x00h\x00a.",
    ]
    return (
        st.sampled_from([*running, *claiming, *nesting, pickle.dumps(laugh)])
        | opcodes()
    )


def stored(values: dict, save: Callable = np.savez) -> bytes:
    """The content of an npz."""
    buffer = io.BytesIO()
    save(buffer, **{name: np.asarray(value) for name, value in values.items()})
    return buffer.getvalue()


def with_program(
    whole: bytes, program: bytes, method: int = zipfile.ZIP_STORED
) -> bytes:
    """A finished part with another pickle in it, and its hash made anew; the zip's
    members deflated, if asked for."""
    begin = whole.index(b"PK")
    result = io.BytesIO()
    with (
        zipfile.ZipFile(io.BytesIO(whole[begin:])) as old,
        zipfile.ZipFile(result, "w", method) as new,
    ):
        for name in old.namelist():
            new.writestr(name, program if name.endswith("data.pkl") else old.read(name))
    return (
        whole[: begin - 32]
        + hashlib.sha256(result.getvalue()).digest()
        + result.getvalue()
    )
