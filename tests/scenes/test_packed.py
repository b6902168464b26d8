"""Packed scenes: whatever their arrays are, they come back bit for bit; damaged records are refused."""

import struct
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from e2rl.scenes.scene_cache import pack, unpack

KINDS = ("<f4", "<f2", "<f8", "<i8", "|b1")
ARRAYS = st.sampled_from(KINDS).flatmap(
    lambda kind: arrays.arrays(np.dtype(kind), arrays.array_shapes(min_dims=1, max_dims=4, min_side=0, max_side=6))
)
RECORD = pack({"x": np.arange(1000)}).record
MIDDLE = len(RECORD) // 2
DAMAGED = {
    "short": RECORD[:-5],
    "empty": b"",
    "changed": RECORD[:MIDDLE] + bytes([RECORD[MIDDLE] ^ 255]) + RECORD[MIDDLE + 1 :],
    "nonsense": b"nonsense",
    "objects": zlib.compress(struct.pack("<I", 18) + b'{"x": ["|O", [1]]}' + bytes(8)),
    "too few numbers": zlib.compress(struct.pack("<I", 19) + b'{"x": ["<f8", [2]]}' + bytes(8)),
    "another": zlib.compress(b"\x05\x00\x00\x00[1,2]"),
}


@settings(max_examples=200, deadline=None)
@given(st.dictionaries(st.text(min_size=1, max_size=5), ARRAYS, max_size=4))
def test_arrays_come_back_bit_for_bit(scene):
    packed = pack(scene)
    found = unpack(packed.record)
    assert list(found) == list(scene) and packed.layout == {k: (v.dtype.str, v.shape) for k, v in scene.items()}
    for key, value in scene.items():
        assert found[key].dtype == value.dtype and found[key].shape == value.shape
        assert found[key].tobytes() == value.tobytes() and found[key].flags.writeable
    assert unpack(memoryview(packed.record)).keys() == found.keys()


def test_the_digest_is_of_the_content():
    one, same, other = ({"x": np.arange(5.0) + shift} for shift in (0, 0, 1e-12))
    assert pack(one).digest == pack(same).digest != pack(other).digest


def test_smooth_numbers_and_padding_take_little():
    way = np.cumsum(np.full((4, 150, 2), 1.4142), axis=1).astype(np.float32)
    scene = {"route_points": np.concatenate([way, np.zeros_like(way)]), "valid": np.ones((81, 48), bool)}
    assert len(pack(scene).record) < sum(value.nbytes for value in scene.values()) / 5


@pytest.mark.parametrize("damage", DAMAGED)
def test_damaged_records_are_refused(damage):
    with pytest.raises(ValueError, match="a scene that is cut short|a damaged scene|cannot reshape"):
        unpack(DAMAGED[damage])
