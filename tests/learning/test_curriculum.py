"""Schedules, learnability and priorities as defined, and a state that goes on exactly."""

import pytest
import torch

from e2rl.learning.scheduler import ranks
from e2rl.learning.schedules import AdaptiveCurriculum, ConstantCurriculum, LinearCurriculum
from e2rl.run.errors import InputError
from e2rl.traffic.traffic import FULL


def scheduler(kind=AdaptiveCurriculum, num_scenes=6, rounds=10, **settings):
    return kind(num_scenes, rounds, **settings)


def episodes(curriculum, scenes, failed, adversarial=True):
    """Episodes in scenes, each failed or not."""
    curriculum.update(torch.tensor(scenes), torch.tensor(failed), torch.full((len(scenes),), adversarial))


def failing(curriculum, *rates):
    """Ten episodes in each of the first scenes, of which these shares fail."""
    for scene, rate in enumerate(rates):
        episodes(curriculum, [scene] * 10, [k < round(10 * rate) for k in range(10)])


def test_constant_and_linear_intensity_and_share():
    constant, linear = (
        scheduler(ConstantCurriculum, eta=2.0),
        scheduler(LinearCurriculum, eta=0.5, eta_final=2.5, ramp=0.5, share=0.0, share_final=0.9),
    )
    etas, shares = [], []
    for _ in range(10):
        etas.append(linear.eta), shares.append(linear.share)
        assert constant.eta == 2.0 and constant.share == 0.5
        linear.advance(1.0), constant.advance(0.0)
    assert etas == pytest.approx([0.5, 0.9, 1.3, 1.7, 2.1] + [2.5] * 5)
    assert shares == pytest.approx([0.0, 0.18, 0.36, 0.54, 0.72] + [0.9] * 5)


def test_adaptive_intensity_seeks_the_band_within_its_bounds():
    curriculum = scheduler(eta=1.0, eta_step=0.5, eta_min=0.5, eta_max=2.0, target_low=0.2, target_high=0.4)
    seen = []
    for rate in (0.0, 0.3, 0.1, 0.1, 0.9, 0.9, 0.9, 0.9, 0.9):
        curriculum.advance(rate)
        seen.append(curriculum.eta)
    assert seen == [1.5, 1.5, 2.0, 2.0, 1.5, 1.0, 0.5, 0.5, 0.5]
    curriculum.advance()
    assert curriculum.eta == 0.5 and curriculum.round == 10, "no collision rate is known: it stays"


def test_the_scenes_of_a_round_have_intensities_around_the_round_s():
    """Uniform from eta - spread to eta + spread, cut at the bounds."""
    scenes = torch.zeros(4000, dtype=torch.int64)
    drawn = ((2.0, 1.0, 1.0, 3.0), (0.5, 1.0, 0.25, 1.5), (4.5, 1.0, 3.5, 5.0), (1.0, 0.0, 1.0, 1.0))
    for eta, spread, low, high in drawn:
        etas = scheduler(eta=eta, spread=spread, eta_min=0.25, eta_max=5.0).etas(scenes)
        assert etas.min() >= low and etas.max() <= high
        assert etas.mean().item() == pytest.approx((low + high) / 2, abs=0.05)
        assert etas.std().item() == pytest.approx((high - low) / 12**0.5, abs=0.05)
    rising = scheduler(LinearCurriculum, eta=0.5, eta_final=2.0, spread=1.0)
    assert 0 <= rising.etas(scenes).min() < 0.05 and rising.etas(scenes).max() <= 1.5
    assert scheduler(LinearCurriculum, eta=0.5).etas(scenes[:3]).tolist() == [0.5] * 3


def test_constant_intensities_take_turns():
    curriculum, seen = scheduler(ConstantCurriculum, eta=[1.0, 2.0, 3.0]), []
    for _ in range(3):
        seen.append(curriculum.etas(torch.arange(4)).tolist())
        curriculum.advance()
    assert seen == [[1.0, 2.0, 3.0, 1.0], [2.0, 3.0, 1.0, 2.0], [3.0, 1.0, 2.0, 3.0]] and curriculum.eta == 2.0
    for wrong in ([], [1.0, -1.0]):
        with pytest.raises(InputError, match=r"curriculum\.eta"):
            scheduler(ConstantCurriculum, eta=wrong)


def test_adaptive_intensity_settles_where_the_ego_collides_as_often_as_wanted():
    """An ego that collides at rate eta / 4 ends in the band."""
    curriculum = scheduler(eta=0.25, target_low=0.4, target_high=0.5, eta_step=0.25)
    for _ in range(40):
        curriculum.advance(curriculum.eta / 4)
    assert 0.4 <= curriculum.eta / 4 <= 0.5


def test_learnability_is_the_variance_of_recent_failures_in_adversarial_traffic():
    curriculum = scheduler(smoothing=0.5)
    episodes(curriculum, [0, 1, 1], [True, False, True], adversarial=False)
    assert curriculum.learnability().isnan().all(), "nothing is known of adversarial traffic yet"
    failing(curriculum, 0.5, 1.0, 0.0)
    assert curriculum.learnability()[:3].tolist() == [0.25, 0.0, 0.0], "neither hopeless nor mastered scenes teach"
    episodes(curriculum, [1], [False])
    assert curriculum.learnability()[1] == 0.25, "shares are smoothed"


def test_priorities_are_a_distribution_that_prefers_learnable_unseen_and_stale_scenes():
    curriculum = scheduler(num_scenes=4, staleness=0.0)
    assert torch.allclose(curriculum.priority(), torch.full((4,), 0.25))
    failing(curriculum, 1.0, 0.9, 0.4)
    priority = curriculum.priority()
    assert priority.sum().item() == pytest.approx(1.0)
    assert priority[3] > priority[2] > priority[1] > priority[0] > 0
    stale = scheduler(num_scenes=4, staleness=1.0)
    stale._drawn = torch.tensor([0, 1, 2, 3])
    stale.round = 3
    assert torch.allclose(stale.priority(), torch.tensor([3.0, 2.0, 1.0, 0.0]) / 6)


def test_no_scene_takes_the_round_once_all_have_been_seen():
    """A round has thousands of episodes before priorities change, so that they must not all go to a few scenes."""
    curriculum = scheduler(num_scenes=300)
    failing(curriculum, *torch.linspace(0, 1, 300).tolist())
    priority = curriculum.priority().sort(descending=True).values
    assert priority[0] < 0.05 and 0.2 < priority[:30].sum() < 0.4


def test_draws_follow_the_priorities_without_repetition_within_a_pass():
    curriculum = scheduler(num_scenes=5, staleness=0.0, temperature=1.0)
    failing(curriculum, 0.0, 0.1, 0.2, 0.3, 0.4)
    expected = curriculum.priority()
    counts = torch.bincount(torch.stack([curriculum.draw(1) for _ in range(4000)]).flatten(), minlength=5)
    assert torch.allclose(counts / 4000, expected, atol=0.03)
    chosen = curriculum.draw(13)
    assert torch.bincount(chosen, minlength=5).tolist().count(3) == 3 and len(chosen) == 13
    assert len(curriculum.draw(4).unique()) == 4


def test_ranks_share_ties():
    assert ranks(torch.tensor([5.0, 1.0, 5.0, torch.inf, 0.0])).tolist() == [2.5, 4.0, 2.5, 1.0, 5.0]


def test_state_goes_on_exactly():
    first = scheduler()
    for _ in range(3):
        first.draw(2)
        episodes(first, [0, 3], [1.0, 2.0])
        first.advance(0.1)
    second = scheduler()
    second.load_state_dict(first.state_dict())
    for curriculum in (first, second):
        curriculum.advance(0.9)
    assert torch.equal(first.draw(4), second.draw(4)) and first.eta == second.eta
    assert torch.equal(first.etas(torch.arange(4)), second.etas(torch.arange(4)))
    assert torch.equal(first.priority(), second.priority())
    with pytest.raises(InputError, match="holds 6 scenes, the data 5"):
        scheduler(num_scenes=5).load_state_dict(first.state_dict())


@pytest.mark.parametrize("kind", [AdaptiveCurriculum, LinearCurriculum, ConstantCurriculum])
def test_schedules_of_intensity_alone_leave_the_template_full(kind):
    one, other = scheduler(kind), scheduler(kind)
    etas, templates = one.choices(torch.arange(6))
    assert torch.equal(etas, other.etas(torch.arange(6))) and templates.tolist() == [FULL] * 6
    assert one.templates == ("full",) and one.values() == {}
    assert one.level(torch.tensor([0.6, 1.2, 3.0])).tolist() == [0.5, 1.0, 3.0]


@pytest.mark.parametrize("kind", [AdaptiveCurriculum, LinearCurriculum, ConstantCurriculum])
def test_wrong_settings_are_refused(kind):
    own = [{"target_low": 0.6}] if kind is AdaptiveCurriculum else []
    for settings in (*own, {"share": 1.5}, {"temperature": 0.0}, {"staleness": 2.0}, {"num_scenes": 0}):
        with pytest.raises(InputError, match="curriculum"):
            scheduler(kind, **settings)


def test_without_priorities_all_scenes_are_alike():
    curriculum = scheduler(num_scenes=4, prioritised=False)
    failing(curriculum, 0.5, 0.0)
    assert curriculum.priority().tolist() == [0.25] * 4


def test_scenes_left_out_are_not_drawn_first():
    curriculum = scheduler(num_scenes=4, staleness=0.0)
    failing(curriculum, 0.5)
    curriculum.leave_out(torch.tensor([0, 1]))
    assert curriculum.learnability().nan_to_num(-1).tolist() == [0.25, 0.0, -1.0, -1.0]
    assert curriculum.priority()[1] == curriculum.priority().min(), "the ones not yet driven come first"
