"""`resume=RUN_DIR`: an interrupted run continues in its own folder with its own configuration.

The folder may be a stranger's. So its configuration may name extensions of e2rl's own only; code from elsewhere, and an
endpoint that would be sent the user's key, take part if the command line names them, too.
"""

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from e2rl.ego.base import Ego
from e2rl.errors import InputError
from e2rl.learning.curriculum.scheduler import CurriculumScheduler
from e2rl.learning.improvement import Improvement
from e2rl.scene.source import Source
from e2rl.traffic.traffic import Traffic

OVERRIDES = ("rounds", "device", "threads")  # keys that may change when a run is resumed
EXTENSIONS = (Source, Ego, Traffic, CurriculumScheduler, Improvement)


def resumed(config: DictConfig, folder: Path) -> tuple[DictConfig, Path]:
    """(configuration, folder) of the run `config.resume`, with the OVERRIDES of the command line.

    Raises InputError where there is no run, and where its configuration names code that is neither e2rl's nor of the
    modules in the command line's `plugins`.
    """
    if not config.resume:
        return config, folder
    saved_folder = Path(config.resume).resolve()
    saved = read_configuration(config.resume, saved_folder / ".hydra" / "config.yaml")
    check_code(saved, [str(name) for name in config.plugins], f"resume={config.resume}")
    endpoint = OmegaConf.select(saved, "synthesizer.reasoner.base_url")
    if endpoint and endpoint != OmegaConf.select(config, "synthesizer.reasoner.base_url"):
        raise InputError(
            f"resume={config.resume}: its reasoner sends your API key to {endpoint}; if that is right, add "
            f"synthesizer.reasoner.base_url={endpoint}"
        )
    given = {item.split("=", 1)[0] for item in HydraConfig.get().overrides.task}
    for key in OVERRIDES:
        if key in given:
            saved[key] = config[key]
    saved.plugins, saved.resume = config.plugins, str(saved_folder)
    return saved, saved_folder


def read_configuration(resume: str, file: Path) -> DictConfig:
    """The saved configuration of a run, with every key of this version's; raises InputError for anything else."""
    if not file.is_file():
        raise InputError(
            f"resume={resume}: no run found ({file} is missing); give the folder that the interrupted run printed"
        )
    try:
        saved = OmegaConf.load(file)
        plain = OmegaConf.to_container(saved)
    except (OSError, ValueError, RecursionError, YAMLError, OmegaConfBaseException) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{file}: damaged ({reason}); restore it, or begin a new run") from error
    if not isinstance(saved, DictConfig) or not isinstance(plain, dict) or not {"stage", "seed"} <= set(plain):
        raise InputError(f"{file}: no configuration of a training run; give the folder of a run of train.py")
    return saved


def check_code(config: DictConfig, allowed: list[str], where: str) -> None:
    """InputError where a configuration names code: a `_target_` that is no extension in e2rl, or a plugin, other than
    of the modules `allowed`."""
    plain = OmegaConf.to_container(config)
    assert isinstance(plain, dict)
    named = [str(name) for name in plain.get("plugins") or ()]
    named += [target for target in _targets(plain) if not _is_extension(target)]
    named += [text for text in _texts(plain) if "${" in text and ":" in text]  # a resolver: what it makes is unknown
    outside = [name for name in named if not any(name == own or name.startswith(f"{own}.") for own in allowed)]
    if outside:
        raise InputError(
            f"{where}: its configuration runs code that is no extension of e2rl: {', '.join(sorted(set(outside)))}; if "
            "you trust that code, name its modules: 'plugins=[MODULE]'"
        )


def _targets(value: Any) -> Iterator[str]:
    """Every `_target_` in nested containers, as written."""
    if isinstance(value, dict) and "_target_" in value:
        yield str(value["_target_"])
    for part in _parts(value):
        yield from _targets(part)


def _texts(value: Any) -> Iterator[str]:
    """Every string in nested containers, as written."""
    if isinstance(value, str):
        yield value
    for part in _parts(value):
        yield from _texts(part)


def _parts(value: Any) -> list:
    return [*value, *value.values()] if isinstance(value, dict) else value if isinstance(value, list) else []


def _is_extension(target: str) -> bool:
    """Whether a class path is that of one of the EXTENSIONS where e2rl defines it, not of a name that e2rl imports."""
    module, _, name = target.rpartition(".")
    if not module.startswith("e2rl.") or module.startswith("e2rl.commands"):  # which reaches outside of the package
        return False
    try:
        found = getattr(import_module(module), name)
    except (ImportError, AttributeError, ValueError):
        return False
    return isinstance(found, type) and found.__module__ == module and issubclass(found, EXTENSIONS)
