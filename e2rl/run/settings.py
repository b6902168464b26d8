"""Typed settings: dataclasses and constructors whose default values stand once, in the
YAML files of conf/."""

import inspect
from collections.abc import Callable, Collection, Mapping
from dataclasses import field, fields, is_dataclass
from functools import cache, wraps
from pathlib import Path
from typing import Any, TypeVar

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from e2rl.run.errors import InputError

Settings = TypeVar("Settings")
Kind = TypeVar("Kind", bound=type)


def conf_folder() -> Path:
    """Returns the folder of the configuration: installed with the package, or conf/ of
    a checkout."""
    package = Path(__file__).parents[1]
    installed = package / "scripts" / "conf"
    return installed if installed.is_dir() else package.parent / "conf"


def setting(
    low: float = float("-inf"),
    high: float = float("inf"),
    choices: Collection[Any] = (),
    optional: bool = False,
) -> Any:
    """Returns a dataclass field without default whose value `settings_of` and
    `configured` check.

    Args:
        low, high: the range of a number (of each number of a list).
        choices: the only values allowed, where any are given.
        optional: None is allowed, too.
    """
    return field(
        metadata={
            "low": low,
            "high": high,
            "choices": tuple(choices),
            "optional": optional,
        }
    )


def configured(file: str, part: str = "") -> Callable[[Kind], Kind]:
    """Returns a class decorator: arguments that are not given have the values of
    conf/<file>.yaml.

    So a default stands in the YAML file only, and whoever builds the class gets what
    the command line gets. A class that takes any keyword gets all values of the file.

    Args:
        file: such as "synthesizer/diffscene"; its `defaults` list is not followed.
        part: dotted name of the mapping in it that holds the arguments, such as
            "control".
    """

    def decorate(kind: Kind) -> Kind:
        build = kind.__init__  # type: ignore[misc]
        signature = inspect.signature(build)
        takes_any = any(
            parameter.kind is parameter.VAR_KEYWORD
            for parameter in signature.parameters.values()
        )

        @wraps(build)
        def filled(self: Any, *positional: Any, **named: Any) -> None:
            named_arguments = {
                *signature.bind_partial(self, *positional, **named).arguments,
                *named,
            }
            values = file_values(file, part)
            wanted = (
                values.keys() - {"_target_"}
                if takes_any
                else signature.parameters.keys()
            )
            missing = {
                name: value
                for name, value in values.items()
                if name in wanted and name not in named_arguments
            }
            build(self, *positional, **named, **missing)
            if is_dataclass(kind):
                check_settings(
                    self, ".".join(filter(None, (file.partition("/")[0], part)))
                )

        kind.__init__ = filled  # type: ignore[misc]
        kind.__configured__ = (file, part)  # type: ignore[attr-defined]
        return kind

    return decorate


def file_values(file: str, part: str = "") -> dict[str, Any]:
    """Returns the plain values of conf/<file>.yaml, or of one mapping in it; lists are
    tuples."""
    group = _loaded(file)
    plain = OmegaConf.to_container(
        OmegaConf.select(group, part) if part else group, resolve=True
    )
    assert isinstance(plain, dict)
    return {
        str(key): tuple(value) if isinstance(value, list) else value
        for key, value in plain.items()
    }


@cache
def _loaded(file: str) -> Any:
    root = OmegaConf.load(
        conf_folder() / "train.yaml"
    )  # what the file's ${...} may refer to
    OmegaConf.update(
        root, "sim", OmegaConf.load(conf_folder() / "sim" / "default.yaml")
    )
    OmegaConf.update(root, "own", OmegaConf.load(conf_folder() / f"{file}.yaml"))
    return root.own


def settings_of(kind: type[Settings], values: Mapping, where: str = "") -> Settings:
    """Returns an instance of the dataclass `kind` (fields of plain types) with the
    values of the group `where`.

    Keys that are not given keep their defaults; lists become tuples. Raises InputError
    for a key that the dataclass does not have, a value of another type, or one out of
    its range.
    """
    try:
        typed = OmegaConf.merge(
            OmegaConf.structured(kind), OmegaConf.create(dict(values))
        )
        plain = OmegaConf.to_container(typed, resolve=True)
    except OmegaConfBaseException as error:
        key = error.full_key or error.key
        reason = str(error).splitlines()[0]
        value = f"={values[key]}" if key in values else ""
        raise InputError(
            f"{_dotted(where, key)}{value}: {reason}; compare it with its file in conf/"
        ) from error
    assert isinstance(plain, dict)
    names = {
        str(key): value
        for key, value in plain.items()
        if not (isinstance(value, str) and value == "???")
    }
    instance = kind(
        **{
            key: tuple(value) if isinstance(value, list) else value
            for key, value in names.items()
        }
    )
    check_settings(instance, where)
    return instance


def check_settings(made: Any, where: str) -> None:
    """Raises InputError where a `setting` of a dataclass has a value that it must not
    have."""
    for part in fields(made):
        value = getattr(made, part.name)
        rule = part.metadata
        if "low" not in rule or (value is None and rule["optional"]):
            continue
        if rule["choices"]:
            check_choice(_dotted(where, part.name), value, choices=rule["choices"])
            continue
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, int | float):
                check_range(
                    _dotted(where, part.name),
                    number,
                    low=rule["low"],
                    high=rule["high"],
                )


def _dotted(where: str, key: object) -> str:
    return f"{where}.{key}" if where else str(key)


def check_choice(where: str, value: object, choices: Collection[str]) -> None:
    """Raises InputError where the value of setting `where` is none of the choices."""
    if value not in choices:
        raise InputError(f"{where}={value}: choose one of {', '.join(choices)}")


def check_range(
    where: str, value: float, low: float = float("-inf"), high: float = float("inf")
) -> None:
    """Raises InputError where the number `where` is below `low`, above `high`, or NaN."""
    if not low <= value <= high:
        bounds = [f"at least {low:g}"] if low > float("-inf") else []
        bounds += [f"at most {high:g}"] if high < float("inf") else []
        raise InputError(
            f"{where}={value}: expected a number of {' and '.join(bounds)}"
        )
