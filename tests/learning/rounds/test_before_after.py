"""The before/after table: both stages on the same scenes and seeds, the second one
paired with the first."""

import torch

from e2rl.api import load_prior, make_traffic
from e2rl.driving.setup import Method, Setup
from e2rl.evaluation.rollout_files import METRICS_FILE, read_metrics
from e2rl.learning.rounds.before_after import BeforeAfter
from e2rl.planners.ego import PLAN_STEPS
from e2rl.planners.idm_planner import IDMEgo
from e2rl.sim.settings import SimSettings
from e2rl.tail.settings import RateSettings
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


class Standing(IDMEgo):
    """Stands where it is."""

    def plan(self, world):
        here = world.states[:, :1] * torch.tensor([1.0, 1.0, 1.0, 0.0])
        return here.expand(-1, PLAN_STEPS, -1)


def test_rates_of_both_stages_are_of_the_same_traffic(tmp_path):
    """An ego has the rates that it had; one that stands drives no kilometre more."""
    torch.manual_seed(0)
    measure = BeforeAfter(
        Setup(small_scenes(2), IDMEgo(), ego_name="idm", sim=SimSettings()),
        [],
        seeds=[3],
        folder=tmp_path,
        rates=RateSettings(method="plain", first=4, particles=4, rollouts=4),
        prior_traffic=make_traffic("nominal", load_prior(sampler={"steps": 2})),
    )
    measure("before", IDMEgo(), 0)
    measure("after", IDMEgo(), 1)
    before, same = measure.ego_rates()
    assert before.scenes == same.scenes
    assert (
        before.rates["contact"]["scene"].value == same.rates["contact"]["scene"].value
    )
    assert [scene["rollouts"] for scene in before.scenes] == [4, 4]
    measure("after", Standing(), 2)
    _, after = measure.ego_rates()
    km = [sum(scene["km"] for scene in rates.scenes) for rates in (before, after)]
    assert km[1] < km[0] / 2
