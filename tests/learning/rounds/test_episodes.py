"""Finished episodes, without the bias towards short ones, and their means."""

import torch
from tensordict import TensorDict

from e2rl.learning.rounds.episodes import finished_episodes


def frames(lengths, total, fail=()):
    """One environment: episodes of these lengths in turn, reward 1 a step; those in
    `fail` end by contact."""
    timestep = torch.cat([torch.arange(1, n + 1) for n in lengths])[:total]
    number = torch.cat([torch.full((n,), k) for k, n in enumerate(lengths)])[:total]
    finished = torch.tensor(
        [
            t == lengths[k]
            for t, k in zip(timestep.tolist(), number.tolist(), strict=True)
        ]
    )
    contact = finished & torch.tensor([k in fail for k in number.tolist()])
    row = number[None, :, None]
    returns = timestep.float()
    return TensorDict(
        {
            "traffic": {"row": row},
            "scene_index": row + 10,
            "next": {
                "timestep": timestep[None, :, None],
                "done": finished[None, :, None],
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
    assert episodes.row.tolist() == [0, 1, 2, 3]
    assert episodes.scene_index.tolist() == [10, 11, 12, 13]
    assert episodes.returns.tolist() == [10.0, 4.0, 10.0, 10.0]
    assert episodes.progress.tolist() == [20.0, 8.0, 20.0, 20.0]
    assert episodes.failed.tolist() == [False, True, False, False]
    summary = episodes.summary()
    assert summary["contact"] == 0.25
    assert summary["contact_adversarial"] == 0.5
    assert summary["contact_nominal"] == 0.0


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
    for frames_known, rows in ((8, [0, 1, 2]), (7, [0, 1]), (5, [0])):
        episodes = finished_episodes(
            [data[:, :frames_known]], adversarial, horizon=5, hold=2
        )
        assert episodes.row.tolist() == rows, "the next one might have lasted"
