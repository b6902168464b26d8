"""What lanes make of the drivable field, against a search through all of their points."""

import numpy as np
import pytest

from e2rl.scenes.lane_cover import (
    FAR,
    INSIDE,
    MARGIN,
    LaneCover,
)
from e2rl.scenes.paths import resample


def lanes(seed: int) -> tuple[list[np.ndarray], np.ndarray]:
    """Lanes of few widths that cross one another near [900, -400], some beside others,
    and one twice."""
    generator = np.random.default_rng(seed)
    lines = []
    for _ in range(6):
        heading = generator.uniform(0, 2 * np.pi) + np.cumsum(
            generator.normal(0, 0.2, 20)
        )
        line = np.cumsum(4 * np.stack([np.cos(heading), np.sin(heading)], 1), axis=0)
        lines.append(
            resample(
                line - line.mean(0) + generator.uniform(-20, 20, 2) + [900.0, -400.0],
                1.0,
            )
        )
    lines += [lines[0] + [3.0, 0.5], lines[1]]
    return lines, generator.choice([2.5, 3.7, 3.72, 5.5, 6.0], len(lines))


def searched(
    lines: list[np.ndarray],
    widths: np.ndarray,
    corner: np.ndarray,
    cells: int,
) -> np.ndarray:
    cell = corner + np.stack(
        np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij"), -1
    )
    field = np.full((cells, cells), FAR)
    widths = np.round(widths, 1)
    for width in np.unique(widths)[::-1]:
        points = np.concatenate(
            [
                line
                for line, lane_width in zip(lines, widths, strict=True)
                if lane_width == width
            ]
        )
        away = (
            np.sqrt(((cell[:, :, None] - points) ** 2).sum(-1)).min(-1)
            - width / 2
            - MARGIN
        )
        field = np.where(field > -INSIDE, np.minimum(field, away), field)
    return field


@pytest.mark.parametrize("seed", range(4))
def test_it_is_what_a_search_finds_in_all_scenes_of_a_log(seed):
    """Whether points of a tile are chosen for the first scene, or for one whose field
    lies apart from it."""
    lines, widths = lanes(seed)
    cover = LaneCover(lines, widths)
    for origin, corner in (
        ([900.0, -400.0], [-33.3, -40.9]),
        ([912.0, -407.0], [-31.6, -38.2]),
        ([0.0, 0.0], [720, -400]),
    ):
        covered = cover.beyond(np.array(origin), np.array(corner), 83)
        assert (
            np.abs(
                covered
                - searched(
                    lines,
                    widths,
                    corner=np.add(origin, corner),
                    cells=83,
                )
            ).max()
            < 1e-9
        )
        assert np.array_equal(
            covered,
            LaneCover(lines, widths).beyond(np.array(origin), np.array(corner), 83),
        )
        assert (covered < -INSIDE).any() and (covered == FAR).any() or not any(origin)


def test_without_lanes_all_is_far():
    assert (
        LaneCover([], np.zeros(0)).beyond(np.zeros(2), np.zeros(2), 20) == FAR
    ).all()
