"""The curve of a tuning: which trials are on it, its order, and files that hold every trial."""

import csv
import math

from PIL import Image

from e2rl.report.tuning_curve import on_curve, save_tuning_curve


def trial(gain, step, cfr, admissible=True, realism=0.8):
    metrics = {"cfr": cfr, "cfr_low": cfr - 0.1, "cfr_high": cfr + 0.1, "real_adv": realism}
    metrics |= {"cfr_counted": cfr / 2, "cfr_counted_low": math.nan, "cfr_counted_high": math.nan}
    return {"parameters": {"gain": gain, "step_size": step}, "metrics": metrics, "admissible": admissible}


TRIALS = [
    trial(0.5, 0.3, 0.3),
    trial(2.0, 0.3, 0.5, False, 0.5),
    trial(0.1, 0.3, 0.1, realism=math.nan),
    trial(1.0, 0.7, 0.4),
]


def test_the_curve_varies_the_gain_alone_in_its_order():
    assert [each["parameters"]["gain"] for each in on_curve(TRIALS)] == [0.1, 0.5, 2.0]


def test_every_trial_is_in_the_table_and_the_picture_has_both_panels(tmp_path):
    save_tuning_curve(tmp_path, TRIALS, "ctg_adv")
    with (tmp_path / "tuning_curve.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["trial"], row["on_curve"], row["admissible"]) for row in rows] == [
        ("2", "1", "1"),
        ("0", "1", "1"),
        ("3", "0", "1"),
        ("1", "1", "0"),
    ]
    assert rows[0]["real_adv"] == "" and float(rows[3]["cfr_high"]) == 0.6
    with Image.open(tmp_path / "tuning_curve.png") as picture:
        assert picture.width > 2 * picture.height
