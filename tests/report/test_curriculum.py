"""The heat map of a curriculum's choices: what stands in its cells, and where it comes
from."""

import math

import numpy as np

from e2rl.learning.logging import RunLogger
from e2rl.learning.scheduler import COLUMNS
from e2rl.report.curriculum_figure import CHOICES, PICTURE, draw_choices, grids

NAN = math.nan


def row(number, eta, template, draws, episodes=0, failures=0):
    rate = failures / episodes if episodes else NAN
    return dict(
        zip(
            COLUMNS,
            (number, eta, template, draws, 0, episodes, failures, rate, NAN),
            strict=True,
        )
    )


ROWS = [
    row(0, 1.0, template="pair", draws=3, episodes=4, failures=1),
    row(0, 0.5, template="full", draws=1),
    row(1, 2.0, template="single", draws=2, episodes=5, failures=5),
    row(1, 1.0, template="pair", draws=0),
]


def test_cells_are_fractions_of_a_round_s_draws_and_of_failed_episodes():
    rounds, arms, share, rate = grids(ROWS)
    assert rounds == [0, 1] and arms == [("single", 2.0), ("pair", 1.0), ("full", 0.5)]
    np.testing.assert_array_equal(share, [[NAN, 1.0], [0.75, NAN], [0.25, NAN]])
    np.testing.assert_array_equal(rate, [[NAN, 1.0], [0.25, NAN], [NAN, NAN]])


def test_the_picture_is_drawn_from_the_file_of_a_run(tmp_path):
    draw_choices(tmp_path)
    assert not list(tmp_path.iterdir()), "nothing was logged"
    logger = RunLogger("csv", tmp_path)
    for number in (0, 1, 1):  # the last round twice, as a resumed run may
        logger.log({}, number, [each for each in ROWS if each["round"] == number])
    lines = (tmp_path / CHOICES).read_text().splitlines()
    assert (
        lines[0] == ",".join(COLUMNS)
        and len(lines) == 5
        and lines[1].startswith("0,1.0,pair,3,0,4,1,0.25,")
    )
    draw_choices(tmp_path)
    assert (tmp_path / PICTURE).stat().st_size > 5000
