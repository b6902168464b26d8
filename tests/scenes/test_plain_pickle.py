"""Pickles of plain data: what `pickle` would read comes out, whatever else a file says
is refused, at bounded cost."""

import collections
import os
import pickle
import struct
import tracemalloc

import numpy as np
import pytest
from hypothesis import (
    example,
    given,
    settings,
)
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from e2rl.run.errors import InputError
from e2rl.scenes import plain_pickle
from e2rl.scenes.plain_pickle import load_plain
from e2rl.scenes.scenarionet import safe_load
from tests.scenes.descriptions import Malicious


def objects(parts: list) -> np.ndarray:
    array_of_parts = np.empty(len(parts), object)
    for index, part in enumerate(parts):
        array_of_parts[index] = part
    return array_of_parts


ARRAYS = arrays.arrays(
    st.one_of(
        arrays.boolean_dtypes(),
        *(
            kind(endianness="?")
            for kind in (
                arrays.integer_dtypes,
                arrays.floating_dtypes,
                arrays.unicode_string_dtypes,
            )
        ),
    ),
    arrays.array_shapes(
        min_dims=0,
        max_dims=3,
        min_side=0,
        max_side=4,
    ),
)
LEAVES = st.one_of(
    *(
        st.none(),
        st.booleans(),
        st.floats(),
        st.integers(-(2**63), 2**63),
        st.text(),
        st.binary(),
    ),
    *(
        st.complex_numbers(),
        st.sets(st.text()),
        st.frozensets(st.integers(0, 9)),
        st.binary().map(bytearray),
        ARRAYS,
    ),
)
PLAIN = st.recursive(
    LEAVES,
    lambda parts: st.one_of(
        *(st.lists(parts), st.tuples(parts, parts), st.dictionaries(st.text(), parts)),
        st.dictionaries(st.integers(0, 9), parts).map(
            lambda data: collections.defaultdict(list, data)
        ),
        st.lists(parts, max_size=3).map(objects),
    ),
    max_leaves=12,
)


def same(ours, theirs) -> bool:
    """Whether two pieces of plain data are equal, bit for bit."""
    if isinstance(theirs, np.ndarray):
        theirs = theirs.astype(theirs.dtype.newbyteorder("="))
        alike = isinstance(ours, np.ndarray) and (ours.shape, ours.dtype) == (
            theirs.shape,
            theirs.dtype,
        )
        if theirs.dtype == object:
            return alike and all(map(same, ours.ravel(), theirs.ravel()))
        return alike and ours.tobytes() == theirs.tobytes()
    if isinstance(theirs, list | tuple):
        return (
            type(ours) is type(theirs)
            and len(ours) == len(theirs)
            and all(map(same, ours, theirs))
        )
    if isinstance(theirs, dict):
        return list(ours) == list(theirs) and all(
            same(ours[key], theirs[key]) for key in theirs
        )
    return ours == theirs or repr(ours) == repr(theirs)  # NaN


@settings(
    max_examples=150,
    deadline=None,
)
@given(PLAIN, st.integers(0, 5))
@example(np.asfortranarray(np.arange(6).reshape(2, 3)), 2)
@example(np.moveaxis(np.arange(24).reshape(2, 3, 4), 0, 1), 5)
@example(np.asfortranarray(np.array([[1, None], ["a", 2.0]], object)), 4)
@example([np.float32(2.5), np.bool_(True), np.str_("LANE"), np.int64(-3)], 0)
def test_plain_data_of_every_protocol_is_what_pickle_reads(data, protocol):
    content = pickle.dumps(data, protocol)
    assert same(load_plain(content), pickle.loads(content))


def deep_tuple(depth: int) -> bytes:
    return b"\x80\x04N" + b"\x85" * depth


def doubling(levels: int) -> bytes:
    """Lists that each hold the one before it ten times: 10^levels items in a few bytes."""
    step = b"]q\x01(" + b"h\x00" * 10 + b"e" + b"q\x00"
    return b"\x80\x02]q\x00" + step * levels


ARRAY = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(K\x00tC\x01btR"


def array(
    shape: bytes,
    dtype: bytes,
    data: bytes,
    state: bytes = b"(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00t",
) -> bytes:
    return (
        b"\x80\x03"
        + ARRAY
        + b"(K\x01"
        + shape
        + b"cnumpy\ndtype\n(U"
        + bytes([len(dtype)])
        + dtype
        + b"\x89\x88tR"
        + state
        + b"b\x89"
        + data
        + b"tb"
    )


HUGE = b"\x8a\x05" + (5 * 10**9).to_bytes(5, "little")
ATTACKS = {
    "nested": deep_tuple(200_000) + b".",
    "nested key": b"\x80\x04}" + deep_tuple(200_000)[2:] + b"Ns.",
    "nested lists": b"\x80\x04" + b"]" * 100_000 + b"a" * 99_999 + b".",
    "doubling": doubling(12) + b".",
    "itself": b"\x80\x04]q\x00h\x00a.",
    "itself by a tuple": b"\x80\x04]q\x00h\x00\x85a.",
    "later": b"\x80\x04]q\x00]q\x010h\x00h\x01ah\x01h\x00a.",
    "bytes": b"\x80\x05\x8e" + struct.pack("<Q", 5 * 10**9) + b"x.",
    "bytearray": b"\x80\x05\x96" + struct.pack("<Q", 5 * 10**9) + b"x.",
    "bytearray of a length": b"\x80\x04cbuiltins\nbytearray\n" + HUGE + b"\x85R.",
    "bytes of a length": b"\x80\x04cbuiltins\nbytes\n" + HUGE + b"\x85R.",
    "memo": b"\x80\x04Nr\xff\xff\xff\x7f}.",
    "ndarray of a shape": b"\x80\x04cnumpy\nndarray\n" + HUGE + b"\x85\x85R.",
    "array of a shape": array(HUGE + b"\x85", b"f8", data=b"C\x08" + bytes(8)) + b".",
    "array of no bytes": array(HUGE + b"K\x00\x86", b"f8", data=b"C\x00") + b".",
    "array longer than its bytes": array(b"K\x09\x85", b"f8", data=b"C\x08" + bytes(8))
    + b".",
    "array of pointers": array(b"K\x01\x85", b"O", data=b"C\x08" + b"A" * 8) + b".",
    "dtype with fields": array(
        b"K\x01\x85",
        b"f8",
        data=b"C\x08" + bytes(8),
        state=b"(K\x03U\x01<N)}K\x08K\x08K\x00t",
    )
    + b".",
    "dtype of structures": array(b"K\x01\x85", b"O,O", data=b"C\x10" + b"A" * 16)
    + b".",
    "dtype of void": array(b"K\x01\x85", b"V8", data=b"C\x08" + bytes(8)) + b".",
    "text beyond Unicode": array(b"K\x01\x85", b"U1", data=b"C\x04" + b"\xff" * 4)
    + b".",
    "unbuilt": b"\x80\x03" + ARRAY + b"}" + b"\x94.",
    "number of a megabyte": b"\x80\x04\x8b"
    + struct.pack("<I", 10**6)
    + b"\x7f" * 10**6
    + b".",
    "marks": b"(" * 10_000 + b".",
    "persistent": b"\x80\x04}Q.",
    "extension": b"\x80\x04\x82\x01.",
    "instance": b"(i__main__\nx\n.",
    "new": b"\x80\x04cbuiltins\ndict\n)\x81.",
    "buffer": b"\x80\x05\x97.",
    "nothing": b"",
    "no end": b"\x80\x04}",
    "frame of no length": b"\x80\x04}\x95\x01",
}


@pytest.mark.parametrize("name", ATTACKS)
def test_what_attacks_a_reader_is_refused_and_builds_nothing(name):
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=r"^made\.pkl: cannot be read: "):
            safe_load(ATTACKS[name], "made.pkl")
        assert tracemalloc.get_traced_memory()[1] < 5e7
    finally:
        tracemalloc.stop()


def by_name(module: str, name: str) -> bytes:
    parts = (b"\x8c" + bytes([len(part)]) + part.encode() for part in (module, name))
    return b"\x80\x04" + b"".join(parts) + b"\x93."


def test_forbidden_classes_are_refused_by_name_and_never_run(tmp_path):
    mark = tmp_path / "ran.npy"
    calls = (
        (os.system, f"touch {mark}"),
        (open, str(mark), "w"),
        (eval, f"open({str(mark)!r}, 'w')"),
        (np.load, str(mark)),
    )
    calls += (
        (os.mkdir, str(mark)),
        (np.save, str(mark), 1),
        (getattr, "a", "upper"),
        (collections.OrderedDict,),
    )
    contents = [
        pickle.dumps({"x": Malicious(*call)}, protocol)
        for call in calls
        for protocol in range(6)
    ]
    names = [
        "numpy ndarray.tofile",
        "numpy fromfile",
        "numpy.core.multiarray fromfile",
        "numpy.testing dtype",
    ]
    names += [
        "builtins eval",
        "builtins getattr",
        "collections namedtuple",
        "numpy.core multiarray",
        "numpy_core x",
    ]
    for content in contents + [by_name(*name.split()) for name in names]:
        with pytest.raises(
            InputError, match=r"made\.pkl: cannot be read: names the forbidden class"
        ):
            safe_load(content, "made.pkl")
    assert not mark.exists()


@pytest.mark.parametrize("protocol", [3, 4, 5])
def test_arrays_of_both_numpys_are_read(protocol):
    held = {
        "a": np.arange(6.0).reshape(2, 3),
        "b": np.float32(2.5),
        "c": np.array(["x", None], object),
    }
    old = new = pickle.dumps(held, protocol)
    for name in (b"numpy._core.multiarray", b"numpy._core.numeric"):
        shorter = name.replace(b"_core", b"core")
        if protocol > 3:  # its length stands before it
            name = bytes([len(name)]) + name
            shorter = bytes([len(shorter)]) + shorter
        old = old.replace(name, shorter)
    old = (
        old[:2] + old[11:] if old[2:3] == b"\x95" else old
    )  # without the frame, whose length changed
    assert old != new
    assert b"numpy._core" not in old
    for content in (new, old):
        assert all(
            np.array_equal(value, held[key])
            for key, value in safe_load(content, "made.pkl").items()
        )


def test_limits_stop_long_programs(monkeypatch):
    monkeypatch.setattr(plain_pickle, "MAX_OPCODES", 100)
    with pytest.raises(ValueError, match="more than 100 opcodes"):
        load_plain(pickle.dumps(list(range(200)), 0))
    monkeypatch.setattr(plain_pickle, "MAX_CONTAINERS", 10)
    with pytest.raises(ValueError, match="more than 10 containers"):
        load_plain(pickle.dumps([[] for _ in range(11)]))


def test_bytes_that_are_no_truth_values_count_as_true():
    flags = load_plain(array(b"K\x03\x85", b"b1", data=b"C\x03\x00\x01\x07") + b".")
    assert flags.tolist() == [False, True, True]
    assert flags.view(np.uint8).tolist() == [
        0,
        1,
        1,
    ]
