"""How torch computes on the CPU: its threads, the memory that it keeps, and the library
of its products."""

import ctypes
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import torch

EXACT = 1 + 2**-12  # a float32 that bfloat16 rounds to 1
# of glibc's mallopt(3)
M_TRIM_THRESHOLD = -1
M_MMAP_THRESHOLD = -3
KEPT = 512 << 20  # bytes of freed memory that a process keeps, at most
LARGE = 32 << 20  # bytes of an allocation that is given back at once


def configure_cpu(threads: int) -> None:
    """Let torch compute with so many threads, in memory that is kept."""
    torch.set_num_threads(threads)
    keep_memory()


@contextmanager
def onednn_products() -> Iterator[None]:
    """Let products of float32 matrices in the block be oneDNN's, where it keeps their
    precision: for large products of few sizes, as each new one takes it half a
    millisecond.

    With AVX-512 on AMD, MKL takes more than twice as long. PyTorch hands float32
    products to oneDNN where it may round them to bfloat16; processors that do are left
    as they are, and machines with a GPU, whose products would be rounded.
    """
    before = torch.get_float32_matmul_precision()
    if before != "highest" or not onednn_is_exact():
        yield
        return
    torch.set_float32_matmul_precision("medium")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


@cache
def onednn_is_exact() -> bool:
    """Returns whether products of float32 stay so where they may be rounded."""
    if torch.cuda.device_count() > 0:
        return False
    before = torch.get_float32_matmul_precision()
    numbers = torch.full((64, 64), EXACT)
    torch.set_float32_matmul_precision("medium")
    try:
        return torch.equal(numbers @ torch.eye(64), numbers)
    finally:
        torch.set_float32_matmul_precision(before)


def keep_memory() -> None:
    """Let glibc keep freed memory for the next tensor: Linux clears each page that it
    hands out again, which takes a sixth of a rollout's time."""
    if library := _glibc():
        library.mallopt(M_TRIM_THRESHOLD, KEPT)
        library.mallopt(M_MMAP_THRESHOLD, LARGE)


def release_memory() -> None:
    """Give back what is kept, after much work or before a pause."""
    if library := _glibc():
        library.malloc_trim(0)


@cache
def _glibc() -> ctypes.CDLL | None:
    """The C library, where it is glibc."""
    if not sys.platform.startswith("linux"):
        return None
    library = ctypes.CDLL(None)
    return library if hasattr(library, "malloc_trim") else None
