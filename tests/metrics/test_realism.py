"""Realism: identities of the distance, what is counted, and the pooled figures by an
independent route."""

import numpy as np
import pytest
import torch
from scipy.stats import wasserstein_distance

from e2rl.metrics.realism import (
    CLIP,
    KINEMATICS,
    kinematic_samples,
    realism,
    wasserstein,
)
from e2rl.metrics.score import score_rollouts
from tests.metrics.random_rollouts import random_rollouts


def features_of(rollouts):
    return score_rollouts(rollouts)[1]


def once(clusters):
    return torch.ones(1, clusters, dtype=torch.float64), torch.arange(clusters)


def test_a_draw_equals_the_distance_of_the_repeated_samples():
    generator = torch.Generator().manual_seed(2)
    pair = torch.randn(
        2, 9000, generator=generator, dtype=torch.float64
    )  # more than one block of columns
    cluster = torch.randint(5, (9000,), generator=generator)
    draws = torch.tensor(
        [[1.0, 0, 2, 1, 3], [0, 0, 5, 0, 0], [0, 0, 0, 0, 0]], dtype=torch.float64
    )
    result = wasserstein(pair, cluster, draws=draws)
    for draw, distance in zip(draws[:2], result[:2], strict=True):
        repeated = pair.repeat_interleave(draw[cluster].long(), dim=1)
        assert distance.item() == pytest.approx(wasserstein_distance(*repeated.numpy()))
    assert result[2].isnan()


def test_pooled_figures_follow_the_definition():
    features = features_of(random_rollouts(8, seed=4))
    draws, cluster = once(8)
    table = realism(features, cluster, draws=draws)
    distances = []
    scaled = []
    for name in KINEMATICS:
        simulated, log = np.concatenate(
            [sample[name].numpy() for sample in features], 1
        )
        distances.append(wasserstein_distance(simulated, log))
        scaled.append(distances[-1] / np.subtract(*np.quantile(log, [0.95, 0.05])))
        assert table[f"w1_{name}"].item() == pytest.approx(distances[-1])
        assert max(abs(simulated).max(), abs(log).max()) <= CLIP[name]
    assert table["real"].item() == pytest.approx(1 - np.minimum(distances, 1).mean())
    assert table["real_norm"].item() == pytest.approx(1 - np.minimum(scaled, 1).mean())


def test_the_ego_the_parked_and_what_happens_after_the_stop_do_not_count():
    rollouts = random_rollouts(4, seed=6)
    before = features_of(rollouts)
    changed = rollouts.clone()
    changed.logged[:, :, 0] += 5 * torch.rand(
        changed.logged[:, :, 0].shape
    )  # the ego's own log
    assert all(
        torch.equal(a[name], b[name])
        for a, b in zip(before, features_of(changed), strict=True)
        for name in a
    )
    states = torch.zeros(1, 81, 3, 4, dtype=torch.float64)
    valid = torch.ones(1, 81, 3, dtype=torch.bool)
    states[:, :, 1, 3] = 5.0
    agents = torch.tensor([[False, True, True]])
    for stop, blocks in ((80, 16), (34, 6), (9, 1)):
        sample = kinematic_samples(
            states,
            valid,
            logged=states,
            logged_valid=valid,
            agents=agents,
            stop=torch.tensor([stop]),
        )[0]
        assert [sample[name].shape[1] for name in KINEMATICS] == [
            blocks - 1,
            blocks - 1,
            max(blocks - 2, 0),
        ], stop


def test_real_adv_is_real_of_a_traffic_of_adversaries_alone():
    rollouts = random_rollouts(6, seed=3)
    alone = rollouts.replace(simulated=rollouts.simulated & rollouts.adversaries)
    draws, cluster = once(6)
    ours, theirs = (
        realism(features_of(inputs), cluster, draws=draws)
        for inputs in (rollouts, alone)
    )
    assert ours["real_adv"] == theirs["real"] == theirs["real_adv"]
    assert ours["real_adv"] != ours["real"]
    nobody = rollouts.replace(adversaries=torch.zeros_like(rollouts.adversaries))
    rows, features = score_rollouts(nobody)
    table = realism(features, cluster, draws=draws)
    assert table["real_adv"].isnan()
    assert table["real"] == ours["real"]
    assert rows[0]["real_adv"] != rows[0]["real_adv"]


def test_a_constant_turn_has_its_lateral_acceleration():
    time = torch.arange(81, dtype=torch.float64) * 0.1
    states = torch.stack([time, time, 3.0 + 0.2 * time, 4.0 + 0.5 * time], -1)[
        None, :, None
    ].expand(1, 81, 2, 4)
    valid = torch.ones(1, 81, 2, dtype=torch.bool)
    agents = torch.tensor([[False, True]])
    sample = kinematic_samples(
        states,
        valid,
        logged=states,
        logged_valid=valid,
        agents=agents,
        stop=torch.tensor([80]),
    )[0]
    middle = 4.0 + 0.5 * (0.55 + 0.5 * torch.arange(15))
    torch.testing.assert_close(
        sample["a_lat"][0], (0.2 * middle).double(), atol=1e-6, rtol=0
    )
    torch.testing.assert_close(
        sample["a_lon"][0], torch.full((15,), 0.5, dtype=torch.float64)
    )
    assert sample["jerk"].abs().max() < 1e-9


def samples_of(speed, yaw_rate=0.0):
    """The samples of one vehicle at speeds [81] that turns at a yaw rate."""
    states = torch.zeros(1, 81, 2, 4, dtype=torch.float64)
    states[0, :, 1, 2] = 0.1 * yaw_rate * torch.arange(81)
    states[0, :, 1, 3] = speed
    valid = torch.ones(1, 81, 2, dtype=torch.bool)
    return kinematic_samples(
        states,
        valid,
        logged=states,
        logged_valid=valid,
        agents=torch.tensor([[False, True]]),
        stop=torch.tensor([80]),
    )[0]


@pytest.mark.parametrize(
    ("name", "largest"), [("a_lon", 10.0), ("a_lat", 10.0), ("jerk", 20.0)]
)
def test_a_glitch_counts_as_10_m_s2_or_20_m_s3(name, largest):
    """In a bend of 1 rad/s the speed jumps from 5 to 35 m/s: 60 m/s^2 along, 35 m/s^2
    across, and 120 m/s^3."""
    speed = torch.where(torch.arange(81) < 41, 5.0, 35.0)
    assert samples_of(speed, yaw_rate=1.0)[name].max() == largest


@pytest.mark.parametrize(("speed", "count"), [(0.45, 0), (0.55, 15)])
def test_who_drives_at_half_a_metre_a_second_moves(speed, count):
    assert samples_of(torch.full((81,), speed))["a_lon"].shape[1] == count
