"""One training process, or several started by torchrun, of which the leader validates
and writes."""

import contextlib
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from e2rl.run.errors import InputError

Value = TypeVar("Value")
TIMEOUT = timedelta(
    hours=6
)  # the others wait while the leader parses logs or validates


@dataclass(frozen=True)
class Processes:
    """This process, `rank`, among `count` that train together.

    Every method but `leader` is collective: all processes call it in the same order.
    With count 1 nothing is sent.
    """

    rank: int = 0
    count: int = 1

    @property
    def leader(self) -> bool:
        """Whether this process prints, validates and writes (rank 0)."""
        return self.rank == 0

    def mean(self, value: Tensor) -> Tensor:
        """The mean of a tensor over the processes, without gradient."""
        if self.count == 1:
            return value.detach()
        total = value.detach().clone()
        dist.all_reduce(total)
        return total / self.count

    def gather(self, value: Value) -> list[Value]:
        """The (pickled) values of all processes, by rank."""
        values = [value] * self.count
        if self.count > 1:
            dist.all_gather_object(values, value)
        return values

    def from_leader(self, work: Callable[[], Value]) -> Value:
        """The leader's result of `work()`, in every process; an InputError of the
        leader is raised in all."""
        if self.count == 1:
            return work()
        result: list = [None, None]
        if self.leader:
            try:
                result[0] = work()
            except InputError as error:
                result[1] = str(error)
        dist.broadcast_object_list(result)
        if result[1] is not None:
            raise InputError(result[1])
        return result[0]

    def leader_first(self, work: Callable[[], Value]) -> Value:
        """`work()` in every process, first in the leader, whose cached files the others
        then read."""
        results: list[Value] = []
        self.from_leader(lambda: results.append(work()))
        return results[0] if self.leader else work()


ALONE = Processes()


@contextmanager
def process_group(device: str) -> Iterator[tuple[Processes, str]]:
    """(processes, this process's device): the processes started by torchrun, or this
    process alone.

    They communicate over gloo on the CPU and NCCL on GPUs, one GPU each. Only the
    leader prints. Raises InputError for more processes than GPUs.
    """
    if not started_by_torchrun():
        yield ALONE, device
        return
    on_gpu = device.startswith("cuda")
    local = int(os.environ["LOCAL_RANK"])
    count = int(os.environ["LOCAL_WORLD_SIZE"])
    if on_gpu:
        gpus = torch.cuda.device_count()
        if count > gpus:
            raise InputError(
                f"torchrun --nproc_per_node={count}: this machine has {gpus} GPUs; "
                f"start at most {gpus}"
            )
        device = f"cuda:{local}"
        torch.cuda.set_device(local)
    dist.init_process_group("nccl" if on_gpu else "gloo", timeout=TIMEOUT)
    processes = Processes(dist.get_rank(), dist.get_world_size())
    try:
        with contextlib.ExitStack() as stack:
            if not processes.leader:
                devnull = stack.enter_context(open(os.devnull, "w"))
                stack.enter_context(contextlib.redirect_stdout(devnull))
                stack.enter_context(contextlib.redirect_stderr(devnull))
            yield processes, device
        dist.barrier()  # nobody leaves while another still talks to it
    finally:
        dist.destroy_process_group()


def started_by_torchrun() -> bool:
    """Whether this is one of torchrun's processes."""
    return dist.is_available() and dist.is_torchelastic_launched()


def follows() -> bool:
    """Whether this is one of torchrun's processes other than the leader."""
    return started_by_torchrun() and os.environ["RANK"] != "0"


def follower_overrides() -> list[str]:
    """Hydra overrides for processes other than the leader: no run folder, no log."""
    if not follows():
        return []
    return [
        "hydra.run.dir=.",
        "hydra.output_subdir=null",
        f"hydra.job_logging.handlers.file.filename={os.devnull}",
    ]
