"""Arrays of whole numbers as short text, which a browser decodes without a library (e2rl/assets/report/decode.js).

Smooth motion has small second differences, whose upper bytes are zero; deflate makes next to nothing of them.
"""

import base64
import zlib

import numpy as np


def quantised(values: np.ndarray, quantum: float | np.ndarray) -> np.ndarray:
    """Values as int64 multiples of a quantum; they must fit into 29 bits, so that second differences fit into 31."""
    return np.rint(np.asarray(values, np.float64) / quantum).astype(np.int64)


def second_difference(values: np.ndarray) -> np.ndarray:
    """Second difference along the last axis, with zeros before the first value: two cumulative sums undo it."""
    ahead = [(0, 0)] * (values.ndim - 1) + [(2, 0)]
    return np.diff(np.pad(values, ahead), n=2, axis=-1)


def encode(values: np.ndarray) -> str:
    """Whole numbers in C order as base64 of zlib of their zigzag code, uint32, all lowest bytes first."""
    flat = np.asarray(values, np.int64).ravel()
    zigzag = ((flat << 1) ^ (flat >> 63)).astype("<u4")
    planes = zigzag.view(np.uint8).reshape(-1, 4).T
    return base64.b64encode(zlib.compress(planes.tobytes(), 9)).decode()
