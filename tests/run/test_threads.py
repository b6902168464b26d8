"""The library of products keeps float32, or is left as it was."""

import pytest
import torch

from e2rl.run.threads import set_threads


@pytest.fixture(autouse=True)
def precision():
    before = torch.get_float32_matmul_precision()
    threads = torch.get_num_threads()
    torch.set_float32_matmul_precision("highest")
    yield
    torch.set_float32_matmul_precision(before)
    torch.set_num_threads(threads)


def test_products_are_those_of_float32():
    set_threads(1)
    a, b = torch.randn(300, 200), torch.randn(200, 100)
    exact = a.double() @ b.double()
    assert (a @ b - exact).abs().max() < 1e-4


def test_a_processor_that_rounds_is_left_as_it_was(monkeypatch):
    monkeypatch.setattr(torch, "equal", lambda product, numbers: False)
    set_threads(1)
    assert torch.get_float32_matmul_precision() == "highest"


def test_products_of_a_gpu_are_not_rounded(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    set_threads(1)
    assert torch.get_float32_matmul_precision() == "highest"


def test_a_precision_that_somebody_chose_stays():
    torch.set_float32_matmul_precision("high")
    set_threads(1)
    assert torch.get_float32_matmul_precision() == "high"
