"""Videos: a rollout as an animated GIF, and which failures of a run are worth one."""

from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.colors import to_rgb
from PIL import Image

from e2rl.report import drawing
from e2rl.run.errors import InputError
from e2rl.run.files import write_atomically

FRAME_MS = 100  # real time at 10 Hz
LAST_MS = 1200  # the last frame of a GIF stays a little before the video starts again
COLOURS = 160  # of the GIF's palette
KEYS = (  # always in the palette
    drawing.EGO,
    drawing.ADVERSARY,
    drawing.BACKGROUND,
    drawing.VULNERABLE,
    drawing.INK,
)


def save_animation(
    path: Path,
    frames: Iterable[Image.Image],
    colours: int = COLOURS,
) -> None:
    """Write an endless GIF at 10 Hz; raises InputError for another ending of its path."""
    if path.suffix != ".gif":
        raise InputError(f"{path}: choose a name that ends in .gif")
    write_atomically(path, partial(write_gif, list(frames), colours=colours))


def write_gif(frames: Sequence[Image.Image], path: Path, colours: int) -> None:
    """Write an endless GIF; all frames share a palette, from the first, middle and last
    one and the KEYS."""
    keys = np.repeat([[255 * part for part in to_rgb(key)] for key in KEYS], 8, 0)
    swatch = np.repeat(keys[:, None], frames[0].width, 1)
    samples = [np.asarray(frames[index]) for index in (0, len(frames) // 2, -1)]
    sample = Image.fromarray(np.concatenate([*samples, swatch]).astype(np.uint8))
    plain = Image.Dither.NONE
    palette = sample.quantize(colours, method=Image.Quantize.MEDIANCUT, dither=plain)
    first, *others = [frame.quantize(palette=palette, dither=plain) for frame in frames]
    first.save(
        path,
        format="GIF",
        save_all=True,
        append_images=others,
        loop=0,
        duration=[FRAME_MS] * len(others) + [LAST_MS],
    )


def found_failures(rows: Sequence[dict], count: int) -> list[dict]:
    """Returns the first `count` rows, one per scene, in which the ego hits a vehicle.

    Adversarial rollouts (eta > 0) come first, then failures that count, then kinds of
    contact that are not among the chosen, then hits of adversaries.
    """
    hits = [row for row in rows if row["cfr"] == 1]
    chosen: list[dict] = []
    while hits and len(chosen) < count:
        kinds = [row["contact_type"] for row in chosen]

        def rank(row: dict) -> tuple:
            same = kinds.count(row["contact_type"])  # noqa: B023 - called at once
            return row["eta"] <= 0, row["counted"] != 1, same, row["cfr_adv"] != 1

        chosen.append(min(hits, key=rank))
        hits = [row for row in hits if row["scene_id"] != chosen[-1]["scene_id"]]
    return chosen
