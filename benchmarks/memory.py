"""Peak memory of the other benchmarks' work, each in a process of its own."""

import multiprocessing
import resource
from collections.abc import Iterator
from dataclasses import replace

import torch
from measure import Bench, Row
from tensordict import TensorDict

from e2rl.traffic.rollout import roll_out


def memory(bench: Bench) -> Iterator[Row]:
    """MiB at most resident: the scenes alone, 512 of them simulated, 32 rolled out against e2."""
    context, alone = multiprocessing.get_context("spawn"), 0.0
    for name, size in (("simulator", 512), ("e2 rollout", 32)):
        (batch,) = bench.batches(size)
        with context.Pool(1) as pool:
            alone, value = pool.apply(_peak, (replace(bench), name, batch))  # without what is loaded
        yield bench.row("memory", name, bench.pick(batch), value, "MiB")
    yield bench.row("memory", "scenes alone", bench.pick(1), alone, "MiB")


def _peak(bench: Bench, name: str, batch: int) -> tuple[float, float]:
    """With the scenes loaded, and after the work."""
    torch.set_num_threads(1)
    index = bench.pick(batch)
    alone = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    if name == "simulator":
        env = bench.environment(index)
        for _ in range(5):
            env._step(TensorDict({"action": torch.zeros(batch, 2)}, batch_size=[batch]))
    else:
        roll_out(bench.scenes, index, index, torch.full((batch,), 2.0), bench.ego, bench.traffic, bench.sim)
    return alone, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
