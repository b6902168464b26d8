"""Reward terms: signs, scales, unknown limits, and the weighted sum."""

import torch

from e2rl.sim.reward import (
    TERMS,
    Conduct,
    check_weights,
    reward_terms,
    rewarded_progress,
    weighted_sum,
)

QUIET = {
    "progress": torch.ones(1),
    "contact": torch.tensor([False]),
    "fault": torch.tensor([False]),
    "off_road": torch.tensor([False]),
    "action": torch.zeros(1, 2),
    "last_action": torch.zeros(1, 2),
    "speed": torch.full((1,), 10.0),
    "limit": torch.full((1,), 12.0),
    "offset": torch.zeros(1),
}


def term(name, **changes):
    return reward_terms(Conduct(**QUIET | changes))[name].item()


def test_quiet_driving_only_earns_progress():
    terms = reward_terms(Conduct(**QUIET))
    assert set(terms) == set(TERMS)
    assert {name: value.item() for name, value in terms.items()} == {
        name: float(name == "progress") for name in TERMS
    }


def test_terms_grow_with_what_they_name():
    assert term("contact", contact=torch.tensor([True])) == 1
    assert term("off_road", off_road=torch.tensor([True])) == 1
    assert term("fault", fault=torch.tensor([True])) == 1
    assert abs(term("speeding", speed=torch.tensor([15.0])) - 0.25) < 1e-6
    assert (
        term(
            "speeding",
            speed=torch.tensor([15.0]),
            limit=torch.zeros(1),
        )
        == 0
    )
    assert term("lane_offset", offset=torch.tensor([-1.0])) == 0.5
    steady = torch.tensor([[4.0, 0.0]])
    assert (
        abs(
            term(
                "comfort",
                action=steady,
                last_action=steady,
            )
            - 1
        )
        < 1e-6
    )
    turning = torch.tensor([[0.0, 0.4]])
    assert abs(term("comfort", action=turning) - 1) < 1e-6
    assert (
        term("acceleration", action=torch.tensor([[-1.0, 0.0]])) == 0.25
    )  # linear: a small one has its price, too
    assert term("comfort", action=steady) > term(
        "comfort",
        action=steady,
        last_action=steady,
    )


def test_terms_are_capped_and_squares_of_what_is_felt():
    """Comfort: acceleration / 4, lateral acceleration / 4 and jerk / 20, each squared."""
    action = torch.tensor([[1.0, 0.2]])
    before = torch.tensor([[0.5, 0.0]])
    expected = (1 / 4) ** 2 + (10 * 0.2 / 4) ** 2 + (0.5 / 0.1 / 20) ** 2
    assert (
        abs(
            term(
                "comfort",
                action=action,
                last_action=before,
            )
            - expected
        )
        < 1e-6
    )
    hard = {
        "action": torch.tensor([[-8.0, 1.6]]),
        "speed": torch.tensor([40.0]),
        "offset": torch.tensor([5.0]),
    }
    capped = {
        name: term(name, **hard)
        for name in ("comfort", "acceleration", "speeding", "lane_offset")
    }
    assert capped == {
        "comfort": 3.0,
        "acceleration": 1.0,
        "speeding": 1.0,
        "lane_offset": 1.0,
    }
    assert (
        abs(
            term(
                "speeding",
                speed=torch.tensor([0.8]),
                limit=torch.tensor([0.5]),
            )
            - 0.3
        )
        < 1e-6
    ), "of 1 m/s at least"


def test_progress_pays_up_to_what_is_allowed():
    """The recorded top speed, at least 5 m/s, and never more than a known limit; going
    back costs what it is."""
    progress = torch.tensor([0.5, 2.0, 2.0, 2.0, 2.0, -1.0])
    limit = torch.tensor([10.0, 10.0, 0.0, 0.0, 30.0, 10.0])
    recorded = torch.tensor([3.0, 15.0, 15.0, 3.0, 3.0, 3.0])
    paid = rewarded_progress(progress, limit, top_speed=recorded)
    torch.testing.assert_close(paid, torch.tensor([0.5, 1.0, 1.5, 0.5, 0.5, -1.0]))


def test_reward_is_linear_in_the_weights():
    weights = torch.tensor(
        check_weights({name: float(k) for k, name in enumerate(TERMS)})
    )
    terms = {name: torch.tensor([2.0**k]) for k, name in enumerate(TERMS)}
    assert weighted_sum(terms, weights).item() == sum(
        k * 2.0**k for k in range(len(TERMS))
    )
