"""Replays: an animated GIF and a strip of four moments of a rollout, from its file alone.

`python -m e2rl.report.videos RUN_DIR --failures 3` saves them for the first failures of different scenes in a run,
`--modes` for the most typical failure of each of its modes.
"""

import argparse
import sys
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from e2rl.evaluation.modes import MODES_FILE, OTHER, read_modes
from e2rl.evaluation.rollout_files import TABLE, read_rows
from e2rl.metrics.score import score_rollouts
from e2rl.report.drawing import save_figure
from e2rl.report.picture import Replay
from e2rl.run.errors import InputError
from e2rl.run.files import write_atomically
from e2rl.sim.rollouts import ROLLOUTS, Rollout, Rollouts, rollout_name

FRAME_MS = 100  # real time at 10 Hz
LAST_MS = 1200  # the last frame stays a little before the film starts again
COLOURS = 160  # of the GIF's palette


def load_replay(path: Path, metres: float = 70.0, pixels: int = 720, ghost: bool = False) -> Replay:
    """The replay of one rollout file; its contact is computed again. Raises InputError where the file is no rollout."""
    rollout = read_rollout(path)
    rows, _ = score_rollouts(as_rollout_dict([rollout]))
    return Replay(rollout, rows[0], metres, pixels, ghost)


def save_replay(replay: Replay, folder: Path) -> tuple[Path, Path]:
    """Write <name>.gif and <name>.png (the strip; also as <name>.pdf) into folder and return the first two paths."""
    name = rollout_name(XX(".npz")
    gif, png = Path(folder) / f"{name}.gif", Path(folder) / f"{name}.png"
    save_animation(gif, replay.frames())
    save_figure(png, replay.strip())
    return gif, png


def save_animation(path: Path, frames: list[Image.Image]) -> None:
    """Write an endless GIF at 10 Hz; all frames share a palette, from the first, middle and last frame."""
    sample = Image.fromarray(np.concatenate([frames[index] for index in (0, len(frames) // 2, -1)]))
    palette = sample.quantize(COLOURS, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    first, *others = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    duration = [FRAME_MS] * len(others) + [LAST_MS]
    save = partial(first.save, format="GIF", save_all=True, append_images=others, loop=0, duration=duration)
    write_atomically(path, save)


def found_failures(rows: list[dict], count: int) -> list[dict]:
    """The first `count` rows, one per scene, in which the ego hits a vehicle.

    Adversarial rollouts (eta > 0) come first, then kinds of contact that are not among the chosen, then hits of
    adversaries.
    """
    hits = sorted((row for row in rows if row["cfr"] == 1), key=lambda row: row["cfr_adv"] != 1)
    chosen: list[dict] = []
    while hits and len(chosen) < count:
        kinds = [row["contact_type"] for row in chosen]
        chosen.append(min(hits, key=lambda row: (row["eta"] <= 0, kinds.count(row["contact_type"]))))
        hits = [row for row in hits if row["scene_id"] != chosen[-1]["scene_id"]]
    return chosen


def parse_arguments(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m e2rl.report.videos", description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, metavar="RUN_DIR", help="a run's folder, or one rollout .npz")
    parser.add_argument("--failures", type=int, default=3, metavar="N", help="how many failures (default %(default)s)")
    parser.add_argument("--modes", action="store_true", help="instead, a typical failure of each mode")
    parser.add_argument("--out", type=Path, help="folder to write to (default: RUN_DIR/replays)")
    parser.add_argument("--metres", type=float, default=70.0, help="side of the picture, m (default %(default)s)")
    parser.add_argument("--pixels", type=int, default=720, help="side of the picture, pixels (default %(default)s)")
    parser.add_argument("--ghost", action="store_true", help="outline where the recording has the ego")
    return parser.parse_args(arguments)


def typical_failures(run: Path) -> dict[Path, str]:
    """{rollout file: name of the mode} of the most typical failure of each mode of a run, without small modes."""
    modes = [mode for mode in read_modes(run / MODES_FILE)["modes"] if mode["mode"] != OTHER]
    if not modes:
        raise InputError(f"{run / MODES_FILE}: no failure modes; raise eta or evaluate more scenes")
    return {
        run / ROLLOUTS / mode["typical"]["file"]: f"{mode['mode']}. {mode['name']} ({mode['count']} failures)"
        for mode in modes
    }


def chosen_paths(run: Path, failures: int) -> list[Path]:
    """The rollout files to show: the one given, or those of a run's first failures."""
    if run.is_file():
        return [run]
    chosen = found_failures(read_rows(run / TABLE), failures)
    if not chosen:
        raise InputError(
            f"{run / TABLE}: no rollout in which the ego hits a vehicle; raise eta or evaluate more scenes"
        )
    return [run / ROLLOUTS / rollout_name(row) for row in chosen]


def main(arguments: list[str] | None = None) -> int:
    options = parse_arguments(arguments)
    folder = options.out or (options.run.parent if options.run.is_file() else options.run) / "replays"
    try:
        modes = typical_failures(options.run) if options.modes else {}
        for path in modes or chosen_paths(options.run, options.failures):
            if path in modes:
                print(modes[path])
            replay = load_replay(path, options.metres, options.pixels, options.ghost)
            for saved in save_replay(replay, folder):
                print(saved)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
