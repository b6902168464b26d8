"""`python benchmarks/run.py --json FILE [--only NAME] [--data PATH] [--peers PYTHON]`:
how fast the parts are.

Least time of the repeats, one thread, one process; timings on a shared machine are
worth their load column.
"""

import argparse
import json
import sys
from pathlib import Path

from collector import collector
from evolution_round import evolution_round
from guided_replan import guided_replan
from learning import learning
from measure import Bench, Benchmark
from memory import memory
from peer import peer_benchmarks
from ppo_update import ppo_update
from scaling import scaling
from searched_rollouts import searched_rollouts
from simulator import simulator
from synthesized_rollout import synthesized_rollout

from e2rl.run.cpu import configure_cpu
from e2rl.run.endings import ending
from e2rl.run.errors import InputError

OWN = (
    simulator,
    collector,
    ppo_update,
    learning,
    guided_replan,
    synthesized_rollout,
    searched_rollouts,
    evolution_round,
    memory,
    scaling,
)
BENCHMARKS: dict[str, Benchmark] = {
    function.__name__: function for function in OWN
} | peer_benchmarks


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, required=True, help="file for the rows")
    parser.add_argument(
        "--only",
        action="append",
        choices=sorted(BENCHMARKS),
        help="this benchmark (repeatable)",
    )
    parser.add_argument(
        "--data", help="ScenarioNet folder or zip; default: the bundled test scenes"
    )
    parser.add_argument("--prior", default="bundled", help="checkpoint of a prior")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument(
        "--largest",
        type=int,
        help="scenes at once at most; default: as many as a benchmark wants",
    )
    parser.add_argument(
        "--set",
        nargs="*",
        default=[],
        metavar="KEY=VALUE",
        help="overrides of conf/evaluate.yaml and conf/train.yaml",
    )
    parser.add_argument(
        "--train",
        nargs="*",
        default=[],
        metavar="KEY=VALUE",
        help="overrides of conf/train.yaml alone",
    )
    parser.add_argument(
        "--no-compile",
        dest="compile",
        action="store_false",
        help="leave compiled steps out",
    )
    parser.add_argument(
        "--peers",
        default=sys.executable,
        help="interpreter that has the peers (extra `peers`)",
    )
    options = parser.parse_args(arguments)
    for name in ("repeats", "largest"):
        value = getattr(options, name)
        if value is not None and value < 1:
            raise InputError(f"--{name} {value}: expected at least 1")
    configure_cpu(1)
    bench = Bench(
        options.data,
        options.prior,
        options.repeats,
        options.largest,
        tuple(options.train),
        options.compile,
        options.peers,
        settings=tuple(options.set),
    )
    rows = []
    line = "{:20} {:60} {:>5} {:>6} {:>10} {:>12} {:18} {:>5}"
    print(
        line.format(
            "benchmark",
            "variant",
            "batch",
            "agents",
            "map points",
            "value",
            "unit",
            "load",
        )
    )
    for name in options.only or BENCHMARKS:
        for row in BENCHMARKS[name](bench):
            value = "-" if row.value is None else f"{row.value:.4g}"
            print(
                line.format(
                    row.benchmark,
                    row.variant,
                    row.batch,
                    row.agents,
                    row.map_points,
                    value,
                    row.unit,
                    f"{row.load:.1f}",
                ),
                flush=True,
            )
            rows.append(row.plain())
            options.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    with ending():
        main(sys.argv[1:])
