"""Workers of a Ray cluster (extra `ray`): jobs are done again where a worker was lost."""

import importlib
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.util import find_spec
from pathlib import Path
from pickle import PicklingError
from typing import Any

import torch

from e2rl.run.errors import InputError
from e2rl.run.extras import how_to_install
from e2rl.run.files import hash_files
from e2rl.run.fused import is_on, switch

RETRIES = 3  # times that a job is done again whose worker was lost
ADDRESS = "RAY_ADDRESS"  # environment variable: the cluster; without it, workers are started on this machine
VARIABLES = {  # of Ray, where the environment has none of its own
    "RAY_USAGE_STATS_ENABLED": "0",  # nothing is sent to anybody
    "RAY_worker_niceness": "0",  # of workers started here; else they yield to everything on the machine
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # no warning about it
}


@dataclass(frozen=True)
class RayWorkers:
    """Workers of one torch thread each, of the cluster at RAY_ADDRESS, or else `count`
    (None: one a core) started here; they import `modules` first, such as plugins.
    Raises InputError where Ray is not installed."""

    count: int | None = None
    modules: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if find_spec("ray") is None:
            raise InputError(
                f"launcher=ray: Ray is not installed; {how_to_install('ray')}"
            )

    @contextmanager
    def tasks(
        self, function: Callable[[Any], bytes], jobs: Sequence
    ) -> Iterator[Callable[[int], Future]]:
        """Gives a function that submits a job by its number. Function and jobs are sent
        once, whole.

        Left by an exception, it cancels the tasks. Raises InputError where a job lost
        its worker RETRIES + 1 times, or where what is sent, such as an ego of one's
        own, cannot be pickled. What a task raised is raised here.
        """
        ray = self.connect()
        begun = []
        task = ray.remote(
            num_cpus=1, max_retries=RETRIES, scheduling_strategy="SPREAD"
        )(_work)
        try:
            given = [
                ray.put((function, jobs))
            ]  # in a list it arrives as a reference, which a worker resolves once
        except (TypeError, AttributeError, PicklingError) as error:
            reason = str(error).strip().splitlines()[0]
            raise InputError(
                f"launcher=ray: cannot be sent to workers: {reason}; set launcher=processes"
            ) from error

        def submit(number: int) -> Future:
            begun.append(task.remote(given, number, self.modules, _code(), is_on()))
            return begun[-1].future()

        try:
            yield submit
        except BaseException as error:
            for reference in begun:
                ray.cancel(reference, force=True)
            if isinstance(error, ray.exceptions.RayTaskError):
                raise error.cause from error
            if isinstance(error, ray.exceptions.RayError):
                raise InputError(
                    f"launcher=ray: a job lost its worker {RETRIES + 1} times, perhaps for lack of memory; use fewer "
                    f"workers a machine, or a smaller batch ({' '.join(str(error).split())[:300]})"
                ) from error
            raise

    def connect(self) -> Any:
        """Returns the module ray, connected to the cluster; first to be called in the
        main thread, where signals arrive."""
        for name, value in VARIABLES.items():
            os.environ.setdefault(name, value)
        ray = importlib.import_module("ray")
        if ray.is_initialized():
            return ray
        address = os.environ.get(ADDRESS)
        before = signal.getsignal(signal.SIGTERM)
        here = (
            {}
            if address
            else {
                "address": "local",
                "num_cpus": self.count,
                "include_dashboard": False,
            }
        )
        try:
            ray.init(log_to_driver=False, **here)
        except Exception as error:  # of many types
            reason = " ".join(str(error).split())[:300]
            raise InputError(
                f"launcher=ray: no cluster at {address or 'this machine'}: {reason}"
            ) from error
        with suppress(
            ValueError, TypeError
        ):  # where this is not the main thread, Ray has set no handler either
            signal.signal(signal.SIGTERM, before)  # e2rl.run.endings says how to go on
        return ray


def _work(
    given: list, number: int, modules: tuple[str, ...], code: str, compiled: bool
) -> bytes:
    """The result of a job, in a worker."""
    if code != _code():
        raise InputError(
            "launcher=ray: a worker has another version of e2rl or torch; install the same everywhere"
        )
    torch.set_num_threads(1)
    switch(compiled)
    for name in modules:
        importlib.import_module(name)
    function, jobs = _sent(given[0])
    return function(jobs[number])


@lru_cache(maxsize=1)
def _sent(reference: Any) -> tuple[Callable[[Any], bytes], Sequence]:
    """What was sent, once for all jobs that this worker does."""
    return importlib.import_module("ray").get(reference)


@cache
def _code() -> str:
    """Torch's version and a hash of e2rl's code, the scripts apart, which an installed
    package holds, too."""
    package = Path(__file__).parents[1]
    own = (
        path
        for path in sorted(package.rglob("*.py"))
        if path.relative_to(package).parts[0] != "scripts"
    )
    return torch.__version__ + hash_files(own).hex()
