"""`e2rl export RUN_DIR --to FORMAT`: failures of a run in the format of another tool (docs/export.md)."""

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from e2rl.evaluation.rollout_files import TABLE, own_folder, read_rows
from e2rl.metrics.failure_modes import is_failure
from e2rl.report.export import archive, mcap, openscenario
from e2rl.report.export import commonroad_writer as commonroad
from e2rl.report.export import scenarionet_writer as scenarionet
from e2rl.report.export.episode import FACTS
from e2rl.report.export.scene_files import episodes_of
from e2rl.run.config import library
from e2rl.run.endings import ending
from e2rl.run.errors import InputError
from e2rl.run.files import written_whole

FORMATS = {
    "commonroad": commonroad.write,
    "openscenario": openscenario.write,
    "scenarionet": scenarionet.write,
    "mcap": mcap.write,
    "npz": archive.write,
}
OPEN_EGO = ("commonroad", "openscenario")  # formats in which the ego's place may be left open
LIST = "exported.csv"
LIBRARIES = {  # modules that a format needs, from the extra of its name
    "commonroad": ("commonroad.common.writer.file_writer_xml",),
    "openscenario": ("scenariogeneration",),
    "mcap": ("mcap.writer", "mcap_protobuf.schema", "foxglove_schemas_protobuf.SceneUpdate_pb2"),
}


def check_format(name: str, open_ego: bool) -> None:
    """InputError for a format whose library is missing, and for an open ego in a format without one."""
    if open_ego and name not in OPEN_EGO:
        raise InputError(f"--open-ego: {name} has no such form; leave it out, or pass --to {' or '.join(OPEN_EGO)}")
    for module in LIBRARIES.get(name, ()):
        library(module, f"--to {name}", name)


def chosen_rows(run: Path, failures: int | None, every: bool, method: str | None) -> list[dict]:
    """Rows of rollouts.csv: its failures, first those that count, at most `failures`; or every rollout of it."""
    rows = read_rows(run / TABLE)
    if method is not None:
        known = dict.fromkeys(row["method"] for row in rows)
        if method not in known:
            raise InputError(f"--method {method}: not in {run / TABLE}; choose among {', '.join(known)}")
        rows = [row for row in rows if row["method"] == method]
    if every:
        return rows
    found = sorted((row for row in rows if is_failure(row)), key=lambda row: row["counted"] != 1)
    if not found:
        raise InputError(
            f"{run / TABLE}: no rollout in which the ego hits a vehicle; raise eta, evaluate more scenes, or pass --all"
        )
    return found[:failures]


def export(
    run: Path,
    target: str,
    rows: Sequence[dict],
    out: Path,
    plugins: Sequence[str] = (),
    scene: bool = True,
    open_ego: bool = False,
) -> int:
    """Write the rollouts of rows of rollouts.csv into a new folder, and return how many."""
    if out.exists():
        raise InputError(f"{out}: is there already; remove it, or pass another folder with --out")
    episodes = episodes_of(run, rows, plugins, scene)
    shown = tqdm(episodes, "exporting", len(rows), unit="rollout", leave=False, disable=None)
    with written_whole(out) as folder, (folder / LIST).open("w", newline="") as file:
        writer = csv.DictWriter(file, ("file", *FACTS, "adversaries"), restval="", lineterminator="\n")
        writer.writeheader()
        for episode, path in FORMATS[target](shown, folder, open_ego):
            facts = episode.facts | {"adversaries": " ".join(map(str, episode.facts["adversaries"]))}
            writer.writerow({"file": str(path.relative_to(folder))} | facts)
    return len(rows)


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="e2rl export", description=__doc__)
    parser.add_argument("run", type=Path, metavar="RUN_DIR", help="folder of a run of evaluate.py")
    parser.add_argument("--to", required=True, choices=FORMATS, metavar="FORMAT", help=", ".join(FORMATS))
    parser.add_argument("--failures", type=int, metavar="N", help="at most so many failures (default: all)")
    parser.add_argument("--all", action="store_true", help="every rollout, not only failures")
    parser.add_argument("--method", metavar="NAME", help="rollouts in its traffic only")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="a new folder (default: RUN_DIR/export/FORMAT)")
    parser.add_argument("--open-ego", action="store_true", help="leave the ego to a planner or controller of your own")
    parser.add_argument("--no-scene", action="store_true", help="do without the data: lanes of the rollout files alone")
    parser.add_argument("--plugin", action="append", default=[], metavar="MODULE", help="the data source's; repeatable")
    options = parser.parse_args(arguments)
    with ending():
        out = options.out or own_folder(options.run, "export", options.to)
        check_format(options.to, options.open_ego)
        if options.failures is not None and options.failures < 1:
            raise InputError(f"--failures {options.failures}: expected at least 1")
        rows = chosen_rows(options.run, options.failures, options.all, options.method)
        count = export(options.run, options.to, rows, out, options.plugin, not options.no_scene, options.open_ego)
        print(f"{count} rollouts written to {out}")
