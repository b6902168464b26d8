"""Policy learning from collection to weights, in the default configuration, on recorded
traffic."""

import time
from collections.abc import Iterator

import torch
from measure import Bench, Row

from e2rl.evaluation.build import build_ego, build_sim
from e2rl.learning.rounds.policy import PolicyImprovement, steps_of
from e2rl.run import fused

WARM_UP = 2  # iterations that are not counted: the first updates fit the critic alone


def learning(bench: Bench) -> Iterator[Row]:
    """Simulator steps of 0.1 s per second of CPU: of collecting a batch, and of
    collecting and updating; the best of the repeats, eager and
    compiled."""
    for fast in (False, True) if bench.compile else (False,):
        fused.switch(fast)
        collected, whole = rates(bench)
        index = bench.pick(bench.configured("train").learner.collect.batch)
        how = ", compiled" if fast else ""
        yield bench.row(
            "learning", f"collect{how}", index, collected, "simulator steps/CPU s"
        )
        yield bench.row(
            "learning",
            f"collect and update{how}",
            index,
            whole,
            "simulator steps/CPU s",
        )
    fused.switch(False)


def rates(bench: Bench) -> tuple[float, float]:
    """Steps per second of CPU of collecting, and of collecting and updating."""
    config = bench.configured("train")
    torch.manual_seed(0)
    collect = dict(config.learner.collect)
    ppo = config.learner.ppo
    improve = PolicyImprovement(
        build_ego(config),
        bench.scenes,
        build_sim(config),
        device="cpu",
        rounds=config.rounds,
        collect=collect,
        ppo=ppo,
    )
    collected = []
    whole = []
    for number in range(WARM_UP + bench.repeats):
        begin = time.process_time()
        data = improve.collected()
        between = time.process_time()
        improve.learner.update(data)
        if number >= WARM_UP:
            steps = steps_of(data)
            collected.append(steps / (between - begin))
            whole.append(steps / (time.process_time() - begin))
    return max(collected), max(whole)
