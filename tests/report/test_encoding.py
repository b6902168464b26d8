"""Whole numbers come back from their text, and smooth motion is short."""

import base64
import zlib

import numpy as np

from e2rl.report.failure_tracks import encode, quantised, second_difference


def decoded(text: str) -> np.ndarray:
    """What decode.js does."""
    planes = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8).reshape(4, -1).astype(np.uint32)
    code = sum(plane << 8 * k for k, plane in enumerate(planes))
    return (code >> 1).astype(np.int64) ^ -(code & 1).astype(np.int64)


def test_numbers_of_31_bits_come_back_whatever_their_sign():
    values = np.random.default_rng(0).integers(-(2**30), 2**30, 5000)
    edges = np.array([0, -1, 1, 2**30, -(2**30), 2**31 - 1, -(2**31)])
    for numbers in (values, edges, np.zeros(0, int)):
        np.testing.assert_array_equal(decoded(encode(numbers)), numbers)


def test_two_sums_undo_second_differences():
    values = np.random.default_rng(1).integers(-1000, 1000, (3, 4, 50))
    np.testing.assert_array_equal(second_difference(values).cumsum(-1).cumsum(-1), values)


def test_a_quantum_rounds_by_half_of_itself():
    values = np.random.default_rng(2).normal(0, 500, 1000)
    assert np.abs(quantised(values, 0.01) * 0.01 - values).max() <= 0.005 + 1e-9


def test_constant_acceleration_takes_next_to_no_bytes():
    time = np.arange(81) * 0.1
    path = quantised(1000 + 12 * time - time**2, 0.01)
    assert len(encode(second_difference(path))) < 90 < 4 * len(path)
