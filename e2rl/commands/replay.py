"""`e2rl replay RUN_DIR`: videos of failures of a run, first those that count, one of a
scene."""

import argparse
from collections.abc import Iterator
from pathlib import Path

from e2rl.evaluation.modes import OTHER, read_modes
from e2rl.evaluation.rollout_files import MODES_FILE, TABLE, own_folder, read_rows
from e2rl.metrics.score import score_rollouts
from e2rl.report.picture import Replay
from e2rl.report.videos import found_failures, save_animation
from e2rl.run.endings import ending
from e2rl.run.errors import InputError
from e2rl.sim.rollout_file import Failure, Rollout, rollout_name
from e2rl.sim.rollouts import Rollouts


def chosen(run: Path, failures: int, modes: bool) -> Iterator[tuple[str, Failure]]:
    """(title, rollout) of what is shown: a file alone, a run's first failures, or a
    typical failure of each mode."""
    if run.is_file():
        rollout = Rollout.read(run)
        yield "", Failure(rollout, score_rollouts(Rollouts.of([rollout]))[0][0])
        return
    rows = read_rows(run / TABLE)
    titled = [("", row) for row in found_failures(rows, failures)]
    if modes:
        titled = []
        files = {rollout_name(row): row for row in rows}
        for mode in read_modes(run / MODES_FILE)["modes"]:
            file = mode["typical"]["file"]
            if file not in files:
                raise InputError(
                    f"{run / MODES_FILE}: {file} is not in {TABLE}; run evaluate.py "
                    "again to rewrite both"
                )
            if mode["mode"] != OTHER:
                title = f"{mode['mode']}. {mode['name']} ({mode['count']} failures)"
                titled.append((title, files[file]))
    if not titled:
        raise InputError(
            f"{run / TABLE}: no rollout in which the ego hits a vehicle; raise eta or "
            "evaluate more scenes"
        )
    for title, row in titled:
        yield title, Failure.read(run, row)


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="e2rl replay", description=__doc__)
    parser.add_argument(
        "run",
        type=Path,
        metavar="RUN_DIR",
        help="a run's folder, or one rollout .npz",
    )
    parser.add_argument(
        "--failures",
        type=int,
        default=3,
        metavar="N",
        help="how many failures (default %(default)s)",
    )
    parser.add_argument(
        "--modes",
        action="store_true",
        help="instead, a typical failure of each mode",
    )
    parser.add_argument(
        "--out",
        type=Path,
        help="folder to write to (default: RUN_DIR/replays)",
    )
    parser.add_argument(
        "--metres",
        type=float,
        default=70.0,
        help="side of the picture, m (default %(default)s)",
    )
    parser.add_argument(
        "--pixels",
        type=int,
        default=720,
        help="side of the picture, pixels (default %(default)s)",
    )
    options = parser.parse_args(arguments)
    with ending():
        run = options.run.parent if options.run.is_file() else options.run
        folder = options.out or own_folder(run, "replays")
        for title, failure in chosen(options.run, options.failures, options.modes):
            name = f"{failure.rollout.name.removesuffix('.npz')}.gif"
            path = folder / name if options.out else own_folder(folder, name)
            replay = Replay(
                failure.rollout,
                failure.row,
                metres=options.metres,
                pixels=options.pixels,
            )
            save_animation(path, replay.frames())
            if title:
                print(title)
            print(path)
