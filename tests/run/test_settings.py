"""Settings: a default stands in the YAML file only, and every value is checked against its range."""

from dataclasses import dataclass, fields

import pytest

from e2rl.run.errors import InputError
from e2rl.run.settings import configured, file_values, setting, settings_of


@configured("prior/default", "bounds")
@dataclass(frozen=True)
class Bounds:
    """Some of the group's keys."""

    look: float = setting(low=0.0)
    gap: float = setting(low=0.0, high=10.0)
    curve: bool = setting()


def test_values_that_are_not_given_are_those_of_the_file():
    values = file_values("prior/default", "bounds")
    assert Bounds() == Bounds(look=values["look"], gap=values["gap"], curve=values["curve"])
    assert Bounds(1.5).look == settings_of(Bounds, {"look": 1.5}, "bounds").look == 1.5
    assert settings_of(Bounds, {"look": 1.5}, "bounds").gap == values["gap"]


def test_constructors_are_filled_by_name_and_never_overruled():
    @configured("prior/default", "bounds")
    class Guard:
        def __init__(self, name: str, gap: float, look: float) -> None:
            self.name, self.gap, self.look = name, gap, look

    values = file_values("prior/default", "bounds")
    assert vars(Guard("a")) == {"name": "a", "gap": values["gap"], "look": values["look"]}
    assert vars(Guard("a", 7.0)) == {"name": "a", "gap": 7.0, "look": values["look"]}
    assert [each.name for each in fields(Bounds)] == ["look", "gap", "curve"]


@pytest.mark.parametrize("values", [{"gap": -1.0}, {"gap": 11}, {"gap": float("nan")}, {"gpa": 1.0}, {"look": "far"}])
def test_bad_values_name_the_group_and_the_key(values):
    with pytest.raises(InputError, match=rf"^bounds\.{next(iter(values))}"):
        settings_of(Bounds, values, "bounds")


def test_a_class_built_by_hand_is_checked_as_well():
    with pytest.raises(InputError, match=r"bounds\.gap=-1"):
        Bounds(gap=-1)
