"""Colours of an image at world points of a map."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from PIL import Image


def rgb(colour: str) -> tuple[int, ...]:
    return tuple(round(255 * part) for part in to_rgb(colour))


def pixel_at(image: Image.Image, axes: Axes, point: np.ndarray) -> tuple[int, ...]:
    """The colour where the axes show a world point [2] m."""
    column, height = axes.transData.transform(point)
    return image.getpixel((int(column), int(image.height - height)))
