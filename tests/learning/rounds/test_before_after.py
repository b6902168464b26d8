"""The before/after table: both stages on the same scenes and seeds, the second one
paired with the first."""

import torch

from e2rl.driving.setup import Method, Setup
from e2rl.evaluation.rollout_files import METRICS_FILE, read_metrics
from e2rl.learning.rounds.before_after import BeforeAfter
from e2rl.planners.idm_planner import IDMEgo
from e2rl.sim.env import SimSettings
from e2rl.traffic.rule_based import ConstantVelocity
from tests.learning.small import Ambush, small_scenes


def test_both_stages_are_kept_and_the_second_is_compared_with_the_first(tmp_path):
    torch.manual_seed(0)
    setup = Setup(
        small_scenes(3),
        IDMEgo(),
        ego_name="idm",
        sim=SimSettings(),
    )
    methods = [
        Method("nominal", ConstantVelocity()),
        Method("ambush", Ambush(), eta=2.0),
    ]
    measure = BeforeAfter(
        setup,
        methods,
        seeds=[0],
        folder=tmp_path,
    )
    slow = IDMEgo(desired_speed=3.0, use_limits=False)
    fast = IDMEgo(desired_speed=12.0, use_limits=False)
    measure("before", slow, 0)
    same = {
        row["method"]: row
        for row in measure("after", slow, 1)
        if row["stage"] == "after"
    }
    rows = measure("after", fast, 2)
    assert str(rows) == str(read_metrics(tmp_path / METRICS_FILE))
    stages = [(row["stage"], row["method"]) for row in rows]
    assert stages == [
        (stage, method)
        for stage in ("before", "after")
        for method in ("nominal", "ambush")
    ]
    other = {row["method"]: row for row in rows if row["stage"] == "after"}
    for method in ("nominal", "ambush"):
        unchanged, changed = (
            stage[method]["paired"]["before"] for stage in (same, other)
        )
        differences = [
            [
                e["difference"]
                for name, e in paired.items()
                if e["n"] and "seconds" not in name
            ]
            for paired in (unchanged, changed)
        ]
        assert differences[0]
        assert not any(differences[0])
        assert any(differences[1])
