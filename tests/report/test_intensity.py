"""The rollout of the intensity figure: unharmed at first, then hit ever earlier."""

from e2rl.report.intensity import best_sweep, worth

NAN = float("nan")


def sweep(*times, scene="a", seed=0):
    """Rows at eta 0, 1, ... with contacts at these times (NaN: none)."""
    same = {"method": "e2", "ego_policy": "idm", "scene_id": scene, "seed": seed, "partner": 1}
    found = enumerate(times)
    return [same | {"eta": eta, "cfr": time == time, "contact_time": time, "min_dtc": 1.0 + eta} for eta, time in found]


def test_what_eta_does_shows_best_where_contacts_come_and_then_come_earlier():
    order = [
        sweep(3.0, 2.0, 1.0),
        sweep(NAN, 3.0, NAN),
        sweep(NAN, NAN, NAN),
        sweep(NAN, NAN, 2.0),
        sweep(NAN, 2.0, 2.5),
        sweep(NAN, 2.5, 2.4),
        sweep(NAN, 3.5, 2.4),
    ]
    assert sorted(order, key=worth) == order


def test_the_rows_are_those_of_one_scene_and_seed_by_eta():
    rows = [*sweep(NAN, 4.0, 3.0, seed=1), *sweep(NAN, 4.0, 1.0, scene="b", seed=2), *sweep(NAN, 4.0, scene="c")]
    found = best_sweep(rows[::-1])
    assert [(row["scene_id"], row["seed"], row["eta"]) for row in found] == [("b", 2, eta) for eta in (0.0, 1.0, 2.0)]
