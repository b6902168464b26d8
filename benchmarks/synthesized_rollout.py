"""A whole rollout: 8 s, 16 replans of the traffic, ego lane_graph."""

import time
from collections.abc import Iterator

import torch
from measure import Bench, Row

from e2rl.prior.prior import Prior
from e2rl.synthesizer import synthesizer as parts
from e2rl.synthesizer.rollout import roll_out

BATCH = 32
SUPPORT = ("topological_candidates", "feasible_vehicles", "build_skeleton")  # what the choice of a support costs


class Stopwatch:
    """Adds up the time inside named functions of a module or class while in use."""

    def __init__(self, owner, names: tuple[str, ...]):
        self.owner, self.original, self.seconds = owner, {name: getattr(owner, name) for name in names}, 0.0

    def __enter__(self):
        for name, function in self.original.items():
            setattr(self.owner, name, self._timed(function))
        return self

    def __exit__(self, *_):
        for name, function in self.original.items():
            setattr(self.owner, name, function)

    def _timed(self, function):
        def timed(*args, **options):
            begin = time.perf_counter()
            try:
                return function(*args, **options)
            finally:
                self.seconds += time.perf_counter() - begin
        return timed


def synthesized_rollout(bench: Bench) -> Iterator[Row]:
    """Seconds a rollout of the nominal prior and of e2, and shares of e2's time: choice of the support, sampling."""
    index = bench.pick(BATCH)

    def run(eta: float) -> None:
        roll_out(bench.scenes, index, index, torch.full((BATCH,), eta), bench.ego, bench.synthesizer, bench.sim)

    for name, eta in (("nominal", 0.0), ("e2, eta 2", 2.0)):
        yield bench.row("synthesized_rollout", name, index, bench.best(lambda e=eta: run(e)) / BATCH, "s/rollout")
    stages = ("topology, feasibility and skeleton", parts, SUPPORT), ("sampling", Prior, ("sample",))
    for name, owner, names in stages:
        begin = time.perf_counter()
        with Stopwatch(owner, names) as watch:
            run(2.0)
        share = watch.seconds / (time.perf_counter() - begin)
        yield bench.row("synthesized_rollout", f"e2: {name}", index, 100 * share, "% of the rollout")
