"""Files of logs: a library that reads one gets no more memory than a log may take."""

import numpy as np
import pytest
import torch

from e2rl.run.cpu import configure_cpu
from e2rl.run.errors import InputError
from e2rl.scenes.log_files import bounded_memory


@pytest.mark.parametrize(
    "allocate", [np.ones, lambda size: bytearray(8 * size), lambda size: [None] * size]
)
def test_what_asks_for_more_memory_than_a_log_may_take_is_refused(allocate):
    """However much the process keeps (`configure_cpu`)."""
    configure_cpu(torch.get_num_threads())
    size = 1 << 24
    kept = [np.ones(1 << 20) for _ in range(32)]  # of 8 MiB
    del kept
    with bounded_memory(1 << 30):
        allocate(size)
    with (
        pytest.raises(
            InputError, match="more than the 67 MB of memory of a log; cut it"
        ),
        bounded_memory(1 << 26),
    ):
        allocate(size)
    allocate(size)
