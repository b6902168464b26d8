"""`python -m e2rl.report.score_files RUN_DIR`: rows and tables of the rollouts that an interrupted run left on disk.

Time, transport and the search for evasions are known to the run alone; their columns stay empty.
"""

import argparse
import sys
from pathlib import Path

from tqdm import tqdm

from e2rl.evaluation.protocol import Scored, record
from e2rl.evaluation.rollout_files import METRICS_FILE, ROLLOUTS, TABLE, Source, label_rows, require_rows
from e2rl.evaluation.rollout_reader import as_rollout_dict, read_rollout
from e2rl.evaluation.summary import metric_rows
from e2rl.metrics.score import score_rollouts
from e2rl.report.tables import metric_tables, print_tables, save_tables
from e2rl.run.errors import InputError

SOURCE = ("dataset", "split", "method", "ego_policy")


def score_saved(folder: Path) -> Scored:
    """Rows and realism samples of the rollouts in a run's folder, one file at a time; a file that cannot be read is a
    rollout without a score."""
    paths = sorted((Path(folder) / ROLLOUTS).glob("*.npz"))
    if not paths:
        raise InputError(f"{folder}: no {ROLLOUTS}/*.npz here; give the folder of a run of evaluate.py")
    rows, samples, ended = [], [], []
    for path in tqdm(paths, "scoring", unit="rollout", disable=None):
        try:
            rollout = read_rollout(path)
        except InputError as error:
            ended.append({"reason": "damaged file", "detail": str(error), "file": path.name})
            continue
        found, features = score_rollouts(as_rollout_dict([rollout]))
        rows += label_rows(found, Source(*(rollout[name] for name in SOURCE)))
        samples += features
    require_rows(rows, ended, None)
    return rows, samples, ended


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m e2rl.report.score_files", description=__doc__)
    parser.add_argument("run", type=Path, help="folder of a run of evaluate.py")
    folder = parser.parse_args(arguments).run
    try:
        if (folder / TABLE).exists():
            raise InputError(f"{folder / TABLE}: is there already, with more columns than files tell; read or move it")
        rows, samples, ended = score_saved(folder)
        for entry in ended:
            print(f"left out {entry['file']}: {entry['detail']}", file=sys.stderr)
        result = record(rows, samples, [], folder, metric_rows)
        left_out = f"Scored from files; left out: {len(ended)} damaged" if ended else "Scored from files"
        tables = metric_tables(result, left_out)
        save_tables(folder / "tables.md", tables)
        print_tables(tables)
        print(f"\nwritten to {folder / METRICS_FILE}, {TABLE} and tables.md")
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
