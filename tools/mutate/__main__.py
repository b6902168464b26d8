"""python -m tools.mutate LOGS... [--logs N] [--kinds TEXT] [--record FILE]: mutated copies of recorded logs, and what
came of each.

LOGS: folders or zips of ScenarioDescription pickles, CommonRoad scenarios, or Argoverse 2 logs. Every kind of mutation
in tools/mutate/kinds.py is made of every log, in the log's own format, and becomes a scene as in evaluate.py, or none;
the logs as they are come first, and of those that make no scene nothing else. Printed is a table of kinds with the
numbers of logs tried, refused and read, and the reason that was given most; then what went otherwise than it must. The
exit status is 1 where something did.
"""

import argparse
import csv
import re
import sys
import time
import warnings
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from e2rl.scenes.builder import BuildSettings
from e2rl.scenes.recording import Recording
from e2rl.scenes.scenarionet import ScenarioNetSource, recording_of
from e2rl.scenes.source import OVERLAP, TOO_SHORT, Source
from tools.mutate.formats import opened, source_of
from tools.mutate.kinds import EITHER, KINDS, READ, REFUSED, Kind
from tools.mutate.log import RecordedLog
from tools.mutate.scenarionet import ScenarioNetLog

LIMIT = 20.0  # s for one log
SMALL = BuildSettings(steps=80, vehicles=4, others=2, vertices=60, field_cells=32)  # plausibility looks at all the log
GENUINE, LEFT_OUT = "as recorded", "left out"
COLUMNS = ("kind", "logs", "log", "outcome", "reason", "seconds")


def fits(kind: Kind, log: RecordedLog) -> bool:
    """Whether a format can say what a kind says."""
    return set(kind.needs) <= log.holds and (isinstance(log, ScenarioNetLog) or not kind.pickles)


@dataclass
class Described(ScenarioNetSource):
    """A ScenarioDescription that was read already: mutations change its values, not its bytes."""

    data: dict = field(default_factory=dict)

    def read(self, log: str) -> Iterator[Recording]:
        yield recording_of(self.data, log)


def outcome(source: Source, log: str) -> tuple[str, str, float]:
    """What comes of a log; its reason; seconds of the processor."""
    begin = time.process_time()
    try:
        rows = source._rows_of(log)
    except Exception as error:  # nothing but InputError may leave a reader
        return "escaped", f"{type(error).__name__}: {error}"[:300], time.process_time() - begin
    spent = time.process_time() - begin
    if spent > LIMIT:
        return "slow", "", spent
    if any(row.scene is not None for row in rows):
        return READ, "", spent
    reason = rows[0].reason
    return (LEFT_OUT if reason in (OVERLAP, TOO_SHORT) else REFUSED), reason, spent


def mutated(source: Source, log: RecordedLog, kind: Kind) -> tuple[str, str, float]:
    changed = log.changed(kind.change)
    if isinstance(changed, ScenarioNetLog):
        return outcome(Described(data=changed.description(), build=SMALL), log.file)
    with TemporaryDirectory() as folder:
        changed.write(Path(folder))
        written = replace(source, path=folder)
        return outcome(written, *written.logs())


def run(paths: list[str], most: int | None, chosen: str, record: Path) -> list[dict]:
    """The rows of every log and kind; those in the record already are not made again."""
    known = read_record(record)
    done = {(row["logs"], row["log"], row["kind"]): row["outcome"] for row in known}
    with record.open("a", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        if not known:
            writer.writeheader()
        for path in paths:
            source, count = replace(source_of(path), workers=1, build=SMALL), 0
            for log in source.logs():
                for row in rows_of_log(source, path, log, chosen, done):
                    writer.writerow(row)
                    known.append(row)
                file.flush()
                count += done[path, log, GENUINE] == READ
                if count == most:
                    break
    return known


def rows_of_log(source: Source, path: str, log: str, chosen: str, done: dict) -> Iterator[dict]:
    """The rows of a log that are not done; of one that makes no scene as it is, only that."""
    whole = None
    for name, kind in {GENUINE: None, **KINDS}.items():
        if (path, log, name) in done or chosen not in name and kind is not None:
            continue
        if kind is None:
            found = outcome(source, log)
        elif done[path, log, GENUINE] != READ:
            return
        else:
            whole = whole or opened(source, log)
            if not fits(kind, whole):
                continue
            found = mutated(source, whole, kind)
        done[path, log, name] = found[0]
        yield dict(zip(COLUMNS, (name, path, log, *found), strict=True))


def read_record(record: Path) -> list[dict]:
    if not record.is_file() or not record.stat().st_size:
        return []
    with record.open(newline="") as file:
        return list(csv.DictReader(file))


def measure_of(reason: str) -> str:
    """The words of a reason, without names and numbers."""
    text = re.sub(r"^.*?scene '[^']*': |^[^:]*\.(pkl|xml|parquet|feather): ", "", reason)
    return re.sub(r"-?\d[\d.e+]*|'[^']*'|\binf\b|\bnan\b", "..", text).split(", plausible")[0].split(";")[0][:90]


def table(rows: list[dict]) -> list[str]:
    """Lines of Markdown: a line a kind."""
    lines = ["| kind | must be | tried | refused | read | left out | reason given most |", "| --- " * 7 + "|"]
    groups: dict[str, list[dict]] = defaultdict(list)
    for row in rows:
        groups[row["kind"]].append(row)
    for name in (GENUINE, *KINDS):
        if not (group := groups.get(name)):
            continue
        counts = Counter(row["outcome"] for row in group)
        reasons = Counter(measure_of(row["reason"]) for row in group if row["outcome"] == REFUSED)
        why = f"{reasons.most_common(1)[0][0]} ({reasons.most_common(1)[0][1]})" if reasons else ""
        must = READ if name == GENUINE else KINDS[name].expected
        numbers = (len(group), counts[REFUSED], counts[READ], counts[LEFT_OUT])
        lines.append("| " + " | ".join([name, must, *map(str, numbers), why]) + " |")
    return lines


def wrong(row: dict[str, Any]) -> bool:
    """Whether a row is otherwise than it must be; what is left out, as too short or for an overlap, is simulated by
    nobody."""
    must = READ if row["kind"] == GENUINE else KINDS[row["kind"]].expected
    return row["outcome"] not in ((REFUSED, READ, LEFT_OUT) if must == EITHER else (must, LEFT_OUT))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="+", metavar="LOGS")
    parser.add_argument("--logs", type=int, help="the first so many of each that make a scene; default: all")
    parser.add_argument("--kinds", default="", metavar="TEXT", help="only kinds with this text in their name")
    parser.add_argument("--record", type=Path, default=Path("mutations.csv"), help="rows done; they are not done again")
    options = parser.parse_args()
    warnings.filterwarnings("ignore")
    rows = run(options.paths, options.logs, options.kinds, options.record)
    print("\n".join(table(rows)))
    others = [row for row in rows if wrong(row)]
    print(f"\n{len(rows)} logs read; otherwise than they must be: {len(others)}")
    for row in others:
        print(f"  {row['kind']}: {row['logs']}: {row['log']}: {row['outcome']} {row['reason'][:200]}")
    return 1 if others else 0


if __name__ == "__main__":
    sys.exit(main())
