"""Evolution rounds of the default configuration, and where their time goes."""

import time
from collections.abc import Iterator

import torch
from e2rl.scripts.train import train_round
from measure import Bench, Row

from e2rl.evaluation.build import build_ego
from e2rl.learning.rounds.build import build_evolution


def evolution_round(bench: Bench) -> Iterator[Row]:
    """Seconds of a round, not repeated: it takes minutes; synthesis is of D' and of its
    nominal scenes.

    With synthesis beside learning it is the second of three rounds, which waits for
    what was begun during the first and learns while the third's D' is made.
    """
    for prefetch in (False, True):
        config = bench.configured("train")
        config.learner.round.prefetch = prefetch
        torch.manual_seed(0)
        run = build_evolution(
            config, bench.scenes, ego=build_ego(config), attackers=[bench.traffic]
        )
        if prefetch:
            train_round(run)
        begin = time.perf_counter()
        metrics = train_round(run)
        total = time.perf_counter() - begin
        index = bench.pick(config.learner.round.scenes)
        where = ", prefetch" if prefetch else ""
        yield bench.row("evolution_round", f"whole{where}", index, total, "s")
        for part in ("synthesize", "improve", *(["waiting"] if prefetch else [])):
            yield bench.row(
                "evolution_round", f"{part}{where}", index, metrics[f"time/{part}"], "s"
            )
