"""A whole rollout: 8 s, 16 replans of the traffic, ego lane_graph; what its parts and
kinds of work take of it."""

import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any
from unittest.mock import patch

import torch
from measure import Bench, Row
from torch.utils._python_dispatch import TorchDispatchMode

from e2rl.metrics.score import score_rollouts
from e2rl.planners.lane_graph_planner import LaneGraphEgo
from e2rl.prior import prior
from e2rl.run import fused
from e2rl.sim.env import DrivingEnv
from e2rl.traffic import nominal
from e2rl.traffic.e2 import coalition, e2, feasibility, interception
from e2rl.traffic.e2 import kernels as importance

PARTS = {  # each without the others that it calls
    "encoding": [(prior.Prior, "encode")],
    "denoising": [(prior.Prior, "denoise")],
    "decoding": [(prior.Prior, "decode")],
    "control, and steps of the SDE": [(prior.Prior, "sample")],
    "bounds": [(prior, "bounded")],
    "foresight": [(importance, "foresee"), (interception, "foresee")],
    "kernels proposed": [(e2, "propose_kernels")],
    "proposals and interceptions": [(coalition, "propose")],
    "topology and feasibility": [
        (coalition, "topological_candidates"),
        (feasibility, "find_conflicts"),
    ],
    "skeleton": [(coalition, "build_skeleton")],
    "groups of scenes": [
        (nominal, name)
        for name in ("crop_world", "crop_state", "write_state", "group_scenes")
    ],
    "planner": [(LaneGraphEgo, "plan")],
    "simulator": [(DrivingEnv, "_step")],
}
aten = torch.ops.aten
PRODUCTS = (aten.mm, aten.addmm, aten.bmm, aten.baddbmm, aten.linear)


def synthesized_rollout(bench: Bench) -> Iterator[Row]:
    """Seconds a rollout of the nominal prior and of e2, eager and compiled; of e2's
    time, shares by part and kind."""
    for batch in bench.batches(1, 32, 128):
        index = bench.pick(batch)

        def run(eta: float, index: torch.Tensor = index) -> Any:
            etas = torch.full((len(index),), eta)
            return bench.roll_out(index, etas)

        for compiled in (False, True) if bench.compile else (False,):
            fused.switch(compiled)
            how = ", compiled" if compiled else ""
            for name, eta in (("nominal", 0.0), ("e2, eta 2", 2.0)):
                wall, cpu = bench.both(lambda e=eta: run(e))
                yield bench.row(
                    "synthesized_rollout", name + how, index, wall / batch, "s/rollout"
                )
                yield bench.row(
                    "synthesized_rollout",
                    name + how,
                    index,
                    cpu / batch,
                    "CPU s/rollout",
                )
            rollouts = run(2.0)
            scoring = bench.both(lambda made=rollouts: score_rollouts(made))[1]
            yield bench.row(
                "synthesized_rollout",
                f"metrics and verdicts{how}",
                index,
                scoring / batch,
                "CPU s/rollout",
            )
            shares, operations = kinds(lambda: run(2.0))
            yield bench.row(
                "synthesized_rollout",
                f"e2{how}",
                index,
                operations / batch,
                "operations/rollout",
            )
            for kind, each in (("part", parts(lambda: run(2.0))), ("kind", shares)):
                for name, share in each.items():
                    variant = f"e2{how}, {kind}: {name}"
                    yield bench.row(
                        "synthesized_rollout",
                        variant,
                        index,
                        100 * share,
                        "% of the rollout",
                    )
        fused.switch(False)


def parts(run: Callable[[], object]) -> dict[str, float]:
    """Shares of a run's time inside each of PARTS, and of the rest."""
    spent = Counter[str]()
    inside = ["rest"]
    since = [time.perf_counter()]

    def enter(part: str) -> None:
        now = time.perf_counter()
        spent[inside[-1]] += now - since[0]
        since[0] = now
        inside.append(part)

    def leave() -> None:
        now = time.perf_counter()
        spent[inside.pop()] += now - since[0]
        since[0] = now

    def timed(function: Callable, part: str) -> Callable:
        def wrapper(*given: Any, **named: Any) -> Any:
            enter(part)
            try:
                return function(*given, **named)
            finally:
                leave()

        return wrapper

    with ExitStack() as stack:
        for part, places in PARTS.items():
            for owner, name in places:
                stack.enter_context(
                    patch.object(owner, name, timed(getattr(owner, name), part))
                )
        since[0] = time.perf_counter()
        run()
    enter("end")
    return {part: spent[part] / sum(spent.values()) for part in (*PARTS, "rest")}


def kinds(run: Callable[[], object]) -> tuple[dict[str, float], int]:
    """Shares of a run's time in fused functions and in PyTorch's products of matrices
    outside of them; and PyTorch's operations, which are too short for a clock beside
    them."""
    begin = time.perf_counter()
    run()
    total = time.perf_counter() - begin
    spent = Counter[str]()
    called = fused.Fused.__call__

    def timed(*given: Any) -> Any:
        begin = time.perf_counter()
        try:
            return called(*given)
        finally:
            spent["fused functions"] += time.perf_counter() - begin

    class Counted(TorchDispatchMode):
        def __torch_dispatch__(
            self, function: Any, types: Any, given: Any = (), named: Any = None
        ) -> Any:
            begin = time.perf_counter()
            result = function(*given, **(named or {}))
            if function.overloadpacket in PRODUCTS:
                spent["products of matrices"] += time.perf_counter() - begin
            counts["operations"] += 1
            return result

    counts = Counter[str]()
    with patch.object(fused.Fused, "__call__", timed if fused.is_on() else called):
        run()
    with Counted():
        run()
    return {name: seconds / total for name, seconds in spent.items()}, counts[
        "operations"
    ]
