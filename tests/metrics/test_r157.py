"""Drivers against UN Regulation No. 157 itself, by closed forms that share nothing with
e2rl.

`r157_cut_in.csv` has, for cut-ins of vehicles of 1.9 m on lanes of 3.5 m, the least
distance between bumpers at which they can be survived, measured when the other has
reached its lateral speed in the middle of its lane:

- `human_m`: by the performance model of the competent and careful human driver (Annex
  4, Appendix 3: 0.75 s from the perception to braking, which reaches 0.774 g after 0.6
  s), who perceives the other when the sides overlap, and eases off by 0.4 m/s^2 until
  it brakes;
- `regulation_m`: by paragraph 5.2.5.2 (TTC > v_rel / (2 x 6 m/s^2) + 0.35 s, when the
  other is 0.3 m beyond the lane marking).
"""

import csv
from pathlib import Path

import numpy as np
import pytest
import torch

from e2rl.metrics.drivers import DRIVERS
from tests.metrics.cut_ins import CutIn, simulate_cut_ins

TABLE = Path(__file__).with_name("r157_cut_in.csv")
ASIDE, INTRUSION = (
    1.6,
    1.1,
)  # m that the other moves aside until the sides overlap; until it is 0.3 m in the lane
TIME = {
    "human": 0.05,
    "regulation": 0.15,
}  # s that simulated drivers, who act at steps of 0.1 s, are off by at most


def human(closing, lateral):
    """The way that the distance shrinks until both are equally fast, from when the
    other begins."""
    easing = 0.4
    delay = 0.75
    most = 0.774 * 9.81
    jerk = 0.774 * 9.81 / 0.6
    ramp = (most - easing) / jerk
    slower = (
        closing - easing * delay - (easing + most) / 2 * ramp
    )  # once the brake is full
    way = closing * delay - easing * delay**2 / 2
    way += (closing - easing * delay) * ramp - easing * ramp**2 / 2 - jerk * ramp**3 / 6
    return closing * ASIDE / lateral + way + slower**2 / (2 * most)


def regulation(closing, lateral):
    return closing * INTRUSION / lateral + closing * (closing / (2 * 6.0) + 0.35)


def table():
    with TABLE.open(newline="") as file:
        return {
            name: np.array(column, float)
            for name, *column in zip(*csv.reader(file), strict=True)
        }


def test_the_table_is_what_the_regulation_says():
    rows = table()
    closing = (rows["ego_kmh"] - rows["cut_in_kmh"]) / 3.6
    lateral = rows["lateral_mps"]
    assert len(lateral) >= 30
    assert closing.min() >= 5
    assert closing.max() <= 50 / 3.6, "TTC of 2 s is enough to stop"
    np.testing.assert_allclose(rows["human_m"], human(closing, lateral), atol=0.006)
    np.testing.assert_allclose(
        rows["regulation_m"], regulation(closing, lateral), atol=0.006
    )


@pytest.mark.parametrize("name", TIME)
def test_a_little_more_room_is_survived_and_a_little_less_is_not(name):
    rows = {key: torch.from_numpy(column) for key, column in table().items()}
    speed = rows["ego_kmh"] / 3.6
    other = rows["cut_in_kmh"] / 3.6
    for sign in (1, -1):
        gap = rows[f"{name}_m"] + sign * TIME[name] * (speed - other)
        crash = simulate_cut_ins(
            DRIVERS[name],
            CutIn(speed, other, gap=gap, lateral_speed=rows["lateral_mps"]),
        )
        assert (crash == (sign < 0)).all(), (
            sign,
            (crash == (sign > 0)).nonzero()[:, 0].tolist(),
        )
