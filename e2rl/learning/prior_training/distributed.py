"""One process, or several that torchrun starts: who writes, how gradients and figures are averaged, who goes first."""

import contextlib
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import TypeVar

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from e2rl.errors import InputError

Value = TypeVar("Value")
PATIENCE = timedelta(hours=6)  # the others wait while the leader parses logs or validates


@dataclass(frozen=True)
class Processes:
    """This process among those that train together: `rank` of `count`. Every method but `leader` is collective: all
    processes call it in the same order. Alone (count 1) none communicates."""

    rank: int = 0
    count: int = 1

    @property
    def leader(self) -> bool:
        """The one process that prints, validates and writes."""
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
        """What `work()` returns in the leader, in every process; its InputError is everybody's."""
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
        """`work()` of every process, the leader's first: what it caches the others only read."""
        mine: list[Value] = []
        self.from_leader(lambda: mine.append(work()))
        return mine[0] if self.leader else work()

    def same(self, module: nn.Module) -> None:
        """The leader's parameters and buffers in every process."""
        if self.count > 1:
            for value in module.state_dict().values():
                dist.broadcast(value, 0)

    def averaging(self, module: nn.Module) -> nn.Module:
        """The module, its gradients averaged over the processes by every backward pass."""
        # Its buffers are statistics of the windows, which are the same everywhere.
        return module if self.count == 1 else DistributedDataParallel(module, broadcast_buffers=False)


ALONE = Processes()


@contextmanager
def joined(device: str) -> Iterator[tuple[Processes, str]]:
    """(processes, this process's device): those that torchrun started, over gloo on the CPU and NCCL on GPUs (one GPU
    a process), or this one alone. The others than the leader keep silent inside."""
    if not started_by_torchrun():
        yield ALONE, device
        return
    local, here = int(os.environ["LOCAL_RANK"]), int(os.environ["LOCAL_WORLD_SIZE"])
    on_gpu = device.startswith("cuda")
    if on_gpu:
        if here > torch.cuda.device_count():
            raise InputError(
                f"torchrun --nproc_per_node={here}: this machine has {torch.cuda.device_count()} GPUs; "
                "start at most one process for each"
            )
        device = f"cuda:{local}"
        torch.cuda.set_device(local)
    dist.init_process_group("nccl" if on_gpu else "gloo", timeout=PATIENCE)
    processes = Processes(dist.get_rank(), dist.get_world_size())
    try:
        with contextlib.nullcontext() if processes.leader else _silent():
            yield processes, device
    finally:
        dist.destroy_process_group()


@contextmanager
def _silent() -> Iterator[None]:
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere):
        yield


def started_by_torchrun() -> bool:
    """Whether this is one of torchrun's processes."""
    return dist.is_available() and dist.is_torchelastic_launched()


def follower_overrides() -> list[str]:
    """Hydra overrides with which a process other than the leader makes no run folder and no log of its own."""
    if not started_by_torchrun() or os.environ["RANK"] == "0":
        return []
    return ["hydra.run.dir=.", "hydra.output_subdir=null", f"hydra.job_logging.handlers.file.filename={os.devnull}"]
