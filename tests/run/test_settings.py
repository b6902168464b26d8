"""Settings: a default stands in the YAML file only, and every value is checked against
its range."""

from dataclasses import dataclass

import pytest

from e2rl.run import config
from e2rl.run.config import configured, setting, settings_of
from e2rl.run.errors import InputError


@pytest.fixture(autouse=True)
def conf(tmp_path, monkeypatch):
    """A folder of configuration of its own."""
    (tmp_path / "driver").mkdir()
    (tmp_path / "driver" / "calm.yaml").write_text(
        "name: calm\nreach:\n  look: 2.5\n  gap: 4\n  curve: true\n  kind: wide\n  "
        "times: [1, 2]\n  most: null\n"
    )
    for other in ("train.yaml", "sim/default.yaml"):  # whose values others may name
        (tmp_path / other).parent.mkdir(exist_ok=True)
        (tmp_path / other).write_text("device: cpu\n")
    monkeypatch.setattr(config, "CONF", tmp_path)
    config._loaded.cache_clear()
    yield
    config._loaded.cache_clear()


@configured("driver/calm", "reach")
@dataclass(frozen=True)
class Reach:
    """Some of the group's keys."""

    look: float = setting(low=0.0)
    gap: float = setting(low=0.0, high=10.0)
    curve: bool = setting()
    kind: str = setting(choices=("wide", "narrow"))
    times: tuple[float, ...] = setting(low=1.0)
    most: int | None = setting(low=3, optional=True)


def test_values_that_are_not_given_are_those_of_the_file():
    assert Reach() == Reach(
        look=2.5, gap=4, curve=True, kind="wide", times=(1, 2), most=None
    )
    assert (
        Reach(1.5).look == settings_of(Reach, {"look": 1.5}, where="reach").look == 1.5
    )
    assert settings_of(Reach, {"times": [3, 4]}, where="reach") == Reach(
        times=(3.0, 4.0)
    )


def test_constructors_are_filled_by_name_and_never_overruled():
    @configured("driver/calm", "reach")
    class Guard:
        def __init__(self, name: str, gap: float, look: float) -> None:
            self.name = name
            self.gap = gap
            self.look = look

    assert vars(Guard("a")) == {"name": "a", "gap": 4, "look": 2.5}
    assert vars(Guard("a", 7.0)) == {"name": "a", "gap": 7.0, "look": 2.5}


@pytest.mark.parametrize(
    "values",
    [
        {"gap": -1.0},
        {"gap": 10.5},
        {"gap": float("nan")},
        {"gpa": 1.0},
        {"look": "far"},
        {"look": None},
    ]
    + [{"kind": "round"}, {"times": [2, 0.5]}, {"most": 2}],
)
def test_bad_values_name_the_group_and_the_key(values):
    (key,) = values
    with pytest.raises(InputError, match=rf"^(driver\.)?reach\.{key}"):
        settings_of(Reach, values, where="reach")


def test_bounds_are_allowed_themselves_and_a_class_built_by_hand_is_checked_as_well():
    assert Reach(gap=10.0, look=0.0, most=3).most == 3
    for values in ({"gap": -1}, {"kind": "round"}, {"times": (0,)}, {"most": 2}):
        with pytest.raises(InputError, match=rf"reach\.{next(iter(values))}="):
            Reach(**values)
