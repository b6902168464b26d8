"""Peak memory of the other benchmarks' work, each in a process of its own."""

import multiprocessing
import resource
from collections.abc import Iterator

import torch
from measure import Bench, Row
from tensordict import TensorDict

from e2rl.synthesizer.rollout import roll_out


def memory(bench: Bench) -> Iterator[Row]:
    """MiB at most resident: the scenes alone, 512 of them simulated, 32 rolled out against e2."""
    for name, batch in (("scenes alone", 1), ("simulator", 512), ("e2 rollout", 32)):
        context = multiprocessing.get_context("spawn")
        with context.Pool(1) as pool:
            value = pool.apply(_peak, (bench.data, bench.checkpoint, name, batch))
        yield bench.row("memory", name, bench.pick(batch), value, "MiB")


def _peak(data: str | None, checkpoint: str, name: str, batch: int) -> float:
    torch.set_num_threads(1)
    bench = Bench(data, checkpoint, repeats=1)
    index = bench.pick(batch)
    if name == "simulator":
        env = bench.environment(index)
        for _ in range(5):
            env._step(TensorDict({"action": torch.zeros(batch, 2)}, batch_size=[batch]))
    elif name == "e2 rollout":
        roll_out(bench.scenes, index, index, torch.full((batch,), 2.0), bench.ego, bench.synthesizer, bench.sim)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
