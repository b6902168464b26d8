"""The rollout of the intensity figure: unharmed at first, then hit ever earlier."""

from e2rl.evaluation.rollout_files import TABLE, write_rows
from e2rl.report.intensity import intensity_sweep, worth
from e2rl.sim.rollout_file import ROLLOUTS

NAN = float("nan")


def ladder(*times, scene="a", seed=0):
    """Rows at eta 0, 1, ... with contacts at these times (NaN: none)."""
    return [
        {
            "method": "e2",
            "ego_policy": "idm",
            "scene_id": scene,
            "seed": seed,
            "eta": float(eta),
            "cfr": float(time == time),
            "contact_time": time,
            "min_dtc": 1.0 + eta,
            "partner": 1,
        }
        for eta, time in enumerate(times)
    ]


def test_what_eta_does_shows_best_where_contacts_come_and_then_come_earlier():
    order = [
        ladder(3.0, 2.0, 1.0),
        ladder(NAN, 3.0, NAN),
        ladder(NAN, NAN, NAN),
        ladder(NAN, NAN, 2.0),
        ladder(NAN, 2.0, 2.5),
        ladder(NAN, 2.5, 2.4),
        ladder(NAN, 3.5, 2.4),
    ]
    assert sorted(order, key=worth) == order


def test_the_files_are_those_of_one_scene_and_seed_by_eta(tmp_path):
    rows = [*ladder(NAN, 4.0, 3.0, seed=1), *ladder(NAN, 4.0, 1.0, scene="b", seed=2), *ladder(NAN, 4.0, scene="c")]
    write_rows(tmp_path / TABLE, [dict(row, dataset="made", split="test") for row in rows[::-1]])
    assert intensity_sweep(tmp_path) == [tmp_path / ROLLOUTS / f"e2__idm__{eta}__b__2.npz" for eta in (0, 1, 2)]
