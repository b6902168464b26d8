"""Open-loop displacement: closed forms, the order of its variants, and who counts."""

import torch

from e2rl.metrics.displacement import displacement, moving_vehicles, scene_displacements

STEPS = 50


def logs(scenes=3, vehicles=4, seed=0):
    """logged [B, 81, V, 4] of vehicles at 5 m/s and more, all valid, all simulated."""
    generator = torch.Generator().manual_seed(seed)
    speed = 5 + 5 * torch.rand(scenes, 1, vehicles, generator=generator)
    way = speed * 0.1 * torch.arange(81)[:, None]
    logged = torch.stack(
        [way, way * 0.1, torch.zeros_like(way), speed.expand_as(way)], -1
    )
    return (
        logged,
        torch.ones(logged.shape[:3], dtype=torch.bool),
        torch.ones(scenes, vehicles, dtype=torch.bool),
    )


def sampled(logged, samples, noise=1.0, seed=1):
    """Plans [B, S, V, STEPS, 4]: the log and noise."""
    future = logged[:, 1 : STEPS + 1].transpose(1, 2)[:, None]
    generator = torch.Generator().manual_seed(seed)
    shape = (len(logged), samples, *future.shape[2:])
    return future + noise * torch.randn(shape, generator=generator)


def columns(plans, logged, valid, simulated):
    return scene_displacements(
        plans,
        sampled(logged, 1, noise=0.5, seed=9)[:, 0],
        logged=logged,
        logged_valid=valid,
        simulated=simulated,
    )


def test_a_steady_drift_has_its_mean_distance_at_every_horizon():
    logged = torch.zeros(1, 1, STEPS, 4)
    plans = torch.zeros(1, 1, 1, STEPS, 4)
    plans[..., 0], plans[..., 1] = (
        0.3 * torch.arange(1, STEPS + 1),
        0.4 * torch.arange(1, STEPS + 1),
    )
    found = displacement(plans, logged)[0, 0, 0]
    torch.testing.assert_close(found, 0.5 * (torch.arange(1, STEPS + 1) + 1) / 2)
    plans[..., 2:] += 7.0  # heading and speed are not looked at
    assert torch.equal(displacement(plans, logged)[0, 0, 0], found)


def test_best_of_each_is_below_best_of_all_is_below_mean_and_one_sample_makes_them_equal():
    logged, valid, simulated = logs(8)
    plans = sampled(logged, 5)
    many, one = (
        columns(part, logged, valid=valid, simulated=simulated)
        for part in (plans, plans[:, :1])
    )
    more = columns(
        torch.cat([plans, sampled(logged, 3, seed=4)], 1),
        logged,
        valid=valid,
        simulated=simulated,
    )
    for at in ("_3", "_5"):
        best, joint, mean = (
            many[name + at] for name in ("min_ade", "joint_ade", "mean_ade")
        )
        assert (
            (best <= joint).all()
            and (joint <= mean).all()
            and (best < joint).any()
            and (joint < mean).any()
        )
        assert (more[f"min_ade{at}"] <= best).all() and (
            more[f"joint_ade{at}"] <= joint
        ).all()
        torch.testing.assert_close(one[f"min_ade{at}"], one[f"mean_ade{at}"])
        torch.testing.assert_close(one[f"min_ade{at}"], one[f"joint_ade{at}"])


def test_only_simulated_moving_vehicles_recorded_throughout_count_and_never_the_ego():
    logged, valid, simulated = logs(1, 7)
    logged[0, 0, 1, 3] = 0.5  # no faster than 0.5 m/s
    simulated[0, 2] = False
    valid[0, 40, 3] = False  # after 3 s, before 5 s
    valid[0, 0, 4] = False
    valid[0, 60, 5] = False  # after every horizon
    for steps, length, expected in (
        (30, 81, [3, 5, 6]),
        (50, 81, [5, 6]),
        (50, 51, [5, 6]),
        (50, 50, []),
    ):
        found = moving_vehicles(
            logged[:, :length], valid[:, :length], simulated=simulated, steps=steps
        )
        assert found[0].nonzero()[:, 0].tolist() == expected
    plans = sampled(logged, 2)
    found = columns(plans, logged, valid=valid, simulated=simulated)
    assert found["vehicles_3"].item() == 3 and found["vehicles_5"].item() == 2
    wrong = plans.clone()
    wrong[:, :, [0, 1, 2, 4]] = torch.nan  # whoever does not count may hold anything
    assert (
        columns(wrong, logged, valid=valid, simulated=simulated)["mean_ade_5"].item()
        == found["mean_ade_5"].item()
    )
