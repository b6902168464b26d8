"""One drive per row of a pool, counted to its first failure; finished episodes without
the bias towards short ones."""

import torch
from tensordict import TensorDict

from e2rl.learning.pretraining.driving import PoolDriver, finished_episodes
from e2rl.planners.idm_planner import IDMEgo
from e2rl.sim.env import SimSettings
from e2rl.traffic.pool import TrafficPool
from tests.learning.small import brake_check, small_scenes


def test_a_drive_counts_until_its_first_contact():
    scenes = small_scenes(2, steps=40)
    index = torch.arange(2)
    attack = TrafficPool.stored(brake_check(scenes)(None, index, 7.0, 0), 7.0)
    frames = PoolDriver(scenes, SimSettings(), batch=2).drive(
        IDMEgo(hardest_braking=0.1, braking=0.1),
        attack + TrafficPool.recorded(index),
        torch.tensor([0, 2]),
    )
    alive = frames["alive"]
    assert alive.sum(1)[0] < 40, "it ends by the contact"
    assert alive[1].all()


def test_disturbances_are_executed_but_not_intended():
    scenes = small_scenes(2)
    driver = PoolDriver(scenes, SimSettings(), batch=2)
    pool = TrafficPool.recorded(torch.arange(2))
    frames = driver.drive(
        IDMEgo(),
        pool,
        torch.arange(2),
        lambda action, step: action + torch.tensor([1.0, 0.0]),
    )
    assert torch.allclose(
        frames["executed"][..., 0], frames["intended"][..., 0] + 1.0, atol=1e-3
    )


def frames(lengths, total, fail=()):
    """One environment: episodes of these lengths in turn, reward 1 a step; those in
    `fail` end by contact."""
    timestep = torch.cat([torch.arange(1, n + 1) for n in lengths])[:total]
    number = torch.cat([torch.full((n,), k) for k, n in enumerate(lengths)])[:total]
    done = torch.tensor(
        [
            t == lengths[k]
            for t, k in zip(timestep.tolist(), number.tolist(), strict=True)
        ]
    )
    contact = done & torch.tensor([k in fail for k in number.tolist()])
    row = number[None, :, None]
    returns = timestep.float()
    return TensorDict(
        {
            "traffic": {"row": row},
            "scene_index": row + 10,
            "next": {
                "timestep": timestep[None, :, None],
                "done": done[None, :, None],
                "episode_reward": returns[None, :, None],
                "metrics": {
                    "contact": contact[None, :, None],
                    "contact_vru": torch.zeros(1, total, 1).bool(),
                    "contact_object": torch.zeros(1, total, 1).bool(),
                    "off_road": torch.zeros(1, total, 1).bool(),
                    "progress": 2.0 * timestep[None, :, None],
                },
            },
        },
        [1, total],
    )


def test_returns_outcomes_and_scenes_of_episodes_across_batches():
    data = frames([10, 4, 10, 10], 34, fail=(1,))
    episodes = finished_episodes(
        [data[:, :12], data[:, 12:]],
        torch.tensor([False, True, True, False]),
        horizon=10,
    )
    assert episodes.row.tolist() == [0, 1, 2, 3] and episodes.scene_index.tolist() == [
        10,
        11,
        12,
        13,
    ]
    assert episodes.returns.tolist() == [10.0, 4.0, 10.0, 10.0]
    assert episodes.progress.tolist() == [20.0, 8.0, 20.0, 20.0]
    assert episodes.failed.tolist() == [False, True, False, False]
    summary = episodes.summary()
    assert (
        summary["contact"] == 0.25
        and summary["contact_adversarial"] == 0.5
        and summary["contact_nominal"] == 0.0
    )
    assert "acceleration" not in summary, "what was not measured is left out"


def test_episodes_that_could_not_have_lasted_do_not_count():
    """The second begins 5 steps before the end: only a failure could be finished by
    then."""
    data = frames([10, 3, 10], 15, fail=(1,))
    assert finished_episodes(
        [data], torch.zeros(3, dtype=torch.bool), horizon=10
    ).row.tolist() == [0]


def test_decisions_of_several_steps_are_told_from_steps():
    """Episodes of 5, 3 and 5 steps in decisions of 2 are 3, 2 and 3 frames, the last
    one of each cut short."""
    steps = [2, 4, 5, 2, 3, 2, 4, 5]
    number = [0, 0, 0, 1, 1, 2, 2, 2]
    data = frames([3, 2, 3], 8, fail=(1,))
    assert data["traffic", "row"][0, :, 0].tolist() == number
    data["next", "timestep"] = torch.tensor(steps)[None, :, None]
    adversarial = torch.zeros(3, dtype=torch.bool)
    assert finished_episodes([data], adversarial, horizon=5, hold=2).row.tolist() == [
        0,
        1,
        2,
    ]
    assert finished_episodes(
        [data[:, :7]], adversarial, horizon=5, hold=2
    ).row.tolist() == [0, 1]
    assert finished_episodes(
        [data[:, :5]], adversarial, horizon=5, hold=2
    ).row.tolist() == [0], "the second might have lasted"
