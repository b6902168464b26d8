"""Pickles of plain data: what `pickle` would read comes out, whatever else a file
names is refused."""

import collections
import os
import pickle
import struct

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
from e2rl.scenes.log_files import bounded_memory
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
        ours = np.asarray(ours, theirs.dtype)
        alike = ours.shape == theirs.shape
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
    "bytes": b"\x80\x05\x8e" + struct.pack("<Q", 5 * 10**9) + b"x.",
    "bytearray": b"\x80\x05\x96" + struct.pack("<Q", 5 * 10**9) + b"x.",
    "bytearray of a length": b"\x80\x04cbuiltins\nbytearray\n" + HUGE + b"\x85R.",
    "bytes of a length": b"\x80\x04cbuiltins\nbytes\n" + HUGE + b"\x85R.",
    "memo": b"\x80\x04Nr\xff\xff\xff\x7f}.",
    "ndarray of a shape": b"\x80\x04cnumpy\nndarray\n" + HUGE + b"\x85\x85R.",
    "array of a shape": array(HUGE + b"\x85", b"f8", data=b"C\x08" + bytes(8)) + b".",
    "array longer than its bytes": array(b"K\x09\x85", b"f8", data=b"C\x08" + bytes(8))
    + b".",
    "array of pointers": array(b"K\x01\x85", b"O", data=b"C\x08" + b"A" * 8) + b".",
    "dtype of structures": array(b"K\x01\x85", b"O,O", data=b"C\x10" + b"A" * 16)
    + b".",
    "dtype of void": array(b"K\x01\x85", b"V8", data=b"C\x08" + bytes(8)) + b".",
    "marks": b"(" * 10_000 + b".",
    "persistent": b"\x80\x04}Q.",
    "extension": b"\x80\x04\x82\x01.",
    "instance": b"(i__main__\nx\n.",
    "buffer": b"\x80\x05\x97.",
    "nothing": b"",
    "no end": b"\x80\x04}",
    "frame of no length": b"\x80\x04}\x95\x01",
}


@pytest.mark.parametrize("name", ATTACKS)
def test_what_asks_for_memory_or_is_no_plain_data_is_refused(name):
    with (
        pytest.raises(InputError, match=r"^made\.pkl: cannot be read: "),
        bounded_memory(),
    ):
        safe_load(ATTACKS[name], "made.pkl")


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


def test_a_type_of_structures_by_its_state_stays_one_of_plain_elements():
    """numpy itself would take the fields and flags of a file for those of its type."""
    state = b"(K\x03U\x01<N)}K\x08K\x08K\x00t"
    content = array(b"K\x01\x85", b"f8", data=b"C\x08" + bytes(8), state=state) + b"."
    assert load_plain(content).dtype == np.dtype("f8")


def test_more_tuples_than_a_log_has_are_refused():
    with pytest.raises(ValueError, match="more than 100,000 tuples"):
        load_plain(pickle.dumps([(number,) for number in range(100_001)]))


def test_bytes_that_look_like_tuples_are_none():
    content = {"values": np.full(200_000, ord("t"), np.uint8)}
    read = load_plain(pickle.dumps(content))
    np.testing.assert_array_equal(read["values"], content["values"])
