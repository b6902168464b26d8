"""Typed settings: dataclasses filled from groups of the configuration; what does not fit has one clear message."""

from collections.abc import Collection, Mapping
from typing import TypeVar

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from e2rl.run.errors import InputError

Settings = TypeVar("Settings")


def settings_of(kind: type[Settings], values: Mapping, where: str) -> Settings:
    """An instance of the dataclass `kind` (fields of plain types) with the values of the group `where`.

    Keys that are not given keep their defaults; lists become tuples. Raises InputError for a key that the dataclass
    does not have and for a value of another type.
    """
    try:
        typed = OmegaConf.merge(OmegaConf.structured(kind), OmegaConf.create(dict(values)))
        plain = OmegaConf.to_container(typed, resolve=True)
    except OmegaConfBaseException as error:
        key, reason = error.full_key or error.key, str(error).splitlines()[0]
        value = f"={values[key]}" if key in values else ""
        raise InputError(f"{where}.{key}{value}: {reason}; compare the group with its file in conf/") from error
    assert isinstance(plain, dict)
    return kind(**{str(name): tuple(value) if isinstance(value, list) else value for name, value in plain.items()})


def check_choice(where: str, value: object, choices: Collection[str]) -> None:
    """Raise InputError where the value of setting `where` is none of the choices."""
    if value not in choices:
        raise InputError(f"{where}={value}: choose one of {', '.join(choices)}")


def check_range(where: str, value: float, low: float = float("-inf"), high: float = float("inf")) -> None:
    """Raise InputError where the number `where` is below `low`, above `high`, or NaN."""
    if not low <= value <= high:
        bounds = [f"at least {low:g}"] if low > float("-inf") else []
        bounds += [f"at most {high:g}"] if high < float("inf") else []
        raise InputError(f"{where}={value}: expected a number of {' and '.join(bounds)}")
