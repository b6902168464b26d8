"""Open loop: closed forms for constant velocity, who predicts, and what samples may
change."""

import math

import pytest
import torch

from e2rl.evaluation.open_loop import open_loop_rows
from e2rl.evaluation.protocol import Method
from e2rl.metrics.catalogue import OPEN_LOOP_STAGE, STAGES
from e2rl.metrics.displacement import HORIZONS
from e2rl.prior.sde import SamplerSettings
from e2rl.traffic.nominal import NominalTraffic
from e2rl.traffic.rule_based import IDM, ConstantVelocity, LogReplay
from tests.prior.small import small_prior
from tests.traffic.e2.traffic_scenes import scenes, synthesizer

STRAIGHT = Method("constant_velocity", ConstantVelocity())


def nominal():
    return NominalTraffic(small_prior(sampler=SamplerSettings(steps=4)))


def places(count=4, acceleration=0.0, steps=60):
    """Scenes at two places in which everybody drives at constant acceleration."""
    scene_set = scenes(count, steps=steps)
    time = 0.1 * torch.arange(steps + 1)
    moving = scene_set.scenes["start"][..., 3] > 0
    scene_set.scenes["logged"][..., 0] += (
        acceleration / 2 * time[:, None] ** 2 * moving[:, None]
    )
    scene_set.location[:] = ["p", "q"] * (count // 2)
    return scene_set


def metrics(scene_set, method=STRAIGHT, samples=3):
    return open_loop_rows(scene_set, [method], samples=samples)[0]["metrics"]


def test_constant_velocity_is_off_by_what_the_log_accelerates():
    found = metrics(places(acceleration=1.2))
    for horizon, steps in zip(HORIZONS, (30, 50), strict=True):
        expected = (0.6 * (0.1 * torch.arange(1, steps + 1)) ** 2).mean().item()
        for name in ("min_ade", "mean_ade", "joint_ade", "cv_ade"):
            assert found[f"{name}_{horizon}"]["mean"] == pytest.approx(
                expected, rel=1e-4
            ), name
        assert found[f"min_ade_ratio_{horizon}"]["mean"] == pytest.approx(1)


def test_every_figure_of_the_catalogue_counts_the_moving_vehicles_but_not_the_ego():
    found = metrics(places())
    assert set(found) == {metric.name for metric in STAGES[OPEN_LOOP_STAGE]}
    assert {row["n"] for row in found.values()} == {
        4 * 4
    }  # six vehicles, of which the ego and a parked one do not
    short = metrics(places(steps=40))
    assert (
        short["cv_ade_3"]["n"] == 16
        and short["cv_ade_5"]["n"] == 0
        and math.isnan(short["min_ade_5"]["mean"])
    )


def test_who_looks_the_future_up_or_attacks_has_no_row_and_baselines_have_one_sample():
    methods = [
        Method("replay", LogReplay()),
        STRAIGHT,
        Method("idm", IDM(small_prior())),
        Method("nominal", nominal()),
        Method("e2", synthesizer(), eta=2.0),
    ]
    rows = open_loop_rows(places(2), methods, samples=3)
    known = {row["method"]: (row["n_seeds"], row["n_rollouts"]) for row in rows}
    assert known == {"constant_velocity": (1, 2), "idm": (1, 2), "nominal": (3, 6)}
    assert all(
        row["stage"] == OPEN_LOOP_STAGE
        and row["ego"] == "unknown"
        and row["n_scenes"] == 2
        for row in rows
    )


def test_more_samples_find_better_ones_and_the_joint_choice_is_between():
    scene_set = places(acceleration=0.5)
    method = Method("nominal", nominal())
    one, few, many = (
        metrics(scene_set, method, samples=samples) for samples in (1, 2, 5)
    )
    for at in ("_3", "_5"):
        best = [found[f"min_ade{at}"]["mean"] for found in (one, few, many)]
        assert best[0] > best[1] > best[2], "samples are added, not drawn anew"
        assert best[2] < many[f"joint_ade{at}"]["mean"] < many[f"mean_ade{at}"]["mean"]
        assert (
            best[0]
            == pytest.approx(one[f"mean_ade{at}"]["mean"])
            == pytest.approx(one[f"joint_ade{at}"]["mean"])
        )
        quotient = many[f"mean_ade{at}"]["mean"] / many[f"cv_ade{at}"]["mean"]
        assert many[f"mean_ade_ratio{at}"]["mean"] == pytest.approx(quotient)


def test_plans_begin_at_the_start_do_not_know_the_future_and_are_the_same_in_any_batch():
    scene = scenes(3).scenes
    on = nominal()
    seed = torch.tensor([[4, 5, 6], [7, 8, 9]])
    plan = on.open_loop_plans(scene, seed)
    assert plan.shape == (3, 2, 8, 50, 4)
    assert (plan[:, :, :6, 0, :2] - scene["start"][:, None, :6, :2]).norm(
        dim=-1
    ).max() < 1.5
    blind = scene.clone()
    blind["logged"][:, 1:] = 1e4
    blind["logged_valid"][:, 1:] = False
    assert torch.equal(on.open_loop_plans(blind, seed), plan)
    torch.testing.assert_close(
        on.open_loop_plans(scene[1:2], seed[:, 1:2]), plan[1:2], rtol=0, atol=5e-3
    )
    assert not torch.allclose(on.open_loop_plans(scene, seed + 1), plan)


class Stumbles(ConstantVelocity):
    """Raises in scene 1, plans NaN in scene 3."""

    def open_loop_plans(self, scene, seed):
        if (scene["scene_index"] == 1).any():
            raise ZeroDivisionError("no way out")
        plans = super().open_loop_plans(scene, seed)
        plans[scene["scene_index"] == 3] = torch.nan
        return plans


def test_scenes_without_a_plan_are_counted_and_the_others_keep_their_figures():
    scene_set = places(acceleration=1.2)
    (row,) = open_loop_rows(scene_set, [Method("stumbles", Stumbles())], samples=1)
    assert row["errored"] == {
        "raised ZeroDivisionError": 1,
        "a state was NaN or infinite": 1,
    }
    assert (
        row["n_scenes"] == row["n_rollouts"] == 2
        and row["metrics"]["cv_ade_5"]["n"] == 2 * 4
    )
    assert row["metrics"]["min_ade_5"]["mean"] == pytest.approx(
        metrics(scene_set)["min_ade_5"]["mean"]
    )
