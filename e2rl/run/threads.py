"""How torch computes on the CPU: its threads, and the library of its products."""

import torch

EXACT = 1 + 2**-12  # a float32 that bfloat16 rounds to 1


def set_threads(count: int) -> None:
    """Let torch compute with so many threads, and products of matrices by oneDNN.

    With AVX-512 on AMD, MKL takes more than twice as long. PyTorch hands float32
    products to oneDNN where it may round them to bfloat16; processors that do are left
    as they are, and machines with a GPU, whose products would be rounded.
    """
    torch.set_num_threads(count)
    before = torch.get_float32_matmul_precision()
    if before != "highest" or torch.cuda.device_count() > 0:
        return
    torch.set_float32_matmul_precision("medium")
    numbers = torch.full((64, 64), EXACT)
    if not torch.equal(numbers @ torch.eye(64), numbers):
        torch.set_float32_matmul_precision(before)
