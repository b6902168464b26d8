"""A whole rollout: 8 s, 16 replans of the traffic, ego lane_graph."""

import cProfile
import inspect
import pstats
from collections.abc import Callable, Iterator

import torch
from measure import Bench, Row

from e2rl.sim.env import DrivingEnv
from e2rl.traffic.e2.skeleton import build_skeleton
from e2rl.traffic.e2.topology import topological_candidates
from e2rl.traffic.rollout import roll_out


def synthesized_rollout(bench: Bench) -> Iterator[Row]:
    """Seconds a rollout of the nominal prior and of e2, and shares of e2's time by part."""
    (batch,) = bench.batches(32)
    index = bench.pick(batch)

    def run(eta: float) -> None:
        roll_out(bench.scenes, index, index, torch.full((batch,), eta), bench.ego, bench.traffic, bench.sim)

    for name, eta in (("nominal", 0.0), ("e2, eta 2", 2.0)):
        wall, cpu = bench.both(lambda e=eta: run(e))
        yield bench.row("synthesized_rollout", name, index, wall / batch, "s/rollout")
        yield bench.row("synthesized_rollout", name, index, cpu / batch, "CPU s/rollout")
    prior = type(bench.traffic.prior)
    parts = {
        "topology, feasibility and skeleton": (topological_candidates, bench.traffic.feasible_vehicles, build_skeleton),
        "sampling": (prior.sample,),
        "bounds and decoding of the plan": (prior.plan,),
        "plans of lane_graph": (type(bench.ego).plan,),
        "simulator": (DrivingEnv._step,),
    }
    profile = cProfile.Profile(builtins=False)  # Python's functions alone: little beside torch's operations
    profile.runcall(run, 2.0)
    for name, functions in parts.items():
        yield bench.row(
            "synthesized_rollout", f"e2: {name}", index, 100 * share(profile, functions), "% of the rollout"
        )


def share(profile: cProfile.Profile, functions: tuple[Callable, ...]) -> float:
    """Of a profile's time, what was spent inside `functions`."""
    stats = pstats.Stats(profile)
    spent = {(file, line): row[3] for (file, line, _), row in stats.stats.items()}  # row: calls, own and total time
    code = [inspect.unwrap(function).__code__ for function in functions]
    return sum(spent.get((part.co_filename, part.co_firstlineno), 0.0) for part in code) / stats.total_tt
