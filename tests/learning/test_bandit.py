"""The bandit draws what the policy fails in neither never nor always, and follows it as
the policy hardens."""

import pytest
import torch

from e2rl.learning.bandit import BanditCurriculum
from e2rl.learning.scheduler import Outcomes
from e2rl.run.errors import InputError
from e2rl.traffic.traffic import FULL, PAIR, SINGLE

ETAS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0)


def told(curriculum, eta, template, rate, attacks=20, left_out=0, survivable=torch.nan):
    """Attacks of one arm, each driven 10 times, that fail at a rate; `left_out` of them
    did not enter D', a teacher would survive a share of each."""
    gone = torch.arange(attacks) < left_out
    episodes = torch.full((attacks,), 10).masked_fill(gone, 0)
    arm = torch.full((attacks,), eta), torch.full((attacks,), template)
    curriculum.observe(
        Outcomes(
            *arm,
            gone,
            episodes,
            (rate * episodes).long(),
            torch.full((attacks,), survivable),
        )
    )


def test_arms_that_never_or_always_fail_are_drawn_less_than_those_in_between():
    curriculum = BanditCurriculum(
        6, 10, etas=[1.0, 2.0, 3.0], templates=["single"], forgetting=0.0
    )
    for eta, rate in ((1.0, 0.0), (2.0, 0.5), (3.0, 1.0)):
        told(curriculum, eta, template=SINGLE, rate=rate)
    etas, _ = curriculum.choices(torch.zeros(4000, dtype=torch.int64))
    drawn = [(etas == eta).float().mean().item() for eta in (1.0, 2.0, 3.0)]
    assert (
        curriculum.probability().tolist() == pytest.approx(drawn, abs=0.03)
        and drawn[1] > 0.8
    )


def test_the_probability_is_a_softmax_of_values_with_exploration():
    curriculum = BanditCurriculum(
        6, 10, etas=[1.0, 2.0], templates=["pair"], forgetting=0.0
    )
    told(curriculum, 1.0, template=PAIR, rate=0.5)
    value = curriculum.value()
    expected = 0.9 * (10 * value / 0.25).softmax(0) + 0.1 / 2
    torch.testing.assert_close(curriculum.probability(), expected)
    assert curriculum.eta == pytest.approx(
        (expected * torch.tensor([1.0, 2.0])).sum().item()
    )


def test_an_attack_counts_once_however_many_episodes_are_driven_in_it():
    """Failed, survived, kept and left out; an attack that nobody drove is kept, but
    neither failed nor survived."""
    curriculum = BanditCurriculum(
        6, 10, etas=[1.0, 2.0], templates=["pair", "full"], forgetting=0.25
    )
    eta = torch.tensor([1.0, 1.0, 1.0, 2.0])
    template = torch.tensor([PAIR, PAIR, PAIR, FULL])
    gone = torch.tensor([False, True, False, False])
    episodes = torch.tensor([4, 0, 0, 10])
    for _ in range(2):
        share = torch.tensor([0.5, torch.nan, 0.2, torch.nan])
        curriculum.observe(
            Outcomes(
                eta,
                template,
                left_out=gone,
                episodes=episodes,
                failures=torch.tensor([1, 0, 0, 10]),
                survivable=share,
            )
        )
    counts = [
        [0.25, 0, 0, 1],
        [0.75, 0, 0, 0],
        [2, 0, 0, 1],
        [1, 0, 0, 0],
        [2, 0, 0, 0],
        [0.7, 0, 0, 0],
    ]
    counts = 1.75 * torch.tensor(counts)
    torch.testing.assert_close(curriculum._counts, counts.double())


def test_failures_that_nobody_prevents_teach_nothing():
    curriculum = BanditCurriculum(
        6, 10, etas=[1.0, 2.0], templates=["full"], forgetting=0.0
    )
    told(curriculum, 1.0, template=FULL, rate=0.5)
    told(curriculum, 2.0, template=FULL, rate=0.5, attacks=40, left_out=20)
    value = curriculum.values()
    assert value[2.0, "full"] == pytest.approx(value[1.0, "full"] * (21 / 41), rel=1e-6)


def test_of_failures_those_that_the_teacher_would_survive_are_drawn():
    arms = {"etas": [1.0, 2.0, 3.0], "templates": ["single"], "forgetting": 0.0}
    for regret in (True, False):
        curriculum = BanditCurriculum(6, 10, regret=regret, **arms)
        for eta, rate, survivable in (
            (1.0, 0.5, 0.1),
            (2.0, 0.9, 0.8),
            (3.0, 0.5, torch.nan),
        ):
            told(curriculum, eta, template=SINGLE, rate=rate, survivable=survivable)
        hopeless, survived, untold = curriculum.value().tolist()
        assert (
            (hopeless < untold < survived)
            if regret
            else (survived < hopeless == untold)
        )


def test_the_value_is_the_expected_learnability_under_the_posterior():
    curriculum = BanditCurriculum(6, 10, etas=[1.0], templates=["pair"], forgetting=0.0)
    told(curriculum, 1.0, template=PAIR, rate=0.3)
    posterior = torch.distributions.Beta(torch.tensor(7.0), torch.tensor(15.0))
    torch.manual_seed(0)
    p = posterior.sample((200_000,))
    assert curriculum.values()[1.0, "pair"] == pytest.approx(
        (p * (1 - p)).mean().item(), abs=1e-3
    )


def test_wrong_settings_are_refused():
    wrong = (
        {"etas": []},
        {"etas": [0.0, 1.0]},
        {"templates": []},
        {"templates": ["trio"]},
        {"num_scenes": 0},
    )
    for settings in (*wrong, {"forgetting": -0.1}, {"fraction": 1.5}):
        with pytest.raises(InputError, match="curriculum"):
            BanditCurriculum(**{"num_scenes": 6, "rounds": 10} | settings)
