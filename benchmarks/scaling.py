"""What a scene costs as there are more of them, in time and memory, and what a second
process brings."""

import multiprocessing
import resource
import time
from collections.abc import Iterator
from dataclasses import replace

import torch
from measure import Bench, Row
from tensordict import TensorDict

from e2rl.run.cpu import configure_cpu
from e2rl.run.processes import in_processes

SCENES = 64, 512, 2048, 10_000
STEPS = 20
CHUNK = 64  # scenes simulated at once: memory does not grow with their number
ROLLOUTS = 64
AT_ONCE = 16


def scaling(bench: Bench) -> Iterator[Row]:
    """Microseconds a scene and step, and MiB at most resident, at 64 to 10,000 scenes
    (the data's, repeated); rollouts under e2 by one process and by two."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        for count in bench.batches(*SCENES):
            spent, peak = pool.apply(_chunks, (replace(bench), count))
            index = bench.pick(count)
            name = f"simulator in chunks of {CHUNK}, resets included"
            yield bench.row(
                "scaling", name, index, 1e6 * spent / count / STEPS, "us/scene and step"
            )
            yield bench.row("scaling", name, index, peak, "MiB")
    (count,) = bench.batches(ROLLOUTS)
    parts = bench.pick(count).split(min(AT_ONCE, -(-count // 2)))
    seconds = {}

    def work(index: torch.Tensor) -> None:
        eta = torch.full((len(index),), 2.0)
        bench.roll_out(index, eta)

    work(parts[0])
    for processes in (1, 2, 1, 2):  # in turn: the machine's load changes
        begin = time.perf_counter()
        list(in_processes(work, parts, processes=processes, cost=len))
        seconds[processes] = min(
            time.perf_counter() - begin, seconds.get(processes, torch.inf)
        )
    for processes, spent in seconds.items():
        yield bench.row(
            "scaling",
            "e2, eta 2",
            torch.cat(parts),
            spent / count,
            "s/rollout",
            processes=processes,
        )


_environments: dict[int, tuple] = {}  # of a child: what the sizes share


def _chunks(bench: Bench, count: int) -> tuple[float, float]:
    """Seconds of STEPS steps of so many scenes, the least of the repeats, and the
    process's peak memory [MiB]."""
    configure_cpu(1)
    chunk = min(CHUNK, count)
    if chunk not in _environments:
        _environments[chunk] = bench, bench.environment(bench.pick(chunk))
    bench, env = _environments[chunk]
    action = TensorDict({"action": torch.zeros(chunk, 2)}, batch_size=[chunk])

    def run() -> None:
        for index in bench.pick(-(-count // chunk) * chunk).split(chunk):
            env.reset(TensorDict({"scene_index": index[:, None]}, batch_size=[chunk]))
            for _ in range(STEPS):
                env._step(action)

    repeats = replace(bench, repeats=max(1, min(bench.repeats, 2048 // count)))
    spent = repeats.best(run) * count / (-(-count // chunk) * chunk)
    return spent, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
