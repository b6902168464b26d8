"""oneDNN's products keep float32, or stay out; freed memory is kept."""

import ctypes
import resource
from pathlib import Path

import pytest
import torch

from e2rl.run.cpu import (
    configure_cpu,
    onednn_is_exact,
    onednn_products,
    release_memory,
)


@pytest.fixture
def precision():
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")
    onednn_is_exact.cache_clear()
    yield
    onednn_is_exact.cache_clear()
    torch.set_float32_matmul_precision(before)


def test_products_are_those_of_float32(precision):
    a, b = torch.randn(300, 200), torch.randn(200, 100)
    exact = a.double() @ b.double()
    with onednn_products():
        assert (a @ b - exact).abs().max() < 1e-4
    assert torch.get_float32_matmul_precision() == "highest"


def test_a_processor_that_rounds_is_left_as_it_was(precision, monkeypatch):
    monkeypatch.setattr(torch, "equal", lambda product, numbers: False)
    with onednn_products():
        assert torch.get_float32_matmul_precision() == "highest"


def test_products_of_a_gpu_are_not_rounded(precision, monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    with onednn_products():
        assert torch.get_float32_matmul_precision() == "highest"


def test_a_precision_that_somebody_chose_stays(precision):
    torch.set_float32_matmul_precision("high")
    with onednn_products():
        assert torch.get_float32_matmul_precision() == "high"
    assert torch.get_float32_matmul_precision() == "high"


glibc = pytest.mark.skipif(
    not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="the C library is not glibc"
)
COUNT = 6  # tensors of 16 MiB, which together are less than is kept


@glibc
def test_freed_memory_is_used_again():
    configure_cpu(torch.get_num_threads())
    pages = []
    for _ in range(3):
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        tensors = [torch.ones(1 << 22) for _ in range(COUNT)]
        del tensors
        pages.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
    assert pages[-1] < COUNT * (1 << 24) / resource.getpagesize() / 4


@glibc
def test_what_is_kept_is_given_back_when_released():
    configure_cpu(torch.get_num_threads())
    tensors = [torch.ones(1 << 22) for _ in range(COUNT)]
    del tensors
    kept = resident()
    release_memory()
    assert kept - resident() > COUNT * (1 << 24) / 2


def resident():
    """Bytes of this process in memory."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize()
