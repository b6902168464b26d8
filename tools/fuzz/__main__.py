"""python -m tools.fuzz N [--readers A,B] [--data LOGS] [--commonroad ZIP] [--argoverse2 FOLDER] [--record FILE]: N
malformed inputs for each reader, and counts by outcome.

Inputs are damaged copies of whole ones and what a stranger might write (tools/fuzz/). Each is made from the
seed and its number, and read in a child process whose memory is limited. Outcomes:

| refused | by the program's own error, which names the file |
| read | what was read is whole: equal to what was written, or a plausible scene |
| escaped | another exception |
| garbage | read as something that it is not |
| hang | more than LIMIT seconds of the processor, or WAIT seconds without it |
| crash | the child died |
| memory | more than MEMORY bytes were asked for |
| executed | code of the input ran, or a process, a connection, or a file elsewhere was opened for writing |

The exit status is 1 where any but the first two came out. FILE holds an outcome a line: the command goes on after it.
"""

import argparse
import csv
import json
import os
import selectors
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryFile

from tools.fuzz import LIMIT, READERS

STUCK = 3 * LIMIT  # s of the processor after which a child that does not answer is killed
WAIT = 60.0  # s of the clock after which one is killed that waits for something
COLUMNS = ("reader", "number", "outcome", "seconds", "note")
GOOD = ("refused", "read")
LIBRARIES = {"commonroad": "commonroad", "argoverse2": "av2"}  # that readers need
BAD = ("escaped", "garbage", "hang", "crash", "memory", "executed")


def rows_of(first: dict[str, int], options: argparse.Namespace) -> Iterator[dict]:
    """The outcomes of inputs of the readers from the number `first` of each up to options.count; a child that died or
    hangs is replaced."""
    first = {reader: begin for reader, begin in first.items() if begin < options.count}
    while first:
        command = [sys.executable, "-m", "tools.fuzz.child", str(options.count), str(options.seed)]
        command += [f"{reader}={begin}" for reader, begin in first.items()]
        given = {"--data": options.data, "--commonroad": options.commonroad, "--argoverse2": options.argoverse2}
        command += [part for name, value in given.items() if value for part in (name, value)]
        quiet, before = os.environ | {"PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1"}, dict(first)
        with (
            TemporaryFile() as said,
            subprocess.Popen(command, stdout=subprocess.PIPE, stderr=said, env=quiet) as process,
        ):
            for row in _outcomes(process):
                first[row["reader"]] = row["number"] + 1
                yield row
            process.wait()
            said.seek(0)
            why = said.read().decode(errors="replace").strip().splitlines()[-1:]
        first = {reader: begin for reader, begin in first.items() if begin < options.count}
        if first:  # it died at the next input of the first of those that are left
            reader, begin = next(iter(first.items()))
            if first == before and process.returncode == 1:
                raise SystemExit(f"{reader}: the child does not start: {' '.join(why)}")
            hung = process.returncode == -signal.SIGKILL
            note = "no answer" if hung else f"status {process.returncode} {' '.join(why)}"
            yield dict(zip(COLUMNS, (reader, begin, "hang" if hung else "crash", "", note), strict=True))
            first[reader] = begin + 1


def _outcomes(process: subprocess.Popen) -> Iterator[dict]:
    """The outcomes that a child writes, until it ends; it is killed where it does not answer."""
    assert process.stdout is not None
    waiting, buffer, since = selectors.DefaultSelector(), b"", used(process.pid)
    waiting.register(process.stdout, selectors.EVENT_READ)
    patience = 10  # libraries are loaded, and whole inputs made
    while True:
        if not waiting.select(timeout=WAIT):
            now = used(process.pid)
            if now - since > patience * STUCK or (patience == 1 and now == since and sleeps(process.pid)):
                process.kill()
                break
            continue
        part = os.read(process.stdout.fileno(), 1 << 16)
        if not part:
            break
        *lines, buffer = (buffer + part).split(b"\n")
        since = used(process.pid)
        for found in map(json.loads, lines):
            patience = 10 if len(found) == 2 and found[1] is None else 1
            if len(found) > 2:
                yield dict(zip(COLUMNS, found, strict=True))
    waiting.close()


def used(pid: int) -> float:
    """Seconds of the processor that a process has taken, rounded down; 0 where it has ended."""
    try:
        parts = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return float((int(parts[11]) + int(parts[12])) // os.sysconf("SC_CLK_TCK"))


def sleeps(pid: int) -> bool:
    """Whether a process waits for something other than the processor and the disk."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "S"
    except OSError:
        return False


def run(readers: list[str], options: argparse.Namespace) -> Counter:
    """Counts of (reader, outcome); every outcome is written into options.record as it comes."""
    counts, last = Counter(), Counter()
    path = options.record
    if path is not None and path.is_file():
        with path.open(newline="") as file:
            for row in csv.DictReader(file):
                if int(row["number"]) < options.count:
                    counts[row["reader"], row["outcome"]] += 1
                    last[row["reader"]] = max(last[row["reader"]], int(row["number"]) + 1)
    with open(path or os.devnull, "a", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        if not last:
            writer.writeheader()
        for row in rows_of({reader: last[reader] for reader in readers}, options):
            counts[row["reader"], row["outcome"]] += 1
            writer.writerow(row)
            file.flush()
            if row["outcome"] in BAD:
                print(f"{row['reader']} {row['number']}: {row['outcome']}: {row['note']}", file=sys.stderr, flush=True)
    return counts


def table(counts: Counter) -> list[str]:
    """Lines of Markdown: a line a reader."""
    head = ("reader", "inputs", *GOOD, *BAD)
    lines = ["| " + " | ".join(head) + " |", "| --- " * len(head) + "|"]
    names = list(dict.fromkeys(reader for reader, _ in counts))
    for name in [*names, "all"]:
        own = Counter()
        for (reader, result), count in counts.items():
            own[result] += count * (name in (reader, "all"))
        lines.append("| " + " | ".join([name, *(str(n) for n in (own.total(), *(own[r] for r in GOOD + BAD)))]) + " |")
    return lines


def available(options: argparse.Namespace) -> list[str]:
    """The readers that there are inputs for."""
    absent = [name for name in LIBRARIES if not getattr(options, name)]
    return [name for name in READERS if name not in absent]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("count", type=int, metavar="N")
    parser.add_argument("--readers", help="only these, with commas between them", default="")
    parser.add_argument("--data", help="a folder or zip of ScenarioDescription pickles; default: bundled scenes")
    parser.add_argument(
        "--commonroad", help="a folder or zip of CommonRoad scenarios; default: that reader is left out"
    )
    parser.add_argument("--argoverse2", help="a folder of Argoverse 2 scenarios; default: that reader is left out")
    parser.add_argument("--record", type=Path, help="outcomes so far, a line each; the command goes on after them")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    readers = options.readers.split(",") if options.readers else available(options)
    for name, library in LIBRARIES.items():
        if name in readers and find_spec(library) is None:  # all its inputs would be refused for that
            parser.error(f"the reader {name} needs {library}: pip install 'e2rl[{name}]'")
    counts = run(readers, options)
    print("\n".join(table(counts)))
    return 1 if any(counts[reader, result] for reader, result in counts if result in BAD) else 0


if __name__ == "__main__":
    sys.exit(main())
