"""The meta-metric over rollouts: a log that equals all rollouts, and what the tally
does not depend on."""

import copy

import pytest
import torch

from e2rl.evaluation.meta_table import (
    Tally,
    evaluated,
    log_split_half,
    meta_rows,
    summarise_meta,
)
from e2rl.evaluation.protocol import Method, Setup, Task
from e2rl.metrics.catalogue import META_STAGE, STAGES
from e2rl.metrics.meta_metric import FEATURES, SMOOTHING, meta_metric
from e2rl.planners.log_replay import ReplayEgo
from e2rl.prior.sde import SamplerSettings
from e2rl.run.parts import Parts
from e2rl.sim.env import SimSettings
from e2rl.sim.rollouts import Rollouts
from e2rl.traffic.nominal import NominalTraffic
from e2rl.traffic.rule_based import LogReplay
from tests.prior.small import small_prior
from tests.traffic.e2.traffic_scenes import scenes

SIM = SimSettings()
STEPS = 30
KNOWN = {
    "linear_speed": STEPS - 2,
    "angular_speed": STEPS - 2,
    "linear_accel": STEPS - 4,
    "angular_accel": STEPS - 4,
}


def nominal():
    return NominalTraffic(small_prior(sampler=SamplerSettings(steps=4)))


def places(count=2, **options):
    scene_set = scenes(count, steps=STEPS, **options)
    scene_set.location[:] = ["p", "q"] * (count // 2)
    return scene_set


def logs_of(scene_set):
    """The logs as rollouts."""
    scene = scene_set.scenes
    tracks = {"states": scene["logged"], "valid": scene["logged_valid"]}
    known = {
        "adversaries": scene["valid"] & False,
        "seed": torch.zeros(len(scene)),
        "eta": torch.zeros(len(scene)),
    }
    return Rollouts.in_scenes(
        scene_set,
        torch.arange(len(scene)),
        **tracks,
        **known,
        routes=scene["route_log"],
    )


def setup_of(scene_set, batch=64):
    return Setup(scene_set, ReplayEgo(), ego_name="replay", sim=SIM, batch=batch)


def sampled(scene_set, seeds):
    """[(scene indices, rollouts)] of a random prior, one for each seed."""
    method = Method("nominal", nominal())
    setup = setup_of(scene_set)
    index = torch.arange(len(scene_set))
    return [
        (index, setup.roll_out(method, [Task(k, seed) for k in range(len(scene_set))]))
        for seed in seeds
    ]


def likelihoods(scene_set, parts):
    tally = Tally(scene_set)
    for index, part in parts:
        tally.add(index, part)
    return tally.likelihoods()


def same(one, other):
    for name in FEATURES:
        torch.testing.assert_close(other[name], one[name], equal_nan=True, msg=name)


@pytest.mark.parametrize("rollouts", [1, 4, 32])
def test_a_log_that_equals_all_rollouts_is_as_likely_as_the_smoothing_lets_it_be(
    rollouts,
):
    """At constant velocity every feature of motion stays in one bin, so each likelihood
    has a closed form."""
    scene_set = places()
    index = torch.arange(2)
    found = likelihoods(scene_set, [(index, logs_of(scene_set))] * rollouts)
    for name, steps in KNOWN.items():
        expected = (rollouts * steps + SMOOTHING) / (
            rollouts * steps + SMOOTHING * FEATURES[name].bins
        )
        assert found[name].tolist() == pytest.approx([expected] * 2, rel=1e-5), name
    sure = (rollouts + SMOOTHING) / (rollouts + 2 * SMOOTHING)
    assert (
        found["offroad"].tolist()
        == found["red_light"].tolist()
        == pytest.approx([sure] * 2)
    )
    assert rollouts < 32 or found["road_edge"].min() > 0.99


def test_neither_the_order_of_rollouts_nor_their_batches_matter_and_a_weight_is_a_number_of_rollouts():
    scene_set = places()
    parts = sampled(scene_set, [0, 1, 2])
    found = likelihoods(scene_set, parts)
    same(found, likelihoods(scene_set, parts[::-1]))
    rows = [
        (index[k : k + 1], part[k : k + 1]) for index, part in parts for k in range(2)
    ]
    same(found, likelihoods(scene_set, rows))
    weighed = Tally(scene_set)
    repeated = likelihoods(scene_set, parts[:1] * 3)
    weighed.add(*parts[0], weight=3)
    same(repeated, weighed.likelihoods())


def test_vehicles_recorded_throughout_are_looked_at_and_a_scene_without_any_is_unknown():
    scene_set = places()
    scene_set.scenes["logged_valid"][0, 20:, 1:] = False
    scene_set.scenes["logged_valid"][1, 3, 2] = False
    chosen = evaluated(scene_set.scenes)
    assert chosen[0].sum() == 0 and chosen[1].nonzero()[:, 0].tolist() == [1, 3, 4, 5]
    found = likelihoods(scene_set, [(torch.arange(2), logs_of(scene_set))])
    assert all(value.isnan().tolist() == [True, False] for value in found.values())
    assert {row["n"] for row in summarise_meta(found, scene_set).values()} == {1}


def test_lights_belong_to_ways_so_that_whoever_follows_none_runs_none():
    scene_set = places(red_light_x=30.0)
    hits = []
    for routes in (
        scene_set.scenes["route_log"],
        torch.full_like(scene_set.scenes["route_log"], -1),
    ):
        tally = Tally(scene_set)
        tally.add(torch.arange(2), logs_of(scene_set).replace(routes=routes))
        hits.append(tally.hits["red_light"].view(2, -1).sum(1).tolist())
    assert hits == [[2, 2], [0, 0]]  # those at 22 and 10 m pass 30 m within 3 s


def test_the_rows_of_a_run():
    scene_set = places()
    rollouts = 3
    methods = [Method("replay", LogReplay()), Method("nominal", nominal())]
    rows = meta_rows(setup_of(scene_set, 4), methods, rollouts=rollouts)
    assert all(
        (row["stage"], row["n_seeds"], row["n_rollouts"]) == (META_STAGE, 3, 6)
        for row in rows
    )
    replay, sampling = (row["metrics"] for row in rows)
    assert (
        set(replay)
        == {metric.name for metric in STAGES[META_STAGE]}
        == {*sampling, "real_split_half"}
    )
    expected = (rollouts * 28 + SMOOTHING) / (rollouts * 28 + 10 * SMOOTHING)
    assert replay["linear_speed"]["mean"] == pytest.approx(expected, rel=1e-5)
    for row in (replay, sampling):
        total = sum(FEATURES[name].weight * row[name]["mean"] for name in FEATURES)
        assert row["meta_metric"]["mean"] == pytest.approx(total)
    assert sampling["meta_metric"]["mean"] < replay["meta_metric"]["mean"] < 1
    counted = likelihoods(scene_set, sampled(scene_set, range(rollouts)))
    assert sampling["meta_metric"]["mean"] == pytest.approx(
        meta_metric(counted).mean().item(), rel=1e-6
    )


def test_split_halves_part_whole_places():
    scene_set = places(4)
    row = log_split_half(scene_set)
    assert (row["mean"], row["low"], row["high"], row["n"]) == (1, 1, 1, 4), (
        "everybody at constant velocity"
    )
    time = 0.1 * torch.arange(STEPS + 1)
    scene_set.scenes["logged"][1::2, :, 1:6, 3] += (
        0.3 * time[:, None]
    )  # place q speeds up by 0.3 m/s^2
    assert log_split_half(scene_set)["mean"] == pytest.approx(1 - 0.3 / 3, abs=0.01), (
        "of three features one differs"
    )
    scene_set.location[:] = ["p"] * 4
    assert log_split_half(scene_set)["mean"] != log_split_half(scene_set)["mean"], (
        "one place has no halves"
    )


def test_rollouts_that_end_are_counted_and_weigh_nothing(tmp_path):
    """A planner that raises in scene 1: scene 0 keeps its likelihoods, scene 1 has
    none."""

    class Fails(ReplayEgo):
        replays_log = False

        def plan(self, world):
            if (world.scene["scene_index"] == 1).any():
                raise ZeroDivisionError
            return super().plan(world)

    scene_set = places(2)
    methods = [Method("nominal", nominal()), Method("replay", LogReplay())]
    setup = Setup(scene_set, Fails(), ego_name="fails", sim=SIM, batch=4)
    for row, count in zip(
        meta_rows(setup, methods, rollouts=3, parts=Parts(tmp_path)),
        (3, 1),
        strict=True,
    ):
        assert (
            row["errored"] == {"raised ZeroDivisionError": count}
            and row["n_rollouts"] == 3
        )
        assert {row["metrics"][name]["n"] for name in FEATURES} == {1}
    assert meta_rows(setup, methods, rollouts=3, parts=Parts(tmp_path))[0][
        "errored"
    ] == {"raised ZeroDivisionError": 3}


def test_the_order_of_vehicles_does_not_matter():
    scene_set = places()
    [(index, part)] = sampled(scene_set, [0])
    found = likelihoods(scene_set, [(index, part)])
    order = torch.tensor([0, 4, 2, 5, 1, 3, 7, 6])
    all_rows = torch.tensor([0, 4, 2, 5, 1, 3, 7, 6, 8, 9])
    other = copy.deepcopy(scene_set)
    scene = other.scenes
    for key in ("start", "valid", "size", "agent_type", "parked"):
        scene[key] = scene[key][:, all_rows]
    for key in ("logged", "logged_valid"):
        scene[key] = scene[key][:, :, all_rows]
    for key in ("route_points", "route_light", "route_light_s", "route_log"):
        scene[key] = scene[key][:, order]
    shuffled = part.replace(
        states=part.states[:, :, all_rows],
        valid=part.valid[:, :, all_rows],
        size=part.size[:, all_rows],
        routes=part.routes[:, order],
    )
    same(found, likelihoods(other, [(index, shuffled)]))
