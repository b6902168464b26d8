"""`e2rl replay RUN_DIR`: videos (GIF) and strips of four moments (PNG, PDF) of the first failures of a run."""

import argparse
from collections.abc import Iterator
from pathlib import Path

from e2rl.evaluation.modes import MODES_FILE, OTHER, read_modes
from e2rl.evaluation.rollout_files import TABLE, read_rows
from e2rl.metrics.score import score_rollouts
from e2rl.report.picture import Replay
from e2rl.report.videos import found_failures, save_replay
from e2rl.run.endings import ending
from e2rl.run.errors import InputError
from e2rl.sim.rollout_file import Failure, Rollout, rollout_name
from e2rl.sim.rollouts import Rollouts


def chosen(run: Path, failures: int, modes: bool) -> Iterator[tuple[str, Failure]]:
    """(title, rollout) of what is shown: a file alone, a run's first failures, or a typical failure of each mode."""
    if run.is_file():
        rollout = Rollout.read(run)
        yield "", Failure(rollout, score_rollouts(Rollouts.of([rollout]))[0][0])
        return
    rows = read_rows(run / TABLE)
    found = [("", row) for row in found_failures(rows, failures)]
    if modes:
        files = {rollout_name(row): row for row in rows}
        found = [
            (f"{mode['mode']}. {mode['name']} ({mode['count']} failures)", files[mode["typical"]["file"]])
            for mode in read_modes(run / MODES_FILE)["modes"]
            if mode["mode"] != OTHER
        ]
    if not found:
        raise InputError(
            f"{run / TABLE}: no rollout in which the ego hits a vehicle; raise eta or evaluate more scenes"
        )
    for title, row in found:
        yield title, Failure.read(run, row)


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="e2rl replay", description=__doc__)
    parser.add_argument("run", type=Path, metavar="RUN_DIR", help="a run's folder, or one rollout .npz")
    parser.add_argument("--failures", type=int, default=3, metavar="N", help="how many failures (default %(default)s)")
    parser.add_argument("--modes", action="store_true", help="instead, a typical failure of each mode")
    parser.add_argument("--out", type=Path, help="folder to write to (default: RUN_DIR/replays)")
    parser.add_argument("--metres", type=float, default=70.0, help="side of the picture, m (default %(default)s)")
    parser.add_argument("--pixels", type=int, default=720, help="side of the picture, pixels (default %(default)s)")
    parser.add_argument("--ghost", action="store_true", help="outline where the recording has the ego")
    options = parser.parse_args(arguments)
    folder = options.out or (options.run.parent if options.run.is_file() else options.run) / "replays"
    with ending():
        for title, shown in chosen(options.run, options.failures, options.modes):
            replay = Replay(shown.rollout, shown.row, options.metres, options.pixels, options.ghost)
            print(*filter(None, [title]), *save_replay(replay, folder), sep="\n")


if __name__ == "__main__":
    main()
