"""Replays: an animated GIF and a strip of four moments of a rollout, from its file alone.

`python -m e2rl.report.replay RUN_DIR --failures 3` saves those of the first distinct failures that a run found.
"""

import argparse
import io
import sys
from pathlib import Path

from PIL import Image

from e2rl.errors import InputError
from e2rl.evaluation.files import ROLLOUTS, TABLE, read_rows, rollout_name
from e2rl.evaluation.rollout_reader import as_rollout_dict, read_rollout
from e2rl.files import write_atomically
from e2rl.metrics.score import score_rollouts
from e2rl.report import drawing
from e2rl.report.picture import Replay

FRAME_MS = 100  # real time at 10 Hz
LAST_MS = 1200  # the last frame stays a little before the film starts again
COLOURS = 160  # one palette for all frames: nothing flickers
UNGUIDED = ("nominal", "replay")  # methods that look for no failure


def load_replay(path: Path, metres: float = 70.0, pixels: int = 720, ghost: bool = False) -> Replay:
    """The replay of one rollout file; its contact is scored anew. InputError where the file is no rollout."""
    rollout = read_rollout(path)
    rows, _ = score_rollouts(as_rollout_dict([rollout]))
    return Replay(rollout, rows[0], metres, pixels, ghost)


def save_replay(replay: Replay, folder: Path) -> tuple[Path, Path]:
    """Write <name>.gif and <name>.png (the strip) into folder and return their paths."""
    name = rollout_name(replay.rollout).removesuffix(".npz")
    gif, png = Path(folder) / f"{name}.gif", Path(folder) / f"{name}.png"
    write_atomically(gif, animation(replay.frames()))
    drawing.save_picture(png, replay.strip())
    return gif, png


def animation(frames: list[Image.Image]) -> bytes:
    """An endless GIF at 10 Hz; one palette, made from its first, middle and last frame, serves all frames."""
    width, height = frames[0].size
    sample = Image.new("RGB", (width, 3 * height))
    for index, frame in enumerate((frames[0], frames[len(frames) // 2], frames[-1])):
        sample.paste(frame, (0, index * height))
    palette = sample.quantize(COLOURS, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    flat = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    buffer = io.BytesIO()
    flat[0].save(
        buffer,
        "GIF",
        save_all=True,
        append_images=flat[1:],
        loop=0,
        optimize=False,
        duration=[FRAME_MS] * (len(flat) - 1) + [LAST_MS],
    )
    return buffer.getvalue()


def found_failures(rows: list[dict], count: int) -> list[dict]:
    """The first `count` rows, one per scene, in which the ego hits a vehicle.

    New kinds of contact come first, then hits of adversaries.
    Methods that look for failures come before `nominal` and `replay`, which serve where there are no others.
    """
    hits = [row for row in rows if row["cfr"] == 1]
    hits.sort(key=lambda row: (row["method"] in UNGUIDED, row["cfr_adv"] != 1))
    chosen: list[dict] = []
    while hits and len(chosen) < count:
        scenes = {row["scene_id"] for row in chosen}
        hits = [row for row in hits if row["scene_id"] not in scenes]
        kinds = [row["contact_type"] for row in chosen]
        if hits:
            chosen.append(min(hits, key=lambda row: (row["method"] in UNGUIDED, kinds.count(row["contact_type"]))))
    return chosen


def parse_arguments(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m e2rl.report.replay", description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, metavar="RUN_DIR", help="a run's folder, or one rollout .npz")
    parser.add_argument("--failures", type=int, default=3, metavar="N", help="how many failures (default %(default)s)")
    parser.add_argument("--out", type=Path, help="folder to write to (default: RUN_DIR/replays)")
    parser.add_argument("--metres", type=float, default=70.0, help="side of the picture, m (default %(default)s)")
    parser.add_argument("--pixels", type=int, default=720, help="side of the picture, pixels (default %(default)s)")
    parser.add_argument("--ghost", action="store_true", help="outline where the recording has the ego")
    return parser.parse_args(arguments)


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
        for path in chosen_paths(options.run, options.failures):
            replay = load_replay(path, options.metres, options.pixels, options.ghost)
            for saved in save_replay(replay, folder):
                print(saved)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
