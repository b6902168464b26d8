"""The atlas: only preventable failures, the least nats of each cell, whatever the order
of the rows."""

import math
import random

import pytest

from e2rl.metrics.atlas import CELL, atlas_of, by_likelihood, cell_of
from tests.metrics.test_failure_modes import CROSSING, crowd, failure

DUTIES = ("none", "wrong way")


def found(scene="a", seed=0, **changes):
    """A preventable failure of one and the same cell."""
    return failure(
        CROSSING | {"duty": "none", "cfr_preventable": 1.0}, scene, seed=seed, **changes
    )


def many(number=300):
    """Failures of all kinds, a third of them not preventable; some have equal or
    unknown nats and realism."""
    draw = random.Random(1)
    rows = crowd(number)
    for seed, row in enumerate(rows):
        row["seed"] = seed
        row["cfr_preventable"] = draw.choice((0.0, 1.0, 1.0))
        row["duty"] = draw.choice(DUTIES)
        row["transport"] = draw.choice((0.0, 5.0, math.nan, draw.uniform(0, 100)))
        row["real_adv"] = draw.choice((0.5, math.nan, draw.random()))
        row["scene_id"] = f"scene {draw.randrange(number // 10)}"
    return rows


def test_only_preventable_failures_enter():
    rows = many()
    preventable = [row for row in rows if row["cfr_preventable"] == 1]
    atlas = atlas_of(rows)
    assert 0 < len(preventable) < len(rows)
    assert atlas == atlas_of(preventable)
    assert sum(map(len, atlas.values())) == len(preventable)
    for value in (0.0, math.nan):
        assert cell_of(found(cfr_preventable=value)) is None
    assert cell_of(failure(CROSSING)) is None  # a run that knows no verdicts
    assert cell_of(found(cfr=0.0, approach="")) is None


def test_a_cell_keeps_its_failure_with_the_least_nats_and_counts_all():
    rows = many()
    atlas = atlas_of(rows)
    nats = {}
    for row in rows:
        if (cell := cell_of(row)) is not None:
            nats.setdefault(cell, []).append(
                (math.inf if math.isnan(row["transport"]) else row["transport"], row)
            )
    assert set(atlas) == set(nats)
    assert len(atlas) > 20
    for cell, failures in atlas.items():
        least = min(value for value, _ in nats[cell])
        assert cell_of(failures[0]) == cell
        assert failures[0]["transport"] == least or least == math.inf
        assert len(failures) == len(nats[cell])
        assert all(row in failures for _, row in nats[cell])
    order = [by_likelihood(failures[0]) for failures in atlas.values()]
    assert order == sorted(order)  # the cells, too, by likelihood


def test_the_order_of_the_rows_does_not_matter():
    rows = many()
    expected = list(atlas_of(rows).items())
    for seed in range(5):
        random.Random(seed).shuffle(rows)
        assert list(atlas_of(rows).items()) == expected


def test_ties_go_to_the_realism_then_to_scene_and_seed():
    rows = [
        found("b", 3, transport=7.0, real_adv=0.9),
        found("c", 1, transport=8.0, real_adv=0.6),
        found("a", 1, transport=8.0, real_adv=0.5),
        found("a", 2, transport=8.0, real_adv=0.5),
        found("b", 0, transport=8.0, real_adv=0.5),
        found("a", 0, transport=8.0, real_adv=math.nan),
        found("a", 0, transport=math.nan, real_adv=1.0),
        found("a", 1, transport=math.inf, real_adv=0.9),
    ]
    for start in range(len(rows)):  # each is the likeliest of those after it
        left = rows[start:]
        assert atlas_of(left[::-1]) == {cell_of(rows[0]): left}


@pytest.mark.parametrize(
    ("speed", "band"),
    [
        (0.0, "0 to 5 m/s"),
        (4.99, "0 to 5 m/s"),
        (5.0, "5 to 10 m/s"),
        (31.0, "30 to 35 m/s"),
    ],
)
def test_a_cell_is_five_words(speed, band):
    cell = cell_of(found(ego=speed))
    assert dict(zip(CELL, cell, strict=True)) == {
        **{
            name: CROSSING[name]
            for name in ("approach", "partner_manoeuvre", "contact_type")
        },
        "duty": "none",
        "speed_band": band,
    }
    for name in ("approach", "partner_manoeuvre", "duty", "contact_type"):
        assert cell_of(found(ego=speed, **{name: "another"})) != cell


def test_what_a_row_does_not_know_is_empty():
    assert cell_of(found(ego=math.nan, duty="")) == (
        *cell_of(found())[:2],
        "",
        "",
        "side",
    )
