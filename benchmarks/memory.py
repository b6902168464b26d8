"""Peak memory of the other benchmarks' work, each in a process of its own."""

import multiprocessing
import resource
from collections.abc import Iterator
from dataclasses import replace

import torch
from measure import Bench, Row
from tensordict import TensorDict

from e2rl.evaluation.build import build_ego, build_prior, build_sim, build_traffic
from e2rl.learning.rounds.policy import PolicyImprovement
from e2rl.run.config import load_choice
from e2rl.run.cpu import configure_cpu

WORK = (
    ("simulator", 512),
    ("nominal rollout", 48),
    ("e2 rollout", 8),
    ("e2 rollout", 48),
    ("learning", 64),
)


def memory(bench: Bench) -> Iterator[Row]:
    """MiB at most resident: the scenes alone, 512 of them simulated, rollouts in
    nominal traffic and against e2, and environments that a policy learns in."""
    context = multiprocessing.get_context("spawn")
    alone = 0.0
    done = set()
    bench.pick(1)  # the scenes are built: processes of a pool cannot
    for name, size in WORK:
        (batch,) = bench.batches(size)
        if (name, batch) in done:
            continue
        done.add((name, batch))
        with context.Pool(1) as pool:
            alone, value = pool.apply(
                _peak, (replace(bench), name, batch)
            )  # without what is loaded
        yield bench.row("memory", name, bench.pick(batch), value, "MiB")
    yield bench.row("memory", "scenes alone", bench.pick(1), alone, "MiB")


def _peak(bench: Bench, name: str, batch: int) -> tuple[float, float]:
    """With the scenes loaded, and after the work."""
    configure_cpu(1)
    index = bench.pick(batch)
    alone = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    if name == "simulator":
        env = bench.environment(index)
        for _ in range(5):
            env._step(TensorDict({"action": torch.zeros(batch, 2)}, batch_size=[batch]))
    elif name == "learning":
        _learn(bench, batch)
    else:
        nominal = name == "nominal rollout"
        choice = load_choice("synthesizer", "nominal")
        traffic = (
            build_traffic(choice, build_prior(bench.config)[0])
            if nominal
            else bench.traffic
        )
        eta = torch.full((batch,), 0.0 if nominal else 2.0)
        bench.roll_out(index, eta, traffic)
    return alone, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _learn(bench: Bench, batch: int) -> None:
    """Collect and update twice, in recorded traffic."""
    config = bench.configured("train")
    ppo = config.learner.ppo
    collect = {**config.learner.collect, "batch": batch}
    improve = PolicyImprovement(
        build_ego(config),
        bench.scenes,
        build_sim(config),
        device="cpu",
        rounds=config.rounds,
        collect=collect,
        ppo=ppo,
    )
    for _ in range(2):
        improve.learner.update(improve.collected())
