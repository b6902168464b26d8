"""Failure rates and draws of scenes as defined; what counts for which attack; exact
resume."""

import math

import pytest
import torch

from e2rl.learning.rounds import scheduler
from e2rl.learning.rounds.episodes import Episodes
from e2rl.learning.rounds.scheduler import Outcomes, outcomes_of, tally
from e2rl.learning.rounds.schedules import AdaptiveCurriculum
from e2rl.run.errors import InputError


def curriculum_of(num_scenes=6, **settings):
    return AdaptiveCurriculum(num_scenes, 10, **settings)


def episodes(curriculum, scenes, failed, adversarial=True):
    """Learn from episodes in scenes, each failed or not."""
    scene_index = torch.tensor(scenes)
    count = len(scenes)
    zero = torch.zeros(count)
    curriculum.update(
        Episodes(
            torch.arange(count),
            scene_index,
            adversarial=torch.tensor(adversarial).expand(count),
            contact=torch.tensor(failed),
            off_road=zero.bool(),
            returns=zero,
            progress=zero,
            batch_size=[count],
        )
    )


def failing(curriculum, *rates):
    """Ten episodes in each of the first scenes, which fail at these rates."""
    for scene, rate in enumerate(rates):
        episodes(
            curriculum, [scene] * 10, failed=[k < round(10 * rate) for k in range(10)]
        )


def test_failing_is_the_moving_failure_rate_in_adversarial_traffic(monkeypatch):
    monkeypatch.setattr(scheduler, "SMOOTHING", 0.25)
    curriculum = curriculum_of()
    episodes(
        curriculum,
        [0, 1, 1],
        failed=[True, False, True],
        adversarial=False,
    )
    assert curriculum.failing.isnan().all(), (
        "nothing is known of adversarial traffic yet"
    )
    failing(curriculum, 0.2, 1.0, 0.0)
    torch.testing.assert_close(curriculum.failing[:3], torch.tensor([0.2, 1.0, 0.0]))
    assert curriculum.summary()["learnability"] == pytest.approx(0.16 / 3)
    episodes(curriculum, [1], failed=[False])
    assert curriculum.failing[1] == 0.75


class Preferring(AdaptiveCurriculum):
    """Draws scenes by how often they fail."""

    def priority(self):
        return self.failing / self.failing.sum()


def test_draws_follow_the_priorities_without_repetition_within_a_pass():
    assert curriculum_of(4).priority().tolist() == [0.25] * 4
    curriculum = Preferring(5, 10)
    failing(curriculum, 0.1, 0.1, 0.2, 0.3, 0.3)
    counts = torch.bincount(
        torch.stack([curriculum.draw(1) for _ in range(4000)]).flatten(), minlength=5
    )
    assert torch.allclose(counts / 4000, curriculum.priority(), atol=0.03)
    chosen = curriculum.draw(13)
    assert sorted(torch.bincount(chosen, minlength=5).tolist()) == [2, 2, 3, 3, 3]
    assert len(curriculum.draw(4).unique()) == 4


def test_state_goes_on_exactly():
    first = curriculum_of()
    second = curriculum_of(seed=4)
    for _ in range(3):
        first.draw(2)
        episodes(first, [0, 3], failed=[True, False])
        first.advance(0.1)
    second.load_state_dict(first.state_dict())
    for curriculum in (first, second):
        curriculum.advance(0.9)
    assert torch.equal(first.draw(4), second.draw(4))
    assert first.eta == second.eta
    assert first.round == second.round
    assert torch.equal(first.etas(torch.arange(4)), second.etas(torch.arange(4)))
    assert torch.equal(first.priority(), second.priority())
    with pytest.raises(InputError, match="holds 6 scenes, the data 5"):
        curriculum_of(5).load_state_dict(first.state_dict())
    with pytest.raises(InputError, match="no scenes"):
        curriculum_of(0)


def test_episodes_count_for_the_attack_whose_row_they_drove():
    """Attacks 0 and 2 of three entered D'; rows beyond them are nominal or remembered."""
    outcomes = outcomes_of(
        torch.tensor([1.0, 2.0, 2.0]),
        drawn=torch.tensor([0, 2]),
        row=torch.tensor([0, 0, 1, 2, 5, 1]),
        failed=torch.tensor([True, False, True, True, True, True]),
    )
    assert outcomes.left_out.tolist() == [False, True, False]
    assert outcomes.episodes.tolist() == [2, 0, 2]
    assert outcomes.failures.tolist() == [1, 0, 2]


def test_the_table_counts_draws_episodes_and_failures_by_multiples_of_a_half():
    outcomes = Outcomes(
        torch.tensor([1.1, 2.2, 1.8, 3.0]),
        left_out=torch.tensor([False, True, False, False]),
        episodes=torch.tensor([2, 0, 2, 0]),
        failures=torch.tensor([1, 0, 2, 0]),
    )
    rows = [
        tuple(row.values())
        for row in tally(4, outcomes, attack=torch.tensor([0, 0, 1, 1]))
    ]
    assert rows[:2] == [(4, 1.0, 1, 0, 0, 2, 1, 0.5), (4, 2.0, 2, 1, 1, 2, 2, 1.0)]
    assert rows[2][:-1] == (4, 3.0, 1, 1, 0, 0, 0)
    assert math.isnan(rows[2][-1]), "no episode, no rate"
