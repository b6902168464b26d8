"""Videos: an animated GIF of a rollout, and which failures of a run are worth one."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.colors import to_rgb
from PIL import Image

from e2rl.report import drawing
from e2rl.run.files import write_atomically

FRAME_MS = 100  # real time at 10 Hz
LAST_MS = 1200  # the last frame stays a little before the video starts again
COLOURS = 160  # of the GIF's palette
KEYS = (drawing.EGO, drawing.ADVERSARY, drawing.BACKGROUND, drawing.VULNERABLE, drawing.INK)  # always in the palette


def save_animation(path: Path, frames: Sequence[Image.Image], colours: int = COLOURS) -> None:
    """Write an endless GIF at 10 Hz; all frames share a palette, from the first, middle and last one and the KEYS."""
    swatch = np.tile(np.repeat([[255 * part for part in to_rgb(each)] for each in KEYS], 8, 0), (frames[0].width, 1, 1))
    parts = [*(np.asarray(frames[index]) for index in (0, len(frames) // 2, -1)), swatch.transpose(1, 0, 2)]
    sample = Image.fromarray(np.concatenate(parts).astype(np.uint8))
    palette = sample.quantize(colours, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    first, *others = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    duration = [FRAME_MS] * len(others) + [LAST_MS]
    save = partial(first.save, format="GIF", save_all=True, append_images=others, loop=0, duration=duration)
    write_atomically(path, save)


def found_failures(rows: Sequence[dict], count: int) -> list[dict]:
    """Returns the first `count` rows, one per scene, in which the ego hits a vehicle.

    Adversarial rollouts (eta > 0) come first, then failures that count, then kinds of contact that are not among the
    chosen, then hits of adversaries.
    """
    hits = sorted((row for row in rows if row["cfr"] == 1), key=lambda row: row["cfr_adv"] != 1)
    chosen: list[dict] = []
    while hits and len(chosen) < count:
        kinds = [row["contact_type"] for row in chosen]
        chosen.append(
            min(hits, key=lambda row: (row["eta"] <= 0, row["counted"] != 1, kinds.count(row["contact_type"])))
        )
        hits = [row for row in hits if row["scene_id"] != chosen[-1]["scene_id"]]
    return chosen
