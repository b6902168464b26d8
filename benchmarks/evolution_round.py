"""A whole evolution round of the default configuration, and where its time goes."""

import time
from collections.abc import Iterator

import torch
from measure import Bench, Row

from e2rl.build import build_ego
from e2rl.learning.build import build_evolution


def evolution_round(bench: Bench) -> Iterator[Row]:
    """Seconds of one round, not repeated: it takes minutes; synthesis is of D' and of its nominal scenes."""
    config = bench.configured("train")
    torch.manual_seed(0)
    run = build_evolution(config, bench.scenes, build_ego(config), bench.traffic)
    begin = time.perf_counter()
    metrics = run.run_round()
    total = time.perf_counter() - begin
    index = bench.pick(config.learner.round.scenes)
    yield bench.row("evolution_round", "whole", index, total, "s")
    for part in ("synthesize", "improve"):
        yield bench.row("evolution_round", part, index, metrics[f"time/{part}"], "s")
