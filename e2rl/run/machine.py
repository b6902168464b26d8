"""What a run takes of its machine: threads, processes and the device, and the seeds of
its libraries."""

import random
from dataclasses import dataclass, fields

import numpy as np
import torch
from omegaconf import DictConfig

from e2rl.run.config import (
    LISTS,
    check_list,
    import_plugins,
    setting,
    settings_of,
)
from e2rl.run.cpu import configure_cpu
from e2rl.run.errors import InputError


@dataclass(frozen=True)
class Machine:
    """What a run takes of its machine; train.py has no `processes`."""

    batch: int = setting(low=1)
    threads: int = setting(low=1)
    processes: int | None = setting(low=1, optional=True)


def check_device(key: str, device: str) -> None:
    """Raises InputError for a device that is not there; key: whose value it is."""
    try:
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as error:
        others = "cpu" if device.startswith("cuda") else "cpu or cuda"
        raise InputError(
            f"{key}={device}: {str(error).splitlines()[0]}; use {key}={others}"
        ) from error


def set_up(config: DictConfig) -> None:
    """Import the plugins; set the threads, the device and the seeds of torch, numpy and
    python. Raises InputError for a plugin or device that is not there, and a size that
    is impossible."""
    settings_of(Machine, {part.name: config.get(part.name) for part in fields(Machine)})
    for key in LISTS:
        check_list(key, config.get(key))
    configure_cpu(config.threads)
    import_plugins(config.plugins, "plugins: ")
    check_device("device", config.device)
    seed = config.get(
        "seed", 0
    )  # first weights and exploration; evaluation's noise has seeds of its own
    torch.manual_seed(seed)
    np.random.seed(seed % 2**32)
    random.seed(seed)
