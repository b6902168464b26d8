"""python -m tools.soak FILE COMMAND...: memory and throughput of a run of evolution rounds, round by round (Linux).

Runs COMMAND (such as `python train.py hydra.run.dir=RUN ...`) and looks at it and at all processes that it starts every
five seconds. FILE, a CSV, gets a row a finished round: seconds since the start, CPU seconds of all these processes in
the round, and the peak in the round of their memory (MB): `own`, what they alone hold and pages that they share, each
counted once, and `files`, their part of mapped files, which the kernel may drop. The rounds are those whose checkpoint
appears in RUN/checkpoints. Prints how far the rounds after the first depart from it; its exit status is COMMAND's.
"""

import csv
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

EVERY = 5.0  # s
TICKS = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Look:
    """Memory (MB) and CPU seconds until now of a tree of processes."""

    own: float
    files: float
    cpu: float


@dataclass(frozen=True)
class Round:
    """A finished round: its number, when it ended, and what it took."""

    number: int
    seconds: float
    cpu: float
    own: float
    files: float


def look(leader: int) -> Look:
    """The processes of a session, as they are now. Those that ended count in their parent's CPU time."""
    own = files = cpu = 0.0
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            fields = (entry / "stat").read_text().rpartition(") ")[2].split()
            if int(fields[3]) != leader:
                continue
            cpu += sum(map(int, fields[11:15])) / TICKS
            rows = [line.split() for line in (entry / "smaps_rollup").read_text().splitlines()]
        except (FileNotFoundError, ProcessLookupError):
            continue
        size = {row[0]: int(row[1]) / 1024 for row in rows if row[-1] == "kB"}
        own += size.get("Pss_Anon:", 0.0) + size.get("Pss_Shmem:", 0.0)
        files += size.get("Pss_File:", 0.0)
    return Look(own, files, cpu)


def latest(checkpoints: Path) -> int:
    """The number of the last finished round; 0 before the first."""
    return max((int(path.name.partition("-")[2]) for path in checkpoints.glob("round-*[0-9]")), default=0)


def watch(run: subprocess.Popen, checkpoints: Path, every: float = EVERY) -> Iterator[Round]:
    """The rounds of a running command as they finish. Two that finish within `every` seconds are one."""
    begin, since, number, seen = time.monotonic(), 0.0, latest(checkpoints), []
    while run.poll() is None:
        seen.append(now := look(run.pid))
        if (newest := latest(checkpoints)) > number:
            peak = (max(one.own for one in seen), max(one.files for one in seen))
            yield Round(newest, time.monotonic() - begin, now.cpu - since, *peak)
            since, number, seen = now.cpu, newest, []
        time.sleep(every)


def told(rounds: list[Round]) -> str:
    """How memory and CPU time of the rounds after the first depart: memory from the first, time from their median."""
    if len(rounds) < 3:
        return f"{len(rounds)} rounds: too few to compare"
    first, later = rounds[0], rounds[1:]
    usual = statistics.median(one.cpu for one in later)
    memory = [100 * (one.own / later[0].own - 1) for one in later]
    times = [100 * (one.cpu / usual - 1) for one in later]
    return (
        f"{len(rounds)} rounds in {rounds[-1].seconds / 60:.0f} minutes; memory {first.own:.0f} MB in the first, "
        f"{later[0].own:.0f} MB in the second, from there {min(memory):+.1f}% to {max(memory):+.1f}%, at the end "
        f"{memory[-1]:+.1f}%; CPU time of a round {usual:.0f} s, {min(times):+.1f}% to {max(times):+.1f}%"
    )


def main(file: Path, command: list[str]) -> int:
    folder = next((part.partition("=")[2] for part in command if part.startswith(("hydra.run.dir=", "resume="))), "")
    if not folder:
        sys.exit("name the run's folder in the command: hydra.run.dir=RUN or resume=RUN")
    run = subprocess.Popen(command, start_new_session=True)
    rounds = []
    with file.open("w", newline="", buffering=1) as stream:
        writer = csv.DictWriter(stream, fieldnames=list(Round.__dataclass_fields__))
        writer.writeheader()
        for finished in watch(run, Path(folder) / "checkpoints"):
            rounds.append(finished)
            writer.writerow(asdict(finished))
    print(told(rounds))
    return run.returncode


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    sys.exit(main(Path(sys.argv[1]), sys.argv[2:]))
