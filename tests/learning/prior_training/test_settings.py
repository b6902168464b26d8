"""Settings of the wrong type or out of range are named with the key that a user wrote."""

import pytest

from e2rl.learning.prior_training.training_settings import TrainingSettings
from e2rl.run.errors import InputError
from e2rl.run.settings import settings_of


def settings(**values):
    return settings_of(TrainingSettings, values, "prior.training")


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("steps", "abc", "steps=abc"),
        ("steps", 0, "steps=0: expected a number of at least 1"),
        ("steps", True, "steps=True"),
        ("batch", 2.5, "batch=2.5"),
        ("levels", 0, "levels=0"),
        ("learning_rate", -1.0, "learning_rate=-1.0: expected a number of at least 0"),
        ("learning_rate", float("nan"), "learning_rate=nan"),
        ("ema", 1.5, "at least 0 and at most 1"),
        ("bf16", "maybe", "bf16=maybe"),
        ("starts", "10", "starts=10"),
        ("starts", [], "starts="),
        ("starts", [-1], "starts="),
        ("starts", 10, "starts=10"),
        ("seed", "x", "seed=x"),
        ("validate_every", 0, "validate_every=0"),
        ("closed_loop_scenes", 0, "closed_loop_scenes=0"),
        ("depth", 3, "depth=3"),
    ],
)
def test_one_line_names_the_key(name, value, expected):
    with pytest.raises(InputError, match="^prior.training.") as error:
        settings(**{name: value})
    assert expected in str(error.value)


def test_whole_numbers_are_numbers_and_start_frames_are_sorted():
    some = settings(learning_rate=1, starts=[30, 10, 30])
    assert some.learning_rate == 1 and some.starts == (10, 30)
