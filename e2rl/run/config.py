"""The configuration: files of conf/, what they build, and typed settings, whose default
values stand once, in these files."""

import copy
import inspect
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import field, fields, is_dataclass
from functools import cache, wraps
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, InstantiationException
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from e2rl.run.endings import out_of_memory
from e2rl.run.errors import InputError
from e2rl.run.extras import how_to_install

LISTS = ("methods", "eta", "seeds", "compare", "shard", "plugins")  # keys
CHOICE = re.compile(r"[\w+-][\w.+-]*(/[\w+-][\w.+-]*)*")  # a file's name in a group
PACKAGE = Path(__file__).resolve().parents[1]
INSTALLED = PACKAGE / "scripts" / "conf"
CONF = INSTALLED if INSTALLED.is_dir() else PACKAGE.parent / "conf"  # of a checkout
Settings = TypeVar("Settings")
Kind = TypeVar("Kind", bound=type)


@contextmanager
def _hydra() -> Iterator[GlobalHydra]:
    """Hydra of the running script, or else one that reads conf/."""
    if GlobalHydra.instance().is_initialized():
        yield GlobalHydra.instance()
        return
    with initialize_config_dir(str(CONF), version_base="1.3"):
        yield GlobalHydra.instance()


def load_config(name: str = "evaluate", overrides: Sequence[str] = ()) -> DictConfig:
    """Returns the configuration conf/<name>.yaml with Hydra overrides, outside of the
    scripts."""
    with _hydra():
        return compose(name, list(overrides))


def assigned(key: str, value: object) -> str:
    """Returns `key=value` for Hydra's command line, quoted for Hydra but not yet for a
    shell."""
    text = str(value)
    return (
        f"{key}={text}"
        if re.fullmatch(r"[\w./:+@%-]+", text)
        else f"{key}='" + text.replace("'", "\\'") + "'"
    )


def load_choice(group: str, name: str) -> DictConfig:
    """Returns the file conf/<group>/<name>.yaml, of the running script's search path
    where there is one. Raises InputError where there is none of this name; it lists the
    choices."""
    if not CHOICE.fullmatch(
        name
    ):  # a path could lead out of conf/, into a stranger's folder
        raise InputError(f"{group}={name}: no name of a file in conf/{group}")
    further = HydraConfig.get().overrides.hydra if HydraConfig.initialized() else ()
    changes = [
        f"+{group}={name}",
        *(override for override in further if override.startswith("hydra.searchpath")),
    ]
    with _hydra() as hydra:
        try:
            loader = hydra.config_loader()
            return loader.load_configuration(
                None,
                changes,
                RunMode.RUN,
                validate_sweep_overrides=False,
            )[group]
        except HydraException as error:
            names = ", ".join(choices(group))
            raise InputError(
                f"{group}={name}: none of {names}; add a file to the group in conf/"
            ) from error


def choices(group: str) -> list[str]:
    """Returns the names of the files in conf/<group>, as `load_choice` finds them."""
    with _hydra() as hydra:
        return hydra.config_loader().get_group_options(group)


def with_changes(
    config: DictConfig,
    changes: Mapping[str, Any],
    where: str,
    group: str,
) -> DictConfig:
    """Returns a copy of a configuration with changes of dotted keys; InputError where
    there is no such key in it."""
    changed = copy.deepcopy(config)
    OmegaConf.set_struct(changed, True)
    try:
        for key, value in changes.items():
            OmegaConf.update(changed, key, value, merge=True)
    except OmegaConfBaseException as error:
        raise InputError(
            f"{where}: {str(error).splitlines()[0]}; compare it with conf/{group}"
        ) from error
    return changed


def resolved(config: DictConfig) -> dict[str, Any]:
    """Returns the configuration as plain containers, for the files of a run."""
    plain = OmegaConf.to_container(config, resolve=True)
    assert isinstance(plain, dict)
    return {str(key): value for key, value in plain.items()}


class Extension:
    """What a configuration may name by `_target_`: sources, egos, traffic, curricula,
    learners."""


def built(config: DictConfig, where: str, kind: type, **given: Any) -> Any:
    """Returns what `_target_` of a group builds, users' code included. Raises
    InputError where it cannot be built or is no `kind`."""
    settings = {key: value for key, value in config.items() if key != "name"}
    target = settings.get("_target_")
    try:
        instance = instantiate(settings, _partial_=True, _convert_="all")(**given)
    except (InputError, MemoryError):
        raise
    except SystemExit as error:  # of outside code, perhaps as it is imported
        raise InputError(
            f"{where}={target}: it called sys.exit({error.code!r}) instead of being built"
        ) from error
    except Exception as error:  # outside code raises anything
        if out_of_memory(error):
            raise
        cause = (
            error.__cause__
            if isinstance(error, InstantiationException) and error.__cause__
            else error
        )
        reason = f"{where}={target}: cannot be built: {type(cause).__name__}: {cause}"
        raise InputError(
            f"{reason}; check the class path and its arguments in conf/{where}"
        ) from error
    if not isinstance(instance, kind):
        raise InputError(
            f"{where}={target}: is no {kind.__module__}.{kind.__name__}; subclass it"
        )
    return instance


# --- typed settings


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
    rule = {"low": low, "high": high, "choices": choices, "optional": optional}
    return field(metadata=rule)


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
                group = file.partition("/")[0] if "/" in file else ""  # a command's own
                check_settings(self, ".".join(filter(None, (group, part))))

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
    # what the file's ${...} may refer to
    root = OmegaConf.load(CONF / "train.yaml")
    OmegaConf.update(root, "sim", OmegaConf.load(CONF / "sim" / "default.yaml"))
    OmegaConf.update(root, "own", OmegaConf.load(CONF / f"{file}.yaml"))
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
    where: str,
    value: float,
    low: float = float("-inf"),
    high: float = float("inf"),
) -> None:
    """Raises InputError where the number `where` is below `low`, above `high`, or NaN."""
    if not low <= value <= high:
        bounds = [f"at least {low:g}"] if low > float("-inf") else []
        bounds += [f"at most {high:g}"] if high < float("inf") else []
        raise InputError(
            f"{where}={value}: expected a number of {' and '.join(bounds)}"
        )


def check_list(key: str, value: Any) -> None:
    """Raises InputError for a text of several values, where the values of `key` are a
    list."""
    if isinstance(value, str) and "," in value:
        raise InputError(f"{key}={value}: {as_a_list(key, value)}")


def as_a_list(key: str, value: str) -> str:
    """Returns how to write several values that commas part; a name with spaces is one."""
    values = ",".join(part.strip() for part in value.split(","))
    return f"several values are a list, '{key}=[{values}]'"


def library(name: str, where: str, extra: str) -> Any:
    """Returns a module of an optional library; InputError, beginning with `where`,
    where it cannot be imported."""
    try:
        return import_module(name)
    except ImportError as error:
        raise InputError(
            f"{where}: {name} cannot be imported ({error}); {how_to_install(extra)}"
        ) from error


def import_plugins(names: Sequence[str], option: str) -> None:
    """Import modules; InputError, beginning with `option`, where one is not there, or
    registers what is taken."""
    for name in names:
        try:
            import_module(name)
        except ImportError as error:
            raise InputError(
                f"{option}{name}: {error}; install it or put its folder on PYTHONPATH"
            ) from error
        except InputError as error:
            raise InputError(f"{option}{name}: {error}") from error
