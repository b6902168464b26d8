"""Other simulators in the same call, each in a process of its own interpreter (`--peers
PYTHON`, extra `peers`).

Their packages ask for older versions of what e2rl needs, so they are best installed
beside it, not into it. A peer that is absent gets a row without a value that says so.
"""

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path

from measure import Bench, Benchmark, Row

SCRIPT = Path(__file__).with_name("peers.py")
PEERS = "highway_env", "vmas", "torchdrivesim", "waymax"


def _benchmark(name: str) -> Benchmark:
    def peer(bench: Bench) -> Iterator[Row]:
        """Agent-steps per CPU second of its own step, which each row's variant names."""
        run = subprocess.run(
            [bench.peers, str(SCRIPT), name, str(bench.repeats)],
            capture_output=True,
            text=True,
        )
        if run.returncode:
            reason = run.stderr.strip().splitlines()[-1]
            yield Row(
                f"peer_{name}", f"absent: {reason}", 0, 0, 0, None, "agent-steps/CPU s"
            )
            return
        found = json.loads(run.stdout.splitlines()[-1])
        for batch, agents, work, value in found["rows"]:
            row = Row(
                f"peer_{name}", work, batch, agents, 0, value, "agent-steps/CPU s"
            )
            row.versions = row.versions | {name: found["version"]}
            yield row

    return peer


peer_benchmarks: dict[str, Benchmark] = {
    f"peer_{name}": _benchmark(name) for name in PEERS
}
