"""atlas.json: the cells of each ego, method and intensity."""

import json

from e2rl.evaluation.atlas import find_atlas
from e2rl.evaluation.rollout_files import ATLAS_FILE, write_json
from e2rl.sim.rollout_file import rollout_name
from tests.evaluation.test_modes import crashes
from tests.metrics.test_failure_modes import CROSSING, REAR_END


def run_rows():
    sure = {"cfr_preventable": 1.0, "duty": "none", "real_adv": 0.5}
    rows = crashes(CROSSING, 3, transport=9.0, **sure) + crashes(
        REAR_END, 2, transport=float("nan"), **sure
    )
    rows += crashes(CROSSING, 1, method="random", transport=4.0, **sure) + crashes(
        REAR_END, 1, method="random", cfr_preventable=0.0
    )
    return rows + crashes(CROSSING, 2, method="nominal", eta=0.0, cfr=0.0, approach="")


def test_every_group_has_its_own_atlas(tmp_path):
    rows = run_rows()
    write_json(tmp_path / ATLAS_FILE, find_atlas(rows))
    e2, other, nominal = json.loads((tmp_path / ATLAS_FILE).read_text())["groups"]
    counts = [
        (group["rollouts"], group["preventable"], group["cells"])
        for group in (e2, other, nominal)
    ]
    assert counts == [(5, 5, 2), (2, 1, 1), (2, 0, 0)]
    assert nominal["atlas"] == []
    assert [(group["scenes"], group["failed_scenes"]) for group in (e2, nominal)] == [
        (len({row["scene_id"] for row in rows if row["method"] == name}), failed)
        for name, failed in ((e2["method"], 5), ("nominal", 0))
    ]
    crossing, rear_end = e2["atlas"]
    assert (crossing["approach"], crossing["speed_band"]) == (
        CROSSING["approach"],
        "10 to 15 m/s",
    )
    assert (crossing["failures"], crossing["scenes"], crossing["transport"]) == (
        3,
        3,
        9.0,
    )
    assert rear_end["transport"] is None
    assert other["atlas"][0]["transport"] == 4.0
    assert crossing["likeliest"]["file"] == rollout_name(rows[0])
